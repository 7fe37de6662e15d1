"""Depth images from a scanned point cloud: projected with a z-buffer, gaps filled with the nearest pixel."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import distance_transform_edt, minimum_filter

from jaxpose.geometry import rigid, se3
from jaxpose.geometry.camera import Camera, project

_WINDOW = 9  # [px] wide: within it the nearest point hides those behind it
_BEHIND = 0.1  # share of its depth by which a point must be farther to be hidden; slanted floors are not
_REACH = 20.0  # [px] a gap is filled from; wider ones, such as open windows, stay without depth
_NEAREST = 0.05  # [m]


def depth_from_cloud(
    camera: Camera, points_world: Float[np.ndarray, "n 3"]
) -> Callable[[Float[np.ndarray, "4 4"]], Float[np.ndarray, "h w"]]:
    """A function from `T_world_cam` to depth [m] along the optical axis, 0 where there is none.

    Every pixel takes the depth of the nearest pixel, within 20, that a visible point falls on. A scan is
    sparser than an image, so walls show through what stands before them: a point is hidden if another within
    4 pixels is nearer by more than a tenth.
    """
    points = jnp.asarray(points_world, jnp.float32)

    @jax.jit
    def look(T_cam_world: Float[Array, "4 4"]) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
        point_cam = se3.apply(T_cam_world[None], points)
        z = point_cam[:, 2]
        return project(camera, jnp.where(z[:, None] > _NEAREST, point_cam, -1)), z

    def depth(T_world_cam: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "h w"]:
        pixel, z = (np.asarray(x) for x in look(jnp.asarray(rigid.inverse(T_world_cam), jnp.float32)))
        column, row = np.rint(pixel).astype(np.int64).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        column, row, z = column[inside], row[inside], z[inside]
        image = np.full((camera.height, camera.width), np.inf, np.float32)
        np.minimum.at(image, (row, column), z)
        image[image > (1 + _BEHIND) * minimum_filter(image, _WINDOW, mode="nearest")] = np.inf
        return _filled(image)

    return depth


def _filled(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Infinite pixels take the nearest finite one's value, 0 where that is out of reach."""
    empty = np.isinf(image)
    if empty.all():
        return np.zeros_like(image)
    distance, (row, column) = distance_transform_edt(empty, return_indices=True)  # type: ignore[misc]
    return np.where(distance <= _REACH, image[row, column], 0).astype(np.float32)
