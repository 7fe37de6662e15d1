"""The pool of blocks and its table against a dictionary, and what 16 bits keep of a number."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.blocks import decoded
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.scenes.voxel_blocks import (
    CELLS,
    BlockConfig,
    PoolFull,
    block_at,
    empty_blocks,
    encoded,
    holds_surface,
    of_distance_and_colour,
    packed,
    sample_blocks,
    unpacked,
    with_blocks,
)

CONFIG = BlockConfig(voxel=0.05, truncation=0.15)
WIDTH = CELLS * CONFIG.voxel
ROW_BYTES = 2.0 * 9**3 * 8


def grown(parts):
    """Blocks that came in several parts, in a pool and a table that begin small."""
    blocks = empty_blocks(CONFIG, capacity=8, side=2, bricks=2)
    for part in parts:
        blocks = with_blocks(CONFIG, blocks, part)
    return blocks


def parts():
    """Blocks on both sides of the origin, up to 300 away, some of them twice."""
    rng = np.random.default_rng(0)
    near, far = rng.integers(-9, 9, (3, 20, 3)), rng.integers(-300, 300, (10, 3))
    return [np.unique(x, axis=0) for x in (near[0], near[1], np.concatenate([near[1], far]), near[2])]


def test_a_point_finds_the_row_of_its_block_wherever_that_is():
    blocks, rows = grown(parts()), {}
    for part in parts():
        rows |= {
            block: len(rows) + 1 + k for k, block in enumerate(b for b in map(tuple, part) if b not in rows)
        }
    assert int(blocks.count) == len(rows) + 1 > 50 and len(blocks.bricks) > 64
    rng = np.random.default_rng(1)
    others = [b for b in map(tuple, rng.integers(-400, 400, (100, 3))) if b not in rows]
    asked = np.array([*rows, *others])
    local = rng.uniform(0.01, 0.99, asked.shape)
    find = jax.jit(jax.vmap(partial(block_at, CONFIG, blocks)))
    row, within = find(jnp.asarray(WIDTH * (asked + local), jnp.float32))
    assert_array_equal(row, [*rows.values(), *[0] * len(others)])
    assert_allclose(within, CELLS * local, atol=5e-3)  # float32, 120 m away
    assert_array_equal(np.asarray(blocks.coords)[1 : len(rows) + 1], list(rows))


def test_blocks_that_were_taken_apart_are_put_together_as_they_were():
    blocks = grown(parts())
    values = np.array(blocks.values)
    values[1:] = np.random.default_rng(0).integers(-99, 99, values[1:].shape)
    again = unpacked(CONFIG, *packed(blocks._replace(values=jnp.asarray(values))))
    count = int(blocks.count)
    assert_array_equal(np.asarray(again.values)[:count], values[:count])
    assert_array_equal(np.asarray(again.coords)[:count], np.asarray(blocks.coords)[:count])
    assert not np.asarray(again.table)[0].any() and int(again.table.max()) == count - 1


def test_what_is_free_is_stored_as_zeros():
    free = np.tile([0.15, 0.5, 0.5, 0.5, 0, 0, 0, 0], (3, 1)).astype(np.float32)
    assert not np.asarray(encoded(CONFIG, jnp.asarray(free))).any()
    assert_allclose(decoded(CONFIG, np.zeros((3, 8), np.int16)), free, atol=1e-4)
    found = sample_blocks(CONFIG, empty_blocks(CONFIG, capacity=8, side=2, bricks=2), jnp.ones(3))
    assert_allclose(found, [0.15, 0.5, 0.5, 0.5, 0, 0], atol=1e-4)


def test_a_block_holds_a_surface_where_its_distance_changes_sign():
    values = np.zeros((5, *[9] * 3, 4), np.float32)
    values[..., 0] = 0.15
    values[1, 4, 4, 4, 0] = -1e-5
    values[2, ..., 0] = -0.15
    values[3, ..., 0], values[3, 0, 0, 0, 0] = 1e-5, -0.15
    values[4, ..., 0] = 1e-5
    stored = of_distance_and_colour(CONFIG, values)
    assert holds_surface(stored).tolist() == [False, True, False, True, False]


def test_a_budget_counts_the_pool_while_it_grows():
    full = with_blocks(
        CONFIG, empty_blocks(CONFIG, capacity=8, side=2, bricks=8), np.argwhere(np.ones((7, 1, 1)))
    )
    more = np.array([[0, 5, 0]])
    assert len(with_blocks(CONFIG, full, more, budget=20 * ROW_BYTES).values) == 12  # half as much again
    assert len(with_blocks(CONFIG, full, more, budget=18 * ROW_BYTES).values) == 10  # old and new together
    with pytest.raises(PoolFull) as full_pool:
        with_blocks(CONFIG, full, more, budget=16 * ROW_BYTES)
    assert full_pool.value.needed == 9 * ROW_BYTES
    assert len(empty_blocks(CONFIG, budget=100 * ROW_BYTES).values) == 100


def test_sixteen_bits_keep_what_a_map_needs():
    rng = np.random.default_rng(0)
    values = np.concatenate([
        rng.uniform(-0.15, 0.15, (999, 1)), rng.uniform(0, 1.5, (999, 3)), rng.uniform(-0.4, 0.4, (999, 1)),
        10 ** rng.uniform(-5, 2, (999, 3)),
    ], axis=1)  # fmt: skip
    kept = decoded(CONFIG, np.asarray(encoded(CONFIG, jnp.asarray(values, jnp.float32))))
    assert_allclose(kept[:, :5], values[:, :5], atol=2.0 / 2**16)
    assert_allclose(kept[:, 0], values[:, 0], atol=0.16 / 2**16)  # 2.4 micrometres
    assert_allclose(np.sqrt(kept[:, 5:]), np.sqrt(values[:, 5:]), atol=11 / 2**16)
    beyond = jnp.array([1.0, 3, 0.5, 0.5, -1, 1e-12, 0, 1e4])
    cut = [0.15, 2, 0.5, 0.5, -0.4, 9e-8, 0, 100]
    assert_allclose(decoded(CONFIG, encoded(CONFIG, beyond)), cut, rtol=0.05, atol=1e-9)
    assert decoded(CONFIG, encoded(CONFIG, beyond))[5] > 0  # what has a weight keeps one
