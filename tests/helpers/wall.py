"""A plane in front of a camera, in closed form, for planes, mapping and paint."""

import jax.numpy as jnp
import numpy as np

from jaxpose.geometry.camera import Camera, pixel_direction

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)


def rays(camera=CAMERA):
    """The rays of all pixels in camera axes (z = 1)."""
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.asarray(pixel_direction(camera, jnp.asarray(np.stack([column, row], -1), jnp.float32)))


def wall(normal, distance, camera=CAMERA):
    """Depth of the plane n . x + distance = 0, and its unit normal n along `normal`."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    return (-distance / (rays(camera) @ normal)).astype(np.float32), normal
