"""Sparse voxel blocks of signed distance and colour: a scene whose size is that of its surface.

Space is cut into blocks of `CELLS`^3 cells. A block near a surface has a row in a pool, which holds its
(CELLS + 1)^3 nodes; neighbours hold the nodes between them twice, so that a point reads one block only. A
table says which row a block has; row 0 is empty space and stays so. Shapes depend on the capacity of the pool
and the side of the table, not on how far the scene reaches, so that nothing is compiled anew while it grows.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxpose.scenes.types import SceneField
from jaxpose.scenes.voxel_grid import GridConfig

CELLS = 8  # along each side of a block
NODES = CELLS + 1
# Signed distance [m], red, green, blue, wide-band distance [m], 1 where that is known; and the weights with
# which distance, colour and wide-band distance were integrated so far.
CHANNELS, SAMPLED = 9, 6
_CAPACITY = 8192  # blocks of a new pool: 215 MB, a furnished room
_SIDE = 128  # of a new table, in blocks


@dataclass(frozen=True)
class BlockConfig:
    """How finely space is resolved; all else follows from what is seen."""

    voxel: float = 0.04  # [m]
    truncation: float = 0.12  # [m] signed distance where nothing was seen: free space

    def __post_init__(self):
        if not self.voxel > 0 or not self.truncation > 0:
            raise ValueError(
                f"BlockConfig: expected voxel > 0 and truncation > 0, got {self.voxel}, {self.truncation}"
            )


class Blocks(NamedTuple):
    """The blocks of a scene; a pytree of arrays, on the host or on a device."""

    table: Int[Any, "s s s"]  # the row of each block of space in the pool; 0: none
    corner: Int[Any, "3"]  # which block of space the table begins with
    coords: Int[Any, "c 3"]  # which block of space each row is
    count: Int[Any, ""]  # how many rows are in use, the empty one among them
    values: Float[Any, "c 9 9 9 9"]  # `CHANNELS` of each node


def voxel_blocks(config: BlockConfig) -> SceneField:
    """Signed distance [m], positive in front of surfaces, and colour in sparse blocks.

    Trilinear between nodes, free space and grey where there is no block. Parameters are `Blocks`.
    """

    def init(key):
        del key  # nothing is random
        return empty_blocks(config)

    def query(params, point, direction):
        del direction  # surfaces are taken as matt
        value = sample_blocks(config, params, point)
        return value[0], value[1:4]

    return SceneField(init, query)


def empty_blocks(config: BlockConfig, *, capacity: int = _CAPACITY, side: int = _SIDE) -> Blocks:
    """Blocks of a scene in which nothing was seen; the table is centred on the world's origin."""
    return Blocks(
        jnp.zeros((side, side, side), jnp.int32),
        jnp.full(3, -side // 2, jnp.int32),
        jnp.zeros((capacity, 3), jnp.int32),
        jnp.int32(1),
        jnp.broadcast_to(_free(config), (capacity, NODES, NODES, NODES, CHANNELS)),
    )


def sample_blocks(config: BlockConfig, blocks: Blocks, point: Float[Array, "3"]) -> Float[Array, "6"]:
    """Distance, colour, wide-band distance and whether it is known, trilinear at a point [m].

    Those of free space where there is no block.
    """
    row, local = block_at(config, blocks, point)
    return trilinear_in_block(blocks.values, row, local, SAMPLED)


def block_at(
    config: BlockConfig, blocks: Blocks, point: Float[Array, "3"]
) -> tuple[Int[Array, ""], Float[Array, "3"]]:
    """The row of the block that a point [m] is in, 0 where there is none, and its place there in cells."""
    position = point / config.voxel
    block = jnp.floor(jax.lax.stop_gradient(position) / CELLS)
    local = position - CELLS * block
    place, side = block.astype(jnp.int32) - blocks.corner, blocks.table.shape[0]
    inside = jnp.all((place >= 0) & (place < side))
    a, b, c = jnp.where(inside, place, 0)
    return jnp.where(inside, blocks.table.reshape(-1)[(a * side + b) * side + c], 0), local


def trilinear_in_block(
    values: Shaped[Array, "c n n n _"], row: Int[Array, ""], local: Float[Array, "3"], count: int
) -> Float[Array, " k"]:
    """The first `count` channels of one block (row) at a place given in its cells."""
    nodes, channels = values.shape[1], values.shape[4]
    cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(local)), 0, nodes - 2)
    fraction = local - cell
    i, j, k = cell.astype(jnp.int32)
    flat = values.reshape(-1)

    def along_z(a, b):
        start = (((row * nodes + i + a) * nodes + j + b) * nodes + k) * channels
        pair = jax.lax.dynamic_slice(flat, (start,), (2 * channels,)).astype(local.dtype)
        return _between(pair[:count], pair[channels : channels + count], fraction[2])

    low = _between(along_z(0, 0), along_z(0, 1), fraction[1])
    high = _between(along_z(1, 0), along_z(1, 1), fraction[1])
    return _between(low, high, fraction[0])


def touched_blocks(
    config: BlockConfig, points: Float[np.ndarray, "n 3"], reach: float
) -> Int[np.ndarray, "m 3"]:
    """The blocks of space within `reach` [m] of points along each axis, each once."""
    side = CELLS * config.voxel
    first = np.unique(np.floor((points - reach) / side).astype(np.int64), axis=0)
    span = int(np.ceil(2 * reach / side - 1e-9)) + 1
    offsets = np.stack(np.meshgrid(*[np.arange(span)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.unique((first[:, None] + offsets).reshape(-1, 3), axis=0)


def with_blocks(config: BlockConfig, blocks: Blocks, wanted: Int[np.ndarray, "m 3"]) -> Blocks:
    """The scene with rows for these blocks of space, free where they are new.

    The pool doubles when it is full, and the table when space goes beyond it: only then shapes change.
    """
    table, corner = np.asarray(blocks.table), np.asarray(blocks.corner)
    count, capacity, side = int(blocks.count), blocks.values.shape[0], table.shape[0]
    lower, upper = (wanted - corner).min(axis=0), (wanted - corner).max(axis=0)
    while (lower < 0).any() or (upper >= side).any():  # twice the side, the old table in the middle
        table = np.pad(table, side // 2)
        corner, lower, upper, side = corner - side // 2, lower + side // 2, upper + side // 2, 2 * side
    place = tuple((wanted - corner).T)
    new = wanted[table[place] == 0]
    if len(new) == 0:
        return blocks
    values, coords = blocks.values, np.array(blocks.coords)
    while count + len(new) > capacity:
        free = jnp.broadcast_to(_free(config), values.shape)
        values, coords = jnp.concatenate([values, free]), np.pad(coords, [(0, capacity), (0, 0)])
        capacity *= 2
    table = np.array(table)
    table[tuple((new - corner).T)] = np.arange(count, count + len(new))
    coords[count : count + len(new)] = new
    return Blocks(
        jnp.asarray(table),
        jnp.asarray(corner, jnp.int32),
        jnp.asarray(coords),
        jnp.int32(count + len(new)),
        values,
    )


def packed(blocks: Blocks) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 9 9 9 9"]]:
    """The rows in use, on the host: which block of space each is, and its nodes."""
    count = int(blocks.count)
    return np.asarray(blocks.coords)[1:count], np.asarray(blocks.values[1:count])


def unpacked(
    config: BlockConfig, coords: Int[np.ndarray, "n 3"], values: Float[np.ndarray, "n 9 9 9 9"]
) -> Blocks:
    """The scene that `packed` took apart."""
    blocks = empty_blocks(config)
    if not len(coords):
        return blocks
    blocks = with_blocks(config, blocks, np.asarray(coords, np.int64))
    return blocks._replace(values=blocks.values.at[1 : len(coords) + 1].set(jnp.asarray(values)))


def blocks_of_grid(config: GridConfig, values: Float[np.ndarray, "x y z 4"]) -> tuple[BlockConfig, Blocks]:
    """The blocks near the surface of a grid's finest level, node by node the same."""
    size = BlockConfig(config.voxel, config.truncation)
    first = np.round(np.asarray(config.lower) / config.voxel).astype(int)
    before = first % CELLS
    after = -(before + np.array(values.shape[:3]) - 1) % CELLS
    padded = np.pad(values, [*zip(before, after, strict=True), (0, 0)], mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (NODES,) * 3, axis=(0, 1, 2))
    windows = windows[::CELLS, ::CELLS, ::CELLS]
    near = np.argwhere((np.abs(windows[..., 0, :, :, :]) < config.truncation).any(axis=(3, 4, 5)))
    chosen = np.moveaxis(windows[tuple(near.T)], 1, -1)
    chosen = np.concatenate([chosen, np.zeros((*chosen.shape[:-1], CHANNELS - 4), chosen.dtype)], axis=-1)
    return size, unpacked(size, near + (first - before) // CELLS, chosen)


def bounds(config: BlockConfig, blocks: Blocks) -> Float[np.ndarray, "2 3"]:
    """The lower and the upper corner [m] of what the blocks in use fill; zero without any."""
    coords = np.asarray(blocks.coords)[1 : int(blocks.count)]
    if not len(coords):
        return np.zeros((2, 3))
    return CELLS * config.voxel * np.stack([coords.min(axis=0), coords.max(axis=0) + 1])


def _free(config: BlockConfig) -> Float[Array, "9"]:
    """What stands where nothing was seen: free space, grey, no wide-band distance, no weights."""
    return jnp.array([config.truncation, 0.5, 0.5, 0.5, *[0.0] * (CHANNELS - 4)], jnp.float32)


def _between(a: Float[Array, " c"], b: Float[Array, " c"], fraction: Float[Array, ""]) -> Float[Array, " c"]:
    return a + (b - a) * fraction
