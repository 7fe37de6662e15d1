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

from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.scenes import SceneField
from jaxpose.scenes.voxel_blocks import CELLS, BlockConfig, Blocks, block_at, decoded, trilinear_in_block
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.map.integrate import in_view_test, seen_by
from jaxpose.slam.observation import locate

_FINER = 2  # texture cells along one of the map's
SIDE = _FINER * CELLS + 1  # nodes along each side of a tile, which is a block with its outer nodes
_THICKNESS = 1.2  # texture cells to either side of the surface
_SAME = 2.0  # cells of the map that a measured surface may be off the map's
_PAINTED = 0.25  # weight of painted nodes around a point from which on they give its colour
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
    count, capacity = int(blocks.count), blocks.coords.shape[0]
    rows, near = _near_surface(config, np.asarray(blocks.values)[:count])
    if not len(rows):
        return Texture(np.zeros(capacity, np.int32), np.zeros((1, SIDE, SIDE, SIDE, 4), np.uint8))
    # The nodes near the surface of all tiles in turn, those of a few tiles next to each other in one chunk.
    tile, *within = np.nonzero(near)
    index = _FINER * CELLS * np.asarray(blocks.coords)[rows][tile] + np.stack(within, axis=-1)
    size = max(len(tile) * _NEIGHBOURS // len(rows), 1)
    chunks = np.pad(index, [(0, -len(index) % size), (0, 0)], mode="edge").reshape(-1, size, 3)
    points = np.float32(config.voxel / _FINER) * chunks.astype(np.float32)
    box = np.stack([points.min(axis=1), points.max(axis=1)])
    corners = np.stack([box[list(k), :, [0, 1, 2]].T for k in np.ndindex(2, 2, 2)], axis=1)
    add, total = _make_add(camera, _SAME * config.voxel), jnp.zeros((*points.shape[:2], 4))
    on_device = jnp.asarray(points), jnp.asarray(corners)
    for keyframe in keyframes:
        total = add(total, *on_device, keyframe.image, jnp.asarray(keyframe.T_world_cam, jnp.float32))
    rgb, weight = np.split(np.asarray(total).reshape(-1, 4)[: len(index)], [3], axis=-1)
    there = weight[:, 0] > 0
    tiles = np.zeros((len(rows) + 1, SIDE, SIDE, SIDE, 4), np.uint8)
    place = (tile[there] + 1, *(x[there] for x in within))
    tiles[(*place, slice(0, 3))] = np.round(255 * rgb[there] / weight[there])
    tiles[(*place, 3)] = 255
    slot = np.zeros(capacity, np.int32)
    slot[rows] = np.arange(1, len(rows) + 1)
    return Texture(slot, tiles)


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


def _make_add(camera: Camera, near: float):
    """The compiled step that adds what a keyframe shows to the colours (m, s, 4) of chunks of points."""
    in_view = in_view_test(camera)

    @partial(jax.jit, donate_argnums=0)
    def add(total, points, corners, image, T_world_cam):
        T_cam_world, seen_at = se3.inverse(T_world_cam), seen_by(image, camera)
        in_sight = in_view(se3.apply(T_cam_world, corners), jnp.max(image.depth) + near)
        order = jnp.argsort(~in_sight)

        def add_chunk(n, total):
            points_cam = se3.apply(T_cam_world, points[order[n]])
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
) -> tuple[Int[np.ndarray, " n"], np.ndarray]:
    """The rows of blocks with texture nodes near the surface, and which of their nodes these are."""
    thick = _THICKNESS * config.voxel / _FINER
    rows, near = [], []
    for part in np.array_split(np.arange(len(values)), max(len(values) // 256, 1)):
        fine = decoded(config, values[part])[..., 0]
        part = part[close := np.abs(fine).min(axis=(1, 2, 3)) < config.voxel]
        fine = fine[close]
        for axis in (1, 2, 3):
            fine = _refined(fine, axis)
        mask = np.abs(fine) < thick
        kept = mask.any(axis=(1, 2, 3))
        rows.append(part[kept])
        near.append(mask[kept])
    return np.concatenate(rows), np.concatenate(near)


def _refined(values: np.ndarray, axis: int) -> np.ndarray:
    """Linear interpolation between the nodes along one axis."""
    at = np.arange(_FINER * (values.shape[axis] - 1) + 1) / _FINER
    low = np.minimum(at.astype(int), values.shape[axis] - 2)
    share = (at - low).astype(values.dtype).reshape([-1 if k == axis else 1 for k in range(values.ndim)])
    return (1 - share) * np.take(values, low, axis) + share * np.take(values, low + 1, axis)
