"""A map as seen from any pose: rays that march to the first surface, and look closely there."""

from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxpose.geometry.camera import Camera, pixel_grid, unproject
from jaxpose.scenes import SceneField
from jaxpose.slam.config import SampleConfig
from jaxpose.slam.observation import Pixels, render_pixels

_CHUNK = 4800  # rays rendered in one call
_NEAREST = 0.02  # [m]
_FREE, _STRIDE = (
    0.99,
    0.9,
)  # truncations: a distance from which on no surface is near, and how far one goes there
_BACKGROUND = 0.86  # grey where there is no surface


@runtime_checkable
class Viewer(Protocol):
    """Colour in [0, 1] and depth [m] (0: nothing there) at pixels (u, v), seen from T_world_cam.

    `params` are the scene's, `bounds` [m] the lower and upper corner of what it fills.
    """

    def __call__(
        self,
        params: Any,
        bounds: Float[np.ndarray, "2 3"],
        T_world_cam: Float[np.ndarray, "4 4"],
        pixels: Int[np.ndarray, "h w 2"],
    ) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]: ...


def viewer(scene: SceneField, truncation: float, camera: Camera) -> Viewer:
    """The view of a scene of signed distance that is cut off at `truncation` [m].

    Compiled once, whatever the pixels and however far the scene reaches. Rays march by a third of the
    truncation, faster where no surface is near, until all have gone behind a surface or left the scene.
    """
    fine = SampleConfig(band=truncation / 2, width=truncation / 24)
    step = truncation / 3

    @jax.jit
    def render(
        params, bounds: Float[Array, "2 3"], T_world_cam: Float[Array, "4 4"], pixel: Float[Array, "n 2"]
    ):
        query, direction = partial(scene.query, params), unproject(camera, pixel)
        along = jnp.einsum("ij,nj->ni", T_world_cam[:3, :3], direction, precision="highest")
        origin = T_world_cam[:3, 3]
        safe = jnp.where(jnp.abs(along) < 1e-9, 1e-9, along)
        sides = (bounds[:, None] - origin[None, None]) / safe[None]
        leaves = jnp.min(jnp.max(sides, axis=0), axis=-1)

        def march(carry):
            depth, distance, surface = carry
            ahead = depth + jnp.where(distance > _FREE * truncation, _STRIDE * truncation, step)
            points = origin[None] + ahead[:, None] * along
            found, _ = jax.vmap(query)(points, along)
            enters = (surface == 0) & (distance > 0) & (found <= 0)
            share = distance / jnp.where(enters, distance - found, 1)
            return ahead, found, jnp.where(enters, depth + share * (ahead - depth), surface)

        def goes_on(carry):
            depth, _, surface = carry
            return jnp.any((surface == 0) & (depth < leaves))

        zero = jnp.zeros(direction.shape[0])
        *_, surface = jax.lax.while_loop(goes_on, march, (zero + _NEAREST, zero, zero))
        pixels = Pixels(direction, surface, jnp.zeros_like(direction))
        seen = render_pixels(query, T_world_cam, pixels, jnp.float32(1.0), fine)
        there = (surface > 0) & (seen.opacity > 0.5)
        return jnp.where(there[:, None], seen.rgb, _BACKGROUND), jnp.where(there, seen.depth, 0)

    def look(params, bounds, T_world_cam, pixels):
        where, count = [jnp.asarray(x, jnp.float32) for x in (bounds, T_world_cam)], pixels[..., 0].size
        padded = np.arange(-(-count // _CHUNK) * _CHUNK) % count  # whole chunks: one shape is compiled
        chunks = pixels.reshape(-1, 2)[padded].reshape(-1, _CHUNK, 2)
        parts = [jax.device_get(render(params, *where, jnp.asarray(chunk, jnp.float32))) for chunk in chunks]
        rgb, depth = (np.concatenate(x)[:count] for x in zip(*parts, strict=True))
        return rgb.reshape(*pixels.shape[:2], 3), depth.reshape(pixels.shape[:2])

    return look


def every(camera: Camera, width: int) -> Int[np.ndarray, "h w 2"]:
    """Every few pixels (u, v) of an image, to make a picture of about this width."""
    return pixel_grid(camera, max(1, round(camera.width / width))).astype(int)
