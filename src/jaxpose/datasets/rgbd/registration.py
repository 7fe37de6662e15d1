"""Depth of one camera as another camera beside it sees it."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, pixel_grid, project_numpy, unproject_numpy

_NEAREST_M = 1e-3


def register_depth(
    depth_camera: Camera,
    color_camera: Camera,
    T_color_depth: Float[np.ndarray, "4 4"],
    *,
    rays: Float[np.ndarray, "h w 3"] | None = None,
) -> Callable[[Float[np.ndarray, "h w"]], Float[np.ndarray, "H W"]]:
    """Register depth to colour: each pixel of depth becomes a patch as large as it looks, the nearest wins.

    Args:
        depth_camera: The camera that measured depth.
        color_camera: The camera whose pixels are to have it.
        T_color_depth: Where the first is in the second's axes.
        rays: Of the first's pixels, where its lens is none that `Camera` has; NaN where there is none.

    Returns:
        A function from depth [m] of the first, 0 where there is none, to that of the second, float32.
    """
    if rays is None:
        rays = unproject_numpy(depth_camera, pixel_grid(depth_camera))
    rays = rays.reshape(-1, 3)
    there = np.isfinite(rays).all(axis=1)
    half = np.array([color_camera.fx / depth_camera.fx, color_camera.fy / depth_camera.fy]) / 2
    columns, rows = (range(int(np.ceil(2 * size)) + 1) for size in half)
    height, width = color_camera.height, color_camera.width

    def register(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "H W"]:
        known = (depth.reshape(-1) > 0) & there
        points = rigid.apply(T_color_depth, rays[known] * depth.reshape(-1)[known, None].astype(np.float64))
        points = points[points[:, 2] > _NEAREST_M]
        pixel = project_numpy(color_camera, points)
        first, end = np.ceil(pixel - half).astype(int), np.ceil(pixel + half).astype(int)
        image = np.full((height, width), np.inf, np.float32)
        z = points[:, 2].astype(np.float32)
        for across in columns:
            for down in rows:
                u, v = first[:, 0] + across, first[:, 1] + down
                seen = (u < end[:, 0]) & (v < end[:, 1]) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
                np.minimum.at(image, (v[seen], u[seen]), z[seen])
        return np.where(np.isfinite(image), image, 0)

    return register
