"""A plane in front of a camera, in closed form, for planes, mapping and paint."""

import numpy as np

from jaxpose.geometry.camera import Camera, pixel_grid, unproject_numpy

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)


def rays(camera=CAMERA):
    """The rays of all pixels in camera axes (z = 1)."""
    return unproject_numpy(camera, pixel_grid(camera))


def wall(normal, distance, camera=CAMERA):
    """Depth of the plane n . x + distance = 0, and its unit normal n along `normal`."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    return (-distance / (rays(camera) @ normal)).astype(np.float32), normal
