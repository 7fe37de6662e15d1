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
from jaxpose.scenes.voxel_blocks import (
    CELLS,
    SAMPLED,
    BlockConfig,
    Blocks,
    decoded_channel,
    holds_surface,
    packed,
)
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.observation import back_project, locate, read_pixels

_PENDING = 1_000_000  # points
_TOGETHER = 256  # blocks that are taken apart at once
_EMPTY = (
    np.zeros((0, 3)),
    np.zeros((0, 3), np.float32),
    np.zeros(0, bool),
    np.zeros(0, bool),
    np.zeros((0, 3), int),
)


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

    kept, pending = (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8)), []
    for keyframe in keyframes:
        seen = np.asarray(keyframe.image.depth) > 0
        found = measured(keyframe.image, jnp.asarray(keyframe.T_world_cam, jnp.float32))
        points = np.asarray(found, np.float64)[seen.ravel()]
        pending.append(_first_of_each((_cubes(points, voxel), points, np.asarray(keyframe.image.rgb)[seen])))
        if sum(len(x[0]) for x in pending) > max(len(kept[0]), _PENDING):  # so that memory stays bounded
            kept, pending = _joined([kept, *pending]), []
    _, points, colours = _joined([kept, *pending])
    return Surface(points, colours, np.zeros((0, 3), np.int64))


def _cubes(points: Float[np.ndarray, "n 3"], side: float) -> Int[np.ndarray, " n"]:
    """The cube of space that each point is in, as one number: a million of them to either side."""
    x, y, z = np.floor(points / side).astype(np.int64).T + (1 << 20)
    return (x << 42) + (y << 21) + z


def _first_of_each(items: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Of arrays that go with cubes (the first of them), what came first in each cube, in order."""
    first = np.sort(np.unique(items[0], return_index=True)[1])
    return tuple(x[first] for x in items)


def _joined(parts: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    return _first_of_each(tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def mesh(
    config: BlockConfig, blocks: Blocks, keyframes: Iterable[Keyframe], camera: Camera, earlier: int = 0
) -> Surface:
    """The zero of a map's signed distance by marching cubes, culled to what the keyframes have measured.

    A point lies between two nodes that were both measured: behind a surface, where measuring ends, distances
    change their sign too. It counts as seen where a keyframe has measured a depth within the map's truncation
    of it, or within the first blocks, `earlier` of them, which are of a run whose keyframes are not at hand.
    Needs scikit-image (extra `mesh`); ImportError without.
    """
    from skimage.measure import marching_cubes

    coords, stored = packed(blocks)
    rows, parts, count = np.flatnonzero(holds_surface(stored)), list[tuple[np.ndarray, ...]]([_EMPTY]), 0
    for start in range(0, len(rows), _TOGETHER):
        some = rows[start : start + _TOGETHER]
        distance, *colour, weight = (
            decoded_channel(config, k, stored[some, ..., k]) for k in (0, 1, 2, 3, SAMPLED)
        )
        # In skimage's words the triangles' front then faces growing distances: free space.
        surfaces = [marching_cubes(nodes, level=0.0, gradient_direction="descent")[:2] for nodes in distance]
        lengths = [len(corners) for corners, _ in surfaces]
        block = np.repeat(np.arange(len(some)), lengths)
        cells, faces = (np.concatenate(x) for x in zip(*surfaces, strict=True))
        rgb = [map_coordinates(x, (block, *cells.T), order=1, mode="nearest") for x in colour]
        low, high = ((block, *end(cells).astype(int).T) for end in (np.floor, np.ceil))
        known, first = (weight[low] > 0) & (weight[high] > 0), count + np.cumsum([0, *lengths[:-1]])
        faces = faces + np.repeat(first, [len(triangles) for _, triangles in surfaces])[:, None]
        corners = CELLS * coords[some][block] + cells.astype(np.float64)
        parts.append((corners, np.stack(rgb, axis=-1), known, some[block] < earlier, faces))
        count += len(cells)
    cells, rgb, known, before, faces = map(np.concatenate, zip(*parts, strict=True))
    del parts
    # Blocks share their outer nodes, and so the corners between them.
    place = _cubes(cells - np.min(cells, axis=0, initial=np.inf), 1 / 64)
    _, first, which = np.unique(place, return_index=True, return_inverse=True)
    cells, rgb, known, before = cells[first], rgb[first], known[first], before[first]
    faces = np.asarray(which)[faces.astype(np.int64)]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)  # no two corners have become one
    points = config.voxel * cells
    measured, asked = known.copy(), np.flatnonzero(known & ~before)
    measured[asked] = _seen(points[asked], keyframes, camera, config.truncation)
    kept = whole & measured[faces].all(axis=1)
    used, faces = np.unique(faces[kept], return_inverse=True)
    colour = np.round(255 * np.clip(rgb[used], 0, 1)).astype(np.uint8)
    return Surface(points[used], colour, faces.reshape(-1, 3).astype(np.int64))


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
