"""Motion from events by contrast maximisation: warped along the right motion, they fall on edges.

Gallego, Rebecq, Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras" (CVPR 2018).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from jaxpose.errors import DataError
from jaxpose.events.types import Events, check_events
from jaxpose.geometry.camera import Camera, project, unproject

_LEAST = 100  # events
_BLUR = np.exp(-0.5 * np.arange(-3, 4) ** 2) / np.sum(np.exp(-0.5 * np.arange(-3, 4) ** 2))  # sigma 1 px
_DIRECTIONS, _PIXELS = 12, (5.0, 15.0, 45.0)  # first tries: directions, and how far a pixel goes
_GRID = (6, 8)  # of inverse depths, rows and columns
_SMOOTH = 0.02  # weight of the squared differences of neighbouring log inverse depths


class Displacement(NamedTuple):
    """A constant velocity parallel to the image and how near things are; lengths in typical depths."""

    velocity: Float[np.ndarray, "3"]  # [1/s] of the camera in its own axes
    inverse_depth: Float[np.ndarray, "rows columns"]  # over the image, geometric mean 1
    contrast: float


class Located(NamedTuple):
    """Events with where they look, for warping."""

    direction: Float[Array, "n 3"]  # of length 1 along z
    t: Float[Array, " n"]  # [s] since the middle
    polarity: Float[Array, " n"]


def locate(camera: Camera, events: Events) -> Located:
    """Events on the plane z = 1, their distortion undone, and their times from the middle of the span.

    Args:
        camera: That saw the events.
        events: At least one.

    Returns:
        What `warped` takes.

    Raises:
        ValueError: For columns of another shape or type, and for no event.
    """
    check_events(events)
    if not len(events.t):
        raise ValueError("events: expected at least 1, got none")
    pixel = jnp.asarray(np.stack([events.x, events.y], -1), jnp.float32)
    t = events.t - (events.t[0] + events.t[-1]) / 2
    return Located(
        unproject(camera, pixel), jnp.asarray(t, jnp.float32), jnp.asarray(events.polarity, jnp.float32)
    )


def warped(
    camera: Camera, events: Located, inverse_depth: Float[Array, " n"], velocity: Float[Array, "3"]
) -> Float[Array, "h w"]:
    """Sum of polarities where the events' points are seen at the middle of the time, blurred by a pixel.

    Args:
        camera: The image is a pinhole's of its focal length and size.
        events: Of `locate`.
        inverse_depth: Of each event (n,), in the inverse of a unit of length.
        velocity: The camera's (3,) in its own axes, in that unit per second.

    Returns:
        (h, w).
    """
    displacement = (events.t * inverse_depth)[:, None] * velocity[None]
    x, y = project(_pinhole(camera), events.direction + displacement).T
    column, row = jnp.floor(x), jnp.floor(y)
    image = jnp.zeros((camera.height, camera.width), x.dtype)
    for right, below in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = jnp.abs(1 - right - (x - column)) * jnp.abs(1 - below - (y - row))
        place = (row + below).astype(jnp.int32), (column + right).astype(jnp.int32)
        # Negative indices would count from the end.
        inside = (place[0] >= 0) & (place[1] >= 0)
        image = image.at[place].add(jnp.where(inside, share * events.polarity, 0), mode="drop")
    for kernel in (_BLUR[:, None], _BLUR[None]):
        image = jax.scipy.signal.convolve(image, jnp.asarray(kernel, x.dtype), mode="same")
    return image


def find_displacement(camera: Camera, events: Events) -> Displacement:
    """The velocity parallel to the image, and the depths, that make the warped events' contrast largest.

    Contrast is the variance of `warped` (Gallego et al., CVPR 2018). A short recording does not tell depth
    that grows across the image from motion along the optical axis, so that is taken to be none; nor are
    turns.

    Args:
        camera: That saw the events.
        events: At least 100.

    Returns:
        Velocity and inverse depths; lengths are in typical depths.

    Raises:
        DataError: For few events.
        ValueError: For columns of another shape or type.
    """
    if len(events.t) < _LEAST:
        raise DataError(f"motion from events: expected at least {_LEAST} events, got {len(events.t)}")
    located = locate(camera, events)
    sample = _sampler(camera, located)
    span = float(events.t[-1] - events.t[0])

    def loss(params):
        log_inverse = params[2:].reshape(_GRID)
        image = warped(camera, located, sample(_positive(log_inverse)), jnp.append(params[:2], 0.0))
        rough = jnp.sum(jnp.diff(log_inverse, axis=0) ** 2) + jnp.sum(jnp.diff(log_inverse, axis=1) ** 2)
        # Against the contrast at rest, so that the weight of smoothness means the same for all data.
        return -jnp.var(image) / at_rest + _SMOOTH * rough

    at_rest = jnp.var(warped(camera, located, jnp.ones(len(events.t)), jnp.zeros(3)))
    flat = np.zeros(_GRID[0] * _GRID[1])
    first_tries = [
        np.concatenate([pixels / camera.fx / span * np.array([np.cos(angle), np.sin(angle)]), flat])
        for pixels in _PIXELS
        for angle in np.linspace(0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    ]
    values = jax.jit(lambda tries: jax.lax.map(loss, tries))(jnp.asarray(np.stack(first_tries), jnp.float32))
    slope = jax.jit(jax.value_and_grad(loss))
    found = minimize(
        lambda params: [np.asarray(x, np.float64) for x in slope(jnp.asarray(params, jnp.float32))],
        first_tries[int(np.argmin(values))],
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 150},
    )
    params = jnp.asarray(found.x, jnp.float32)
    inverse_depth = _positive(params[2:].reshape(_GRID))
    velocity = jnp.append(params[:2], 0.0)
    contrast = float(jnp.var(warped(camera, located, sample(inverse_depth), velocity)))
    return Displacement(np.asarray(velocity, np.float64), np.asarray(inverse_depth, np.float64), contrast)


def _pinhole(camera: Camera) -> Camera:
    """The camera without its distortion."""
    return camera._replace(distortion=())


def _positive(log_inverse: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """Inverse depths whose geometric mean is 1: together with velocity they have no scale."""
    return jnp.exp(log_inverse - log_inverse.mean())


def _sampler(camera: Camera, events: Located):
    """A function from inverse depths on a grid over the image to those of the events, bilinear."""
    rows, columns = _GRID
    x, y = project(_pinhole(camera), events.direction).T
    x, y = x / camera.width * (columns - 1), y / camera.height * (rows - 1)
    x, y = jnp.clip(x, 0, columns - 1.001), jnp.clip(y, 0, rows - 1.001)
    column, row = jnp.floor(x), jnp.floor(y)
    right, below = x - column, y - row
    column, row = column.astype(jnp.int32), row.astype(jnp.int32)

    def sample(values):
        upper = values[row, column] * (1 - right) + values[row, column + 1] * right
        lower = values[row + 1, column] * (1 - right) + values[row + 1, column + 1] * right
        return upper * (1 - below) + lower * below

    return sample
