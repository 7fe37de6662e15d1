"""What a map looks like to other programs: a coloured point cloud, and a mesh of what was seen."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import map_coordinates

from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.scenes import GridConfig
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.observation import back_project, locate, read_pixels


class Surface(NamedTuple):
    """Points of the world [m] with their colours, and triangles between them; of a cloud there are none.

    Triangles turn counter-clockwise as seen from the free side.
    """

    points: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]


def point_cloud(keyframes: Iterable[Keyframe], camera: Camera, voxel: float) -> Surface:
    """Measured points of the keyframes, one (the first that came) in each cube of `voxel` [m]."""
    row, column = (jnp.asarray(x.ravel()) for x in np.mgrid[: camera.height, : camera.width])

    @jax.jit
    def measured(image, T_world_cam):
        return back_project(read_pixels(image, camera, row, column), T_world_cam)

    points, colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    for keyframe in keyframes:
        seen = np.asarray(keyframe.image.depth) > 0
        found = measured(keyframe.image, jnp.asarray(keyframe.T_world_cam, jnp.float32))
        points = np.concatenate([points, np.asarray(found, np.float64)[seen.ravel()]])
        colours = np.concatenate([colours, np.asarray(keyframe.image.rgb)[seen]])
        first = np.unique(np.floor(points / voxel).astype(np.int64), axis=0, return_index=True)[1]
        points, colours = points[np.sort(first)], colours[np.sort(first)]  # so that memory stays bounded
    return Surface(points, colours, np.zeros((0, 3), np.int64))


def mesh(
    grid: GridConfig,
    values: Float[np.ndarray, "x y z 4"],
    keyframes: Iterable[Keyframe],
    camera: Camera,
) -> Surface:
    """The zero of a map's signed distance by marching cubes, culled to what the keyframes have measured.

    `values` are those of the finest level (`scenes.merge`). A point counts as seen where a keyframe has
    measured a depth within the grid's truncation of it. Needs scikit-image (extra `mesh`); ImportError
    without.
    """
    from skimage.measure import marching_cubes

    distance = values[..., 0]
    if not distance.min() < 0 < distance.max():
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.int64))
    # In skimage's words the triangles' front then faces growing distances: free space.
    cells, faces, _, _ = marching_cubes(distance, level=0.0, gradient_direction="descent")
    points = np.asarray(grid.lower) + grid.voxel * cells.astype(np.float64)
    channels = [map_coordinates(values[..., k], cells.T, order=1, mode="nearest") for k in (1, 2, 3)]
    rgb = np.round(255 * np.clip(np.stack(channels, axis=-1), 0, 1)).astype(np.uint8)
    kept = _seen(points, keyframes, camera, grid.truncation)[faces].all(axis=1)
    used, faces = np.unique(faces[kept], return_inverse=True)
    return Surface(points[used], rgb[used], faces.reshape(-1, 3).astype(np.int64))


def _seen(
    points: Float[np.ndarray, "n 3"], keyframes: Iterable[Keyframe], camera: Camera, band: float
) -> Bool[np.ndarray, " n"]:
    """Whether a keyframe has measured a depth within `band` [m] of each point's."""

    @jax.jit
    def by(points, image, T_world_cam):
        at = locate(camera, se3.apply(se3.inverse(T_world_cam), points))
        depth = image.depth[at.row, at.column]
        return at.inside & (depth > 0) & (jnp.abs(depth - at.depth) < band)

    as_float = jnp.asarray(points, jnp.float32)
    seen = np.zeros(len(points), bool)
    for keyframe in keyframes:
        seen |= np.asarray(by(as_float, keyframe.image, jnp.asarray(keyframe.T_world_cam, jnp.float32)))
    return seen
