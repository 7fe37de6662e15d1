"""Texture: colour finer than a map's cells, painted onto its surface from keyframes when a run is over.

Colour changes faster along a surface than its distance does, and a camera is tracked by the latter. So the
map that is tracked against keeps coarse colour, and only what is rendered, or saved, has this.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, UInt8

from jaxpose._memory import give_back_memory
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.scenes import SceneField
from jaxpose.scenes.voxel_blocks import (
    CELLS,
    BlockConfig,
    Blocks,
    block_at,
    decoded_channel,
    trilinear_in_block,
)
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.map.integrate import in_view_test, seen_by
from jaxpose.slam.observation import locate

_FINER = 2  # texture cells along one of the map's
SIDE = _FINER * CELLS + 1  # nodes along each side of a tile, which is a block with its outer nodes
_THICKNESS = 1.2  # texture cells to either side of the surface
_SAME = 2.0  # cells of the map that a measured surface may be off the map's
_PAINTED = 0.25  # weight of painted nodes around a point from which on they give its colour
_TOGETHER = 1 << 18  # nodes that are written to their tiles in one go
_NEIGHBOURS = 64  # tiles whose nodes are looked at, or skipped, in one go


class Texture(NamedTuple):
    """Red, green, blue and 255 (0: none) at nodes near a surface, in one tile for each block with surface.

    `slot` says where in `tiles` the tile of each row of the map's blocks is; tile 0 is the empty one.
    """

    slot: Int[Any, " c"]
    tiles: UInt8[Any, "n 17 17 17 4"]


def make_texture(
    config: BlockConfig, blocks: Blocks, keyframes: Iterable[Keyframe], camera: Camera
) -> Texture:
    """The surface of a map painted from keyframes, at nodes twice as dense as the map's.

    A node's colour is the mean over the keyframes that measured the surface there, weighted by how many
    pixels a piece of it fills.
    """
    give_back_memory()  # what the final trajectory has freed
    count, capacity = int(blocks.count), blocks.coords.shape[0]
    rows, tile, within = _near_surface(config, np.asarray(blocks.values)[:count])
    if not len(rows):
        return Texture(np.zeros(capacity, np.int32), np.zeros((1, SIDE, SIDE, SIDE, 4), np.uint8))
    # The nodes near the surface of all tiles in turn, those of a few tiles next to each other in one chunk.
    size = max(len(tile) * _NEIGHBOURS // len(rows), 1)
    index = np.empty((-(-len(tile) // size), size, 3), np.int32)
    flat, first = index.reshape(-1, 3), _FINER * CELLS * np.asarray(blocks.coords)[rows]
    for some in _slices(len(tile)):
        flat[some] = first[tile[some]] + within[some]
    flat[len(tile) :] = flat[len(tile) - 1]
    ends = np.stack([index.min(axis=1), index.max(axis=1)])
    corners = np.stack([ends[list(k), :, [0, 1, 2]].T for k in np.ndindex(2, 2, 2)], axis=1)
    side, total = config.voxel / _FINER, jnp.zeros((*index.shape[:2], 4))
    add, nodes = _make_add(camera, side, _SAME * config.voxel), (jnp.asarray(index), jnp.asarray(corners))
    del index, flat
    for keyframe in keyframes:
        total = add(total, *nodes, keyframe.image, jnp.asarray(keyframe.T_world_cam, jnp.float32))
    del nodes
    tiles = np.zeros((len(rows) + 1, SIDE, SIDE, SIDE, 4), np.uint8)
    painted = np.asarray(total).reshape(-1, 4)
    for some in _slices(len(tile)):
        there = painted[some, 3] > 0
        place = (tile[some][there] + 1, *within[some][there].T)
        rgb, weight = np.split(painted[some][there], [3], axis=-1)
        tiles[(*place, slice(0, 3))] = np.round(255 * rgb / weight)
        tiles[(*place, 3)] = 255
    slot = np.zeros(capacity, np.int32)
    slot[rows] = np.arange(1, len(rows) + 1)
    return Texture(slot, tiles)


def painted_over(earlier: Texture, texture: Texture) -> Texture:
    """The texture, and beneath it that of an earlier run, whose blocks are the first of the same map."""
    slot, tiles, beneath = texture.slot.copy(), texture.tiles.copy(), np.asarray(earlier.tiles)
    rows = np.flatnonzero(earlier.slot)
    both, alone = rows[slot[rows] > 0], rows[slot[rows] == 0]
    for row in both:
        tile = tiles[slot[row]]
        tiles[slot[row]] = np.where(tile[..., 3:] > 0, tile, beneath[earlier.slot[row]])
    slot[alone] = len(tiles) + np.arange(len(alone))
    return Texture(slot, np.concatenate([tiles, beneath[earlier.slot[alone]]]))


def _slices(count: int) -> list[slice]:
    """Nodes in turn, a few at a time."""
    return [slice(k, min(k + _TOGETHER, count)) for k in range(0, count, _TOGETHER)]


def textured(scene: SceneField, config: BlockConfig) -> SceneField:
    """A map's scene with its texture, parameters (blocks, texture); else the map's own colour."""

    def query(params, point, direction):
        blocks, texture = params
        distance, rgb = scene.query(blocks, point, direction)
        row, local = block_at(config, blocks, point)
        as_float = lambda node: node.astype(local.dtype)
        painted = trilinear_in_block(texture.tiles, texture.slot[row], _FINER * local, as_float) / 255
        colour, alpha = painted[:3], painted[3:]
        return distance, jnp.where(alpha > _PAINTED, colour / jnp.maximum(alpha, _PAINTED), rgb)

    return SceneField(scene.init, query)


def _make_add(camera: Camera, side: float, near: float):
    """The compiled step that adds what a keyframe shows to the colours (m, s, 4) of chunks of nodes."""
    in_view = in_view_test(camera)

    @partial(jax.jit, donate_argnums=0)
    def add(total, index, corners, image, T_world_cam):
        T_cam_world, seen_at = se3.inverse(T_world_cam), seen_by(image, camera)
        place = lambda index: side * index.astype(jnp.float32)
        in_sight = in_view(se3.apply(T_cam_world, place(corners)), jnp.max(image.depth) + near)
        order = jnp.argsort(~in_sight)

        def add_chunk(n, total):
            points_cam = se3.apply(T_cam_world, place(index[order[n]]))
            at = locate(camera, points_cam)
            seen = seen_at(at)
            same = (seen.weight > 0) & (jnp.abs(seen.distance(points_cam)) < near)
            filled = jnp.maximum(seen.incidence_cosine(points_cam), 0) / jnp.maximum(at.depth, 0.1) ** 3
            weight = jnp.where(same, filled, 0)[:, None]
            colour = weight * jnp.concatenate([seen.rgb, jnp.ones_like(weight)], axis=-1)
            return total.at[order[n]].add(colour)

        return jax.lax.fori_loop(0, jnp.sum(in_sight), add_chunk, total)

    return add


def _near_surface(
    config: BlockConfig, values: Int[np.ndarray, "c 9 9 9 8"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"], UInt8[np.ndarray, "m 3"]]:
    """The rows of blocks with texture nodes near the surface, and these nodes: whose, and where in it."""
    thick = _THICKNESS * config.voxel / _FINER
    rows, tiles, within, count = [], [], [], 0
    for part in np.array_split(np.arange(len(values)), max(len(values) // 256, 1)):
        fine = decoded_channel(config, 0, values[part, ..., 0])
        part = part[close := np.abs(fine).min(axis=(1, 2, 3)) < config.voxel]
        fine = fine[close]
        for axis in (1, 2, 3):
            fine = _refined(fine, axis)
        near = np.abs(fine) < thick
        kept = near.any(axis=(1, 2, 3))
        tile, *place = np.nonzero(near[kept])
        rows.append(part[kept])
        tiles.append((count + tile).astype(np.int32))
        within.append(np.stack(place, axis=-1).astype(np.uint8))
        count += len(rows[-1])
    return np.concatenate(rows), np.concatenate(tiles), np.concatenate(within)


def _refined(values: np.ndarray, axis: int) -> np.ndarray:
    """Linear interpolation between the nodes along one axis."""
    at = np.arange(_FINER * (values.shape[axis] - 1) + 1) / _FINER
    low = np.minimum(at.astype(int), values.shape[axis] - 2)
    share = (at - low).astype(values.dtype).reshape([-1 if k == axis else 1 for k in range(values.ndim)])
    return (1 - share) * np.take(values, low, axis) + share * np.take(values, low + 1, axis)
