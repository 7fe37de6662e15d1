"""Image and warps optimised together, in compiled chunks of steps that all motions share."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose import fields, optim
from jaxpose.experiments.planar.task import Photo, Task, corner_errors, pixels
from jaxpose.experiments.planar.warps import RESET_EVERY, Warps, apply
from jaxpose.scenes._image import ImageField

CHUNK = 50  # steps in one compiled call
_RATE = 1e-3  # Adam's of the image, constant: BARF's
_ROWS = 4096  # points of the image queried at once where it is drawn or measured

OnChunk = Callable[[int, float, float], None]  # steps done, loss, mean corner error [px]


class Aligned(NamedTuple):
    """Where the optimisation of one motion ended, and how it went there."""

    image: Any  # parameters of the image
    H_image_patch: Float[np.ndarray, "n 3 3"]
    loss: Float[np.ndarray, " c"]  # mean over each chunk of steps
    corner_px: Float[
        np.ndarray, " c+1"
    ]  # mean over the patches that may move, at the start and after each chunk
    psnr: float  # of all pixels of all patches [dB]


class _State(NamedTuple):
    image: Any
    pose: Any
    adam: Any
    key: PRNGKeyArray


class Aligner(NamedTuple):
    """Compiled functions for one image size and one kind of warp."""

    start: Callable[[PRNGKeyArray], _State]
    advance: Callable[[_State, Float[Array, "n p 3"], Float[Array, ""]], tuple[_State, Float[Array, ""]]]
    warps: Callable[[Any], Float[Array, "n 3 3"]]
    colours: Callable[[Any, Float[Array, "k 2"]], Float[Array, "k 3"]]
    points: Float[np.ndarray, "p 2"]


def aligner(photo: Photo, image: ImageField, warps: Warps, *, steps: int, points: int) -> Aligner:
    """Adam on the mean squared colour error of `points` random pixels per patch and step.

    `steps` (a multiple of CHUNK) is the length of the run, to which coarse-to-fine window and rates refer.
    """
    grid = pixels(photo)
    decays = lambda rate: lambda count: rate * warps.decay ** (count.astype(jnp.float32) / steps)
    rates = optim.scale_by_rates((_RATE, jax.tree.map(decays, warps.rates)))
    adam = optax.chain(optax.scale_by_adam(), rates)

    def start(key):
        image_key, pose_key, key = jax.random.split(key, 3)
        first = image.init(image_key), warps.init(pose_key)
        return _State(*first, adam.init(first), key)

    def loss(params, xy, rgb):
        image_params, pose_params = params
        place = jax.vmap(jax.vmap(apply, (None, 0)))(warps.warps(pose_params), xy)
        return jnp.mean((_query(image, image_params, place) - rgb) ** 2)

    def step(state, number, rgb):
        key, draw_key = jax.random.split(state.key)
        progress = number.astype(rgb.dtype) / steps
        state = state._replace(image=fields.set_progress(state.image, progress))
        chosen = jax.random.randint(draw_key, (rgb.shape[0], points), 0, rgb.shape[1])
        seen = jnp.take_along_axis(rgb, chosen[..., None], axis=1)
        params = state.image, state.pose
        value, gradient = jax.value_and_grad(loss)(params, jnp.asarray(grid, rgb.dtype)[chosen], seen)
        (new_image, pose), memory = optim.apply(adam, params, gradient, state.adam)
        if warps.reset is not None:
            smooth = jnp.matmul(jnp.asarray(warps.reset, pose.dtype), pose, precision="highest")
            pose = jnp.where((number + 1) % RESET_EVERY == 0, smooth, pose)
        return _State(new_image, pose, memory, key), value

    def advance(state, rgb, first):
        numbers = first + jnp.arange(CHUNK)
        state, values = jax.lax.scan(lambda s, number: step(s, number, rgb), state, numbers)
        return state, jnp.mean(values)

    def colours(params, xy):
        return jax.lax.map(lambda point: image.query(params, point), xy, batch_size=_ROWS)

    return Aligner(jax.jit(start), jax.jit(advance), jax.jit(warps.warps), jax.jit(colours), grid)


def align(
    compiled: Aligner,
    photo: Photo,
    task: Task,
    key: PRNGKeyArray,
    steps: int,
    on_chunk: OnChunk | None = None,
) -> Aligned:
    """Optimise one motion from the identity; the numbers depend on `key` and on nothing that ran before."""
    state, rgb = compiled.start(key), jnp.asarray(task.rgb, jnp.float32)

    def corner_px():
        estimate = np.asarray(compiled.warps(state.pose), np.float64)
        return float(corner_errors(photo, estimate, task.H_image_patch)[1:].mean())

    losses, curve = [], [corner_px()]
    for first in range(0, steps, CHUNK):
        state, value = compiled.advance(state, rgb, jnp.asarray(first))
        losses.append(float(value))
        curve.append(corner_px())
        if on_chunk is not None:
            on_chunk(first + CHUNK, losses[-1], curve[-1])
    image = fields.set_progress(state.image, jnp.ones(()))
    warps = compiled.warps(state.pose)
    place = jax.vmap(jax.vmap(apply, (None, 0)), (0, None))(warps, jnp.asarray(compiled.points, jnp.float32))
    error = np.asarray(compiled.colours(image, place.reshape(-1, 2)), np.float64) - task.rgb.reshape(-1, 3)
    psnr = float(-10 * np.log10(np.mean(error**2)))
    return Aligned(image, np.asarray(warps, np.float64), np.array(losses), np.array(curve), psnr)


def picture(compiled: Aligner, photo: Photo, aligned: Aligned) -> Float[np.ndarray, "h w 3"]:
    """The neural image on the pixels of the photograph, in [0, 1]."""
    height, width = photo.rgb.shape[:2]
    x, y = (np.arange(width) + 0.5 - width / 2), (np.arange(height) + 0.5 - height / 2)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / photo.unit
    colours = compiled.colours(aligned.image, jnp.asarray(xy, jnp.float32))
    return np.asarray(colours, np.float64).reshape(height, width, 3)


def _query(image: ImageField, params: Any, place: Float[Array, "n k 2"]) -> Float[Array, "n k 3"]:
    # As one list of points, so that every layer is one plain product.
    rgb = jax.vmap(image.query, (None, 0))(params, place.reshape(-1, 2))
    return rgb.reshape(*place.shape[:2], 3)
