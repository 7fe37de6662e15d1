"""Sparse voxel blocks of signed distance and colour: a scene whose size is that of its surface.

Space is cut into blocks of `CELLS`^3 cells. A block near a surface has a row in a pool, which holds its
(CELLS + 1)^3 nodes; neighbours hold the nodes between them twice, so that a point reads one block only. A
table of two levels says which row a block has; row 0 is empty space and stays so. Shapes depend on the
capacity of the pool and of the table, not on how far the scene reaches, so that nothing is compiled anew
while it grows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxpose._memory import give_back_zeros
from jaxpose.scenes.types import SceneField
from jaxpose.scenes.voxel_grid import GridConfig

CELLS = 8  # along each side of a block
NODES = CELLS + 1
# Signed distance [m], red, green, blue, wide-band distance [m]; and the weights with which distance, colour
# and wide-band distance were integrated so far.
CHANNELS, SAMPLED = 8, 5
_CAPACITY = 20_480  # blocks of a new pool: 239 MB, a furnished office
_GROWTH = 1.5  # of a full pool
_SIDE, _BRICKS = 64, 1024  # of a new table: its side in bricks, and how many of these may hold blocks
_BRICK = 8  # blocks along each side of a brick
_ROW_BYTES = 2 * NODES**3 * CHANNELS
# Numbers of the pool have 16 bits: distances up to the truncation, and to the width of a block; colour, which
# may be exposed as another image, up to 2; and the roots of weights, up to `MEMORY`.
MEMORY = 100.0  # frames, at a depth of one metre: older ones are slowly forgotten
_WHOLE = 2**15 - 1
# What stands where nothing was seen: free space, grey, no wide-band distance, no weights. It is taken off
# what is stored (16 bits turn over), so that zeros are free space: rows not in use then take no memory.
_FREE = np.array([_WHOLE, round(_WHOLE / 4), round(_WHOLE / 4), round(_WHOLE / 4), 0, 0, 0, 0], np.int16)


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


_MOST_BYTES = 2**32  # of a pool: 32 bits count no more numbers


class PoolFull(Exception):
    """More blocks are needed than a budget of memory holds; `needed` [bytes] is what they take."""

    def __init__(self, needed: int):
        super().__init__(f"a pool of {needed} bytes")
        self.needed = needed


class Blocks(NamedTuple):
    """The blocks of a scene; a pytree of arrays, on the host or on a device."""

    bricks: Int[Any, "s s s"]  # which part of `table` each brick of space has; 0: none
    corner: Int[Any, "3"]  # which brick of space `bricks` begins with
    table: Int[Any, "b 8 8 8"]  # the row of each block of a brick in the pool; 0: none
    coords: Int[Any, "c 3"]  # which block of space each row is
    count: Int[Any, ""]  # how many rows are in use, the empty one among them
    values: Int[Any, "c 9 9 9 8"]  # `CHANNELS` of each node, as `encoded` has them


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


def empty_blocks(
    config: BlockConfig,
    *,
    capacity: int = _CAPACITY,
    side: int = _SIDE,
    bricks: int = _BRICKS,
    budget: float = np.inf,
) -> Blocks:
    """Blocks of a scene in which nothing was seen; the table is centred on the world's origin.

    The pool holds `capacity` blocks, or as many as `budget` [bytes] allows.
    """
    capacity = int(min(capacity, max(budget // _ROW_BYTES, 1)))
    return Blocks(
        jnp.zeros((side, side, side), jnp.int32),
        jnp.full(3, -side // 2, jnp.int32),
        jnp.zeros((bricks, _BRICK, _BRICK, _BRICK), jnp.int32),
        jnp.zeros((capacity, 3), jnp.int32),
        jnp.int32(1),
        _free_rows(capacity),
    )


def encoded(config: BlockConfig, values: Float[Array, "*n 8"]) -> Int[Array, "*n 8"]:
    """Channels of nodes as the pool has them; what is beyond its range is cut off."""
    return jnp.stack([encoded_channel(config, k, values[..., k]) for k in range(CHANNELS)], axis=-1)


def encoded_channel(config: BlockConfig, k: int, values: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """`encoded` for channel k alone."""
    scaled = values / _largest(config)[k] if k < SAMPLED else jnp.sqrt(values / MEMORY)
    whole = jnp.round(_WHOLE * jnp.clip(scaled, -1, 1))
    least = -_WHOLE if k < SAMPLED else jnp.sign(scaled)  # what has a weight keeps one
    return jnp.maximum(whole, least).astype(jnp.int16) - _FREE[k]


def decoded_channel(config: BlockConfig, k: int, stored: Int[Any, "*n"]) -> Float[Any, "*n"]:
    """Channel k of nodes from what `encoded` has made of it, float32; arrays stay where they are."""
    scaled = (stored + _FREE[k]).astype(np.float32) / np.float32(_WHOLE)
    return scaled * _largest(config)[k] if k < SAMPLED else np.float32(MEMORY) * scaled**2


def holds_surface(stored: Int[np.ndarray, "n 9 9 9 8"]) -> Bool[np.ndarray, " n"]:
    """Whether the signed distance of blocks, as `packed` gives them, is on both sides of zero."""
    distance = stored[..., 0] + _FREE[0]
    return (distance.min(axis=(1, 2, 3)) < 0) & (distance.max(axis=(1, 2, 3)) > 0)


def _largest(config: BlockConfig) -> Float[np.ndarray, "5"]:
    """The largest value of each sampled channel that the pool holds."""
    return np.array([config.truncation, 2, 2, 2, CELLS * config.voxel], np.float32)


def sample_blocks(config: BlockConfig, blocks: Blocks, point: Float[Array, "3"]) -> Float[Array, "6"]:
    """Distance, colour, wide-band distance and 1 where that is known, trilinear at a point [m].

    Those of free space where there is no block.
    """
    scale = _largest(config) / np.float32(_WHOLE)

    def node(stored):
        known = (stored[CHANNELS - 1 :] > 0).astype(point.dtype)
        sampled = (stored[:SAMPLED] + _FREE[:SAMPLED]).astype(point.dtype)
        return jnp.concatenate([sampled * scale.astype(point.dtype), known])

    row, local = block_at(config, blocks, point)
    return trilinear_in_block(blocks.values, row, local, node)


def block_at(
    config: BlockConfig, blocks: Blocks, point: Float[Array, "3"]
) -> tuple[Int[Array, ""], Float[Array, "3"]]:
    """The row of the block that a point [m] is in, 0 where there is none, and its place there in cells."""
    position = point / config.voxel
    block = jnp.floor(jax.lax.stop_gradient(position) / CELLS)
    local = position - CELLS * block
    block, side = block.astype(jnp.int32), blocks.bricks.shape[0]
    place, within = block // _BRICK - blocks.corner, block % _BRICK
    inside = jnp.all((place >= 0) & (place < side))
    a, b, c = jnp.where(inside, place, 0)
    brick = jnp.where(inside, blocks.bricks.reshape(-1)[(a * side + b) * side + c], 0)
    a, b, c = within
    return blocks.table.reshape(-1)[((brick * _BRICK + a) * _BRICK + b) * _BRICK + c], local


def trilinear_in_block(
    values: Shaped[Array, "c n n n _"],
    row: Int[Array, ""],
    local: Float[Array, "3"],
    of_node: Callable[[Shaped[Array, " _"]], Float[Array, " k"]],
) -> Float[Array, " k"]:
    """What `of_node` says of the channels of nodes, between those of one block (row), at a place in cells."""
    nodes, channels = values.shape[1], values.shape[4]
    cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(local)), 0, nodes - 2)
    fraction = local - cell
    i, j, k = cell.astype(jnp.int32)
    flat = values.reshape(-1)

    def along_z(a, b):
        start = (((row * nodes + i + a) * nodes + j + b) * nodes + k) * channels
        pair = jax.lax.dynamic_slice(flat, (start,), (2 * channels,))
        return _between(of_node(pair[:channels]), of_node(pair[channels:]), fraction[2])

    low = _between(along_z(0, 0), along_z(0, 1), fraction[1])
    high = _between(along_z(1, 0), along_z(1, 1), fraction[1])
    return _between(low, high, fraction[0])


def touched_blocks(
    config: BlockConfig, points: Float[np.ndarray, "n 3"], reach: float
) -> Int[np.ndarray, "m 3"]:
    """The blocks of space within `reach` [m] of points along each axis, each once."""
    side = CELLS * config.voxel
    first = _each_once(np.floor((points - reach) / side).astype(np.int64))
    span = int(np.ceil(2 * reach / side - 1e-9)) + 1
    offsets = np.stack(np.meshgrid(*[np.arange(span)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return _each_once((first[:, None] + offsets).reshape(-1, 3))


def _each_once(rows: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "m 3"]:
    """Rows of whole numbers in order, each once, by one number for each."""
    if not len(rows):
        return rows
    lower = rows.min(axis=0)
    size = rows.max(axis=0) - lower + 1
    number = np.unique(np.ravel_multi_index(tuple((rows - lower).T), tuple(size)))
    return lower + np.stack(np.unravel_index(number, tuple(size)), axis=-1)


def with_blocks(
    config: BlockConfig, blocks: Blocks, wanted: Int[np.ndarray, "m 3"], *, budget: float = np.inf
) -> Blocks:
    """The scene with rows for these blocks of space, free where they are new.

    Pool and table grow when they are full: only then shapes change. PoolFull where the pool would then need
    more than `budget` [bytes], old and new together.
    """
    table, coords, count = np.asarray(blocks.table), blocks.coords, int(blocks.count)
    bricks, corner, used = _with_bricks(blocks, wanted // _BRICK)
    table = np.pad(table, [(0, _room_for(used, len(table)) - len(table)), *[(0, 0)] * 3])
    place = (bricks[tuple((wanted // _BRICK - corner).T)], *(wanted % _BRICK).T)
    is_new = table[place] == 0
    new, values = wanted[is_new], blocks.values
    if not len(new):
        return blocks
    capacity = _room_for(count + len(new), len(values), _most_rows(budget))
    if capacity > len(values):
        values = _enlarged(values, capacity)
        give_back_zeros(values, count)
    table, coords = np.array(table), np.pad(np.asarray(coords), [(0, capacity - len(coords)), (0, 0)])
    table[tuple(x[is_new] for x in place)] = np.arange(count, count + len(new))
    coords[count : count + len(new)] = new
    return Blocks(
        jnp.asarray(bricks),
        jnp.asarray(corner, jnp.int32),
        jnp.asarray(table),
        jnp.asarray(coords),
        jnp.int32(count + len(new)),
        values,
    )


def _with_bricks(
    blocks: Blocks, wanted: Int[np.ndarray, "m 3"]
) -> tuple[Int[np.ndarray, "s s s"], Int[np.ndarray, "3"], int]:
    """The upper level of the table with these bricks of space, its corner, and how many bricks there are.

    They are numbered as they come, so that blocks in one order have one table.
    """
    bricks, corner = np.array(blocks.bricks), np.asarray(blocks.corner)
    lower, upper = (wanted - corner).min(axis=0), (wanted - corner).max(axis=0)
    while (lower < 0).any() or (upper >= len(bricks)).any():  # twice the side, the old one in the middle
        half = len(bricks) // 2
        bricks = np.pad(bricks, half)
        corner, lower, upper = corner - half, lower + half, upper + half
    used = int(bricks.max(initial=0)) + 1
    first = np.sort(np.unique(wanted, axis=0, return_index=True)[1])
    place = tuple((wanted[first] - corner).T)
    new = bricks[place] == 0
    bricks[tuple(x[new] for x in place)] = np.arange(used, used + new.sum())
    return bricks, corner, used + int(new.sum())


def _room_for(count: int, room: int, most: float = np.inf) -> int:
    """A size that holds `count`: `room`, or one grown from it, not beyond `most` with the last together."""
    while room < count:
        grown = int(min(_GROWTH * room, most - room))
        if grown <= room:
            raise PoolFull(count * _ROW_BYTES)
        room = grown
    return room


def _free_rows(capacity: int) -> Int[Array, "c n n n k"]:
    """A pool of free rows, that takes memory as they are used."""
    rows = jnp.zeros((capacity, NODES, NODES, NODES, CHANNELS), jnp.int16)
    give_back_zeros(rows)
    return rows


def next_capacity(capacity: int, budget: float) -> int | None:
    """How many blocks a full pool will have room for; None where a budget [bytes] holds no more."""
    try:
        return _room_for(capacity + 1, capacity, _most_rows(budget))
    except PoolFull:
        return None


def _most_rows(budget: float) -> float:
    return min(budget, _MOST_BYTES - 1) / _ROW_BYTES


@partial(jax.jit, static_argnums=1)
def _enlarged(values: Int[Array, "c n n n k"], capacity: int) -> Int[Array, "d n n n k"]:
    """A pool with more rows, free ones."""
    return jnp.zeros((capacity, *values.shape[1:]), values.dtype).at[: len(values)].set(values)


@partial(jax.jit, donate_argnums=0)
def with_first_rows(blocks: Blocks, values: Int[Array, "n 9 9 9 8"]) -> Blocks:
    """The blocks with the first rows behind the empty one as they were, in the same memory."""
    return blocks._replace(values=blocks.values.at[1 : len(values) + 1].set(values))


def packed(blocks: Blocks) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, "n 9 9 9 8"]]:
    """The rows in use, on the host: which block of space each is, and its nodes as they are stored."""
    count = int(blocks.count)
    return np.asarray(blocks.coords)[1:count], np.asarray(blocks.values)[1:count]


def unpacked(
    config: BlockConfig, coords: Int[np.ndarray, "n 3"], values: Int[np.ndarray, "n 9 9 9 8"]
) -> Blocks:
    """The scene that `packed` took apart."""
    blocks = empty_blocks(config, capacity=_room_for(len(coords) + 1, _CAPACITY))
    if not len(coords):
        return blocks
    blocks = with_blocks(config, blocks, np.asarray(coords, np.int64))
    return with_first_rows(blocks, jnp.asarray(values))


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
    return size, unpacked(size, near + (first - before) // CELLS, of_distance_and_colour(size, chosen))


def of_distance_and_colour(
    config: BlockConfig, values: Float[np.ndarray, "n 9 9 9 4"]
) -> Int[np.ndarray, "n 9 9 9 8"]:
    """Nodes of distance [m] and colour, known everywhere, as they are stored; no wide-band distance."""
    values = np.asarray(values, np.float32)
    unknown, known = np.zeros_like(values[..., :1]), np.ones_like(values[..., :2])
    return np.asarray(
        encoded(config, jnp.asarray(np.concatenate([values, unknown, known, unknown], axis=-1)))
    )


def bounds(config: BlockConfig, blocks: Blocks) -> Float[np.ndarray, "2 3"]:
    """The lower and the upper corner [m] of what the blocks in use fill; zero without any."""
    coords = np.asarray(blocks.coords)[1 : int(blocks.count)]
    if not len(coords):
        return np.zeros((2, 3))
    return CELLS * config.voxel * np.stack([coords.min(axis=0), coords.max(axis=0) + 1])


def _between(a: Float[Array, " c"], b: Float[Array, " c"], fraction: Float[Array, ""]) -> Float[Array, " c"]:
    return a + (b - a) * fraction
