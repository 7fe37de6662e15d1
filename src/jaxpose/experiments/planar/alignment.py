"""Image and warps optimised together, in compiled chunks of steps that all motions share."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose import fields, optim
from jaxpose.experiments.planar import task as planar_task
from jaxpose.experiments.planar.task import Photo, Task, corner_errors, pixels
from jaxpose.experiments.planar.warps import RESET_EVERY, Warps, apply
from jaxpose.scenes import ImageField
from jaxpose.training.steps import Decay, adam

CHUNK = 50  # steps in one compiled call
_IMAGE_RATE = 1e-3  # Adam's, constant: BARF's
_ROWS = 4096  # points of the image queried at once where it is drawn or measured

OnStep = Callable[[int, float, float], None]  # steps done, loss, mean corner error [px]


class Aligned(NamedTuple):
    """Where the optimisation of one motion ended, and how it went there."""

    picture: Float[np.ndarray, "h w 3"]  # the image that was found, on the pixels of the photograph
    H_image_patch: Float[np.ndarray, "n 3 3"]
    loss: Float[np.ndarray, " c"]  # after each step, or mean over each chunk of steps
    corner_px: Float[np.ndarray, " c+1"]  # mean over the patches that may move, at the start and then
    psnr: float  # of all pixels of all patches [dB]


@runtime_checkable
class Align(Protocol):
    """Find the warps of one motion from the identity.

    What is found depends on `key` and on nothing that ran before.
    """

    def __call__(self, task: Task, key: PRNGKeyArray, on_step: OnStep | None = None, /) -> Aligned: ...


class _State(NamedTuple):
    image: Any
    pose: Any
    opt_state: Any
    key: PRNGKeyArray


class Aligner(NamedTuple):
    """Compiled functions for one image size and one kind of warp."""

    start: Callable[[PRNGKeyArray], _State]
    advance: Callable[[_State, Float[Array, "n p 3"], Float[Array, ""]], tuple[_State, Float[Array, ""]]]
    warps: Callable[[Any], Float[Array, "n 3 3"]]
    colours: Callable[[Any, Float[Array, "k 2"]], Float[Array, "k 3"]]


def by_adam(photo: Photo, image: ImageField, warps: Warps, *, steps: int, points: int) -> Align:
    """The paper's alignment: a neural image and the warps optimised together by Adam.

    Args:
        photo: the photograph of the patches.
        image: the neural image.
        warps: the warps, and Adam's rates for them.
        steps: a multiple of CHUNK; coarse-to-fine window and rates refer to it.
        points: random pixels of each patch in a step.

    Returns:
        The alignment, compiled once for all motions.
    """
    compiled = aligner(photo, image, warps, steps=steps, points=points)

    def align(task: Task, key: PRNGKeyArray, on_step: OnStep | None = None, /) -> Aligned:
        state, rgb = compiled.start(key), jnp.asarray(task.rgb, jnp.float32)

        def corner_px():
            estimate = np.asarray(compiled.warps(state.pose), np.float64)
            return float(corner_errors(photo, estimate, task.H_image_patch)[1:].mean())

        losses, curve = [], [corner_px()]
        for first in range(0, steps, CHUNK):
            state, value = compiled.advance(state, rgb, jnp.asarray(first))
            losses.append(float(value))
            curve.append(corner_px())
            if on_step is not None:
                on_step(first + CHUNK, losses[-1], curve[-1])
        params = fields.set_progress(state.image, jnp.ones(()))
        H = np.asarray(compiled.warps(state.pose), np.float64)

        def colours(xy):
            return np.asarray(
                compiled.colours(params, jnp.asarray(xy.reshape(-1, 2), jnp.float32)), np.float64
            )

        error = colours(planar_task.apply(H, pixels(photo))) - task.rgb.reshape(-1, 3)
        picture = colours(photo.pixels).reshape(photo.rgb.shape)
        return Aligned(picture, H, np.array(losses), np.array(curve), psnr(error))

    return align


def psnr(error: Float[np.ndarray, "p 3"]) -> float:
    """Of errors of colours in [0, 1] [dB]; at most 140, which is float32's rounding."""
    return float(-10 * np.log10(max(np.mean(error**2), 1e-14)))


def aligner(photo: Photo, image: ImageField, warps: Warps, *, steps: int, points: int) -> Aligner:
    """Adam on the mean squared colour error of `points` random pixels per patch and step.

    `steps` (a multiple of CHUNK) is the length of the run, to which coarse-to-fine window and rates refer.
    """
    grid = pixels(photo)
    pose_rates = jax.tree.map(lambda rate: Decay(rate, rate * warps.decay), warps.rates)
    optimizer = adam({"image": _IMAGE_RATE, "pose": pose_rates}, steps)

    def start(key):
        image_key, pose_key, key = jax.random.split(key, 3)
        params = {"image": image.init(image_key), "pose": warps.init(pose_key)}
        return _State(**params, opt_state=optimizer.init(params), key=key)

    def loss(params, xy, rgb):
        place = jax.vmap(jax.vmap(apply, (None, 0)))(warps.warps(params["pose"]), xy)
        return jnp.mean((_query(image, params["image"], place) - rgb) ** 2)

    def step(state, number, rgb):
        key, draw_key = jax.random.split(state.key)
        progress = number.astype(rgb.dtype) / steps
        params = {"image": fields.set_progress(state.image, progress), "pose": state.pose}
        chosen = jax.random.randint(draw_key, (rgb.shape[0], points), 0, rgb.shape[1])
        seen = jnp.take_along_axis(rgb, chosen[..., None], axis=1)
        value, gradient = jax.value_and_grad(loss)(params, jnp.asarray(grid, rgb.dtype)[chosen], seen)
        params, opt_state = optim.apply(optimizer, params, gradient, state.opt_state)
        if warps.reset is not None:
            pose = params["pose"]
            smooth = jnp.matmul(jnp.asarray(warps.reset, pose.dtype), pose, precision="highest")
            params = params | {"pose": jnp.where((number + 1) % RESET_EVERY == 0, smooth, pose)}
        return _State(**params, opt_state=opt_state, key=key), value

    def advance(state, rgb, first):
        numbers = first + jnp.arange(CHUNK)
        state, values = jax.lax.scan(lambda s, number: step(s, number, rgb), state, numbers)
        return state, jnp.mean(values)

    def colours(params, xy):
        return jax.lax.map(lambda point: image.query(params, point), xy, batch_size=_ROWS)

    return Aligner(jax.jit(start), jax.jit(advance), jax.jit(warps.warps), jax.jit(colours))


def _query(image: ImageField, params: Any, place: Float[Array, "n k 2"]) -> Float[Array, "n k 3"]:
    # As one list of points, so that every layer is one plain product.
    rgb = jax.vmap(image.query, (None, 0))(params, place.reshape(-1, 2))
    return rgb.reshape(*place.shape[:2], 3)
