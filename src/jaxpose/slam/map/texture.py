"""Colour finer than a map's cells: its surface, painted from the keyframes when the run is over.

Colour changes faster along a surface than its distance does, and a camera is tracked by the latter. So the
map that is tracked against keeps coarse colour, and only what is rendered, or saved, has this.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.scenes import GridConfig, SceneField
from jaxpose.scenes.voxel_grid import trilinear
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.map.normals import seen_by
from jaxpose.slam.observation import locate

_FINER = 2  # cells of paint along one of the map's
_COAT = 1.2  # cells of paint to either side of the surface
_SAME = 2.0  # cells of the map that a measured surface may be off the map's
_PAINTED = 0.25  # weight of painted nodes around a point from which on they give its colour
_TILE = 16  # cells of paint along each side of what is kept, or empty, as one


class Texture(NamedTuple):
    """Red, green, blue and 255 (0: none) at nodes near a surface, in tiles that share their outer nodes.

    `slot` says where in `tiles` a tile of space is; tile 0 is the empty one.
    """

    slot: Int[Any, "a b c"]
    tiles: UInt8[Any, "n 17 17 17 4"]


def make_texture(
    grid: GridConfig, distance: Float[np.ndarray, "x y z"], keyframes: Iterable[Keyframe], camera: Camera
) -> Texture:
    """The surface of a map painted from keyframes, at nodes `_FINER` times as dense as the map's.

    `distance` [m] is the map's signed distance. A node's colour is the mean over the keyframes that measured
    the surface there, weighted by how many pixels a piece of it fills.
    """
    nodes = _coat(grid, distance)
    points = np.asarray(grid.lower, np.float32) + np.float32(grid.voxel / _FINER) * nodes.astype(np.float32)
    near = _SAME * grid.voxel

    @jax.jit
    def add(total, points, image, T_world_cam):
        points_cam = se3.apply(se3.inverse(T_world_cam), points)
        at = locate(camera, points_cam)
        seen = seen_by(image, camera)(at)
        same = (seen.weight > 0) & (jnp.abs(seen.distance(points_cam)) < near)
        filled = jnp.maximum(seen.incidence_cosine(points_cam), 0) / jnp.maximum(at.depth, 0.1) ** 3
        weight = jnp.where(same, filled, 0)[:, None]
        return total + weight * jnp.concatenate([seen.rgb, jnp.ones_like(weight)], axis=-1)

    total, on_device = jnp.zeros((len(nodes), 4)), jnp.asarray(points)
    for keyframe in keyframes:
        total = add(total, on_device, keyframe.image, jnp.asarray(keyframe.T_world_cam, jnp.float32))
    rgb, weight = np.split(np.asarray(total), [3], axis=-1)
    there = weight[:, 0] > 0
    colour = np.round(255 * rgb[there] / weight[there])
    texture = np.concatenate([colour, np.full((len(colour), 1), 255)], axis=1).astype(np.uint8)
    return _tiled(nodes[there], texture, _FINER * (np.array(distance.shape) - 1))


def textured(scene: SceneField, grid: GridConfig) -> SceneField:
    """A map's scene with its paint: parameters (values, paint); the map's own colour where there is none."""

    def query(params, point, direction):
        *values, texture = params
        distance, rgb = scene.query(tuple(values), point, direction)
        position = (point - jnp.asarray(grid.lower, point.dtype)) * (_FINER / grid.voxel)
        tile = jnp.clip(position / _TILE, 0, jnp.array(texture.slot.shape, point.dtype) - 1).astype(jnp.int32)
        within = position - _TILE * tile.astype(point.dtype)
        # All tiles one behind the other: a position within its own reads no other.
        row = texture.slot[tuple(tile)] * (_TILE + 1)
        behind = jnp.array([1, 0, 0], point.dtype) * row.astype(point.dtype)
        tiles = texture.tiles.reshape(-1, *texture.tiles.shape[2:])
        colour, alpha = jnp.split(trilinear(tiles, jnp.clip(within, 0, _TILE) + behind) / 255, [3])
        return distance, jnp.where(alpha > _PAINTED, colour / jnp.maximum(alpha, _PAINTED), rgb)

    return SceneField(scene.init, query)


def _tiled(
    nodes: Int[np.ndarray, "m 3"], texture: UInt8[np.ndarray, "m 4"], cells: Int[np.ndarray, "3"]
) -> Texture:
    """Painted nodes in tiles; a node on the side of a tile is in its neighbour too."""
    count = -(-cells // _TILE)
    where, within, which = [], [], []
    for back in np.ndindex(2, 2, 2):
        tile = nodes // _TILE - np.array(back)
        local = nodes - _TILE * tile
        kept = np.flatnonzero(((local <= _TILE) & (tile >= 0) & (tile < count)).all(axis=1))
        where.append(np.ravel_multi_index(tuple(tile[kept].T), tuple(count)))
        within.append(local[kept])
        which.append(kept)
    used, place = np.unique(np.concatenate(where), return_inverse=True)
    slot = np.zeros(int(np.prod(count)), np.int32)
    slot[used] = np.arange(1, len(used) + 1)
    tiles = np.zeros((len(used) + 1, *(_TILE + 1,) * 3, 4), np.uint8)
    tiles[(place + 1, *np.concatenate(within).T)] = texture[np.concatenate(which)]
    return Texture(slot.reshape(count), tiles)


def _coat(grid: GridConfig, distance: Float[np.ndarray, "x y z"]) -> Int[np.ndarray, "m 3"]:
    """The nodes of paint whose trilinear distance is within the coat, slab by slab."""
    thick = _COAT * grid.voxel / _FINER
    found = []
    for x, slab in enumerate(zip(distance[:-1], distance[1:], strict=True)):
        for k in range(_FINER):
            share = k / _FINER
            between = _refined(_refined((1 - share) * slab[0] + share * slab[1], 0), 1)
            v, w = np.nonzero(np.abs(between) < thick)
            found.append(np.stack([np.full(len(v), _FINER * x + k), v, w], axis=-1))
    return np.concatenate(found)


def _refined(plane: Float[np.ndarray, "y z"], axis: int) -> Float[np.ndarray, "_ _"]:
    """Linear interpolation between the nodes along one axis."""
    at = np.arange(_FINER * (plane.shape[axis] - 1) + 1) / _FINER
    low = np.minimum(at.astype(int), plane.shape[axis] - 2)
    share = np.expand_dims((at - low).astype(plane.dtype), 1 - axis)
    return (1 - share) * np.take(plane, low, axis) + share * np.take(plane, low + 1, axis)
