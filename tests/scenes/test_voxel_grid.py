"""Grids: nothing is lost by merging or growing, interpolation is exact where it can be."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import RegularGridInterpolator

from jaxpose.scenes import GridConfig, bounding_grid, grid, grow, merge, node_positions

CONFIG = GridConfig((-0.5, 0.0, 1.0), (0.3, 0.4, 2.2), voxel=0.1, levels=2, truncation=0.3)
AHEAD = jnp.array([0.0, 0.0, 1.0])
FINE_SHAPE = (9, 5, 13, 4)


class State(NamedTuple):
    """As mapping has it: parameters, and a memory of one kind or another."""

    params: Any
    memory: Any


def random_params(config=CONFIG, seed=0, dtype=jnp.float32):
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(grid(config).init, jax.random.key(0))
    return tuple(jnp.asarray(rng.normal(size=x.shape), dtype) for x in shapes)


def values_at(config, params, points):
    """Signed distance and colour at points (n, 3), one array (n, 4)."""
    ahead = AHEAD.astype(points.dtype)
    distance, rgb = jax.jit(jax.vmap(partial(grid(config).query, params), in_axes=(0, None)))(points, ahead)
    return np.concatenate([distance[:, None], rgb], axis=1)


def points_in(config, count, *, beyond=0.0, seed=1):
    lower, upper = np.array(config.lower) - beyond, np.array(config.upper) + beyond
    return np.random.default_rng(seed).uniform(lower, upper, (count, 3))


def linear(points):
    return np.stack([points @ [1, 2, -3] + 0.5, points[:, 0], -points[:, 1], 1 - points[:, 2]], axis=1)


def test_it_starts_free_and_grey(dtype):
    params = jax.tree.map(lambda x: x.astype(dtype), grid(CONFIG).init(jax.random.key(0)))
    seen = values_at(CONFIG, params, jnp.asarray(points_in(CONFIG, 20, beyond=1.0), dtype))
    assert seen.dtype == dtype
    assert_allclose(seen, np.tile([0.3, 0.5, 0.5, 0.5], (20, 1)), rtol=1e-6)


coordinate = st.floats(-0.25, 1.25, width=32)


@jax.jit
def both(params, point):
    query = grid(CONFIG).query
    return query(params, point, AHEAD), query(merge(params), point, AHEAD)


@settings(max_examples=100, deadline=None)
@given(st.tuples(coordinate, coordinate, coordinate))
def test_merging_changes_nothing(share):
    """Anywhere, on borders of cells and outside the box too: `share` is the place in the box."""
    lower, upper = np.array(CONFIG.lower), np.array(CONFIG.upper)
    point = jnp.asarray(lower + np.array(share) * (upper - lower), jnp.float32)
    apart, together = both(random_params(), point)
    # Within a rounding of a border either cell may be read: the function is continuous, so they agree.
    assert_allclose(np.append(*together), np.append(*apart), atol=1e-4)


def test_merging_is_exact_on_all_nodes(dtype):
    params = random_params(dtype=dtype)
    points = jnp.asarray(node_positions(CONFIG).reshape(-1, 3), dtype)
    (merged,) = merge(params)
    assert merged.shape == FINE_SHAPE
    assert_allclose(values_at(CONFIG, params, points), merged.reshape(-1, 4), atol=2e-5)


def test_three_levels_sum_to_scipys_interpolation():
    config = GridConfig((0.0, 0.0, 0.0), (1.6, 1.6, 1.6), voxel=0.1, levels=3, truncation=0.3)
    params = random_params(config)
    points = points_in(config, 200)
    expected = np.zeros((200, 4))
    for level, values in enumerate(params):
        axes = [np.linspace(0, 1.6, 4**level + 1)] * 3
        expected += RegularGridInterpolator(axes, np.asarray(values, np.float64))(points)
    assert_allclose(values_at(config, params, jnp.asarray(points, jnp.float32)), expected, atol=1e-4)
    assert_allclose(values_at(config, merge(params), jnp.asarray(points, jnp.float32)), expected, atol=1e-4)


def test_a_linear_function_is_reproduced(dtype):
    nodes = node_positions(CONFIG)
    params = (jnp.asarray(linear(nodes.reshape(-1, 3).astype(np.float64)).reshape(FINE_SHAPE), dtype),)
    points = points_in(CONFIG, 100)
    # Node positions are float32.
    assert_allclose(values_at(CONFIG, params, jnp.asarray(points, dtype)), linear(points), atol=3e-6)


def test_outside_the_nearest_face_holds():
    points = points_in(CONFIG, 50, beyond=3.0)
    inside = np.clip(points, np.float32(CONFIG.lower), np.float32(CONFIG.upper))
    found, expected = (
        values_at(CONFIG, random_params(), jnp.asarray(x, jnp.float32)) for x in (points, inside)
    )
    assert_allclose(found, expected, atol=1e-4)


def test_gradients_are_those_of_finite_differences():
    with jax.enable_x64(True):
        query = partial(grid(CONFIG).query, random_params(dtype=jnp.float64))
        at = lambda p: jnp.append(*reversed(query(p, p)))
        points = jnp.asarray(points_in(CONFIG, 40))
        jacobian = jax.jit(jax.vmap(jax.jacrev(at)))(points)
        steps = 1e-6 * jnp.eye(3)
        moved = lambda sign: jax.vmap(jax.vmap(at))(points[:, None] + sign * steps[None])
        differences = np.swapaxes((moved(1) - moved(-1)) / 2e-6, 1, 2)
        assert_allclose(jacobian, differences, atol=1e-6 * np.abs(jacobian).max())
        forward = jax.jit(jax.vmap(jax.jacfwd(at)))(points)
        assert_allclose(forward, jacobian, rtol=1e-10, atol=1e-10)


def test_a_point_pulls_only_on_its_own_nodes():
    """The gradient with respect to the values is the trilinear weights."""
    point = jnp.array([-0.33, 0.14, 1.68])  # in cell (1, 1, 6) of the finest level, at (0.7, 0.4, 0.8)
    pull = jax.grad(lambda params: grid(CONFIG).query(params, point, AHEAD)[0])(random_params())[1]
    expected = np.zeros(FINE_SHAPE)
    x, y, z = ([1 - f, f] for f in (0.7, 0.4, 0.8))
    expected[1:3, 1:3, 6:8, 0] = np.einsum("i,j,k->ijk", x, y, z)
    assert_allclose(pull, expected, atol=1e-5)


@pytest.mark.parametrize("memory", ["adam", "weights"])
@pytest.mark.parametrize("towards", [(-1.0, 0.2, 1.5), (0.0, 0.2, 3.0), (1.0, -1.0, 0.0)])
def test_growing_keeps_what_was_and_adds_free_space(memory, towards):
    params = random_params()
    if memory == "weights":  # fused mapping works on the merged grid
        config = GridConfig(CONFIG.lower, CONFIG.upper, CONFIG.voxel, 1, CONFIG.truncation)
        params = merge(params)
        state = State(params, jnp.abs(params[0]))
        moments = lambda state: (state.memory,)
    else:
        config = CONFIG
        state = State(params, {"count": jnp.int32(7), "mu": jax.tree.map(lambda x: 2 * x, params)})
        moments = lambda state: state.memory["mu"]
    larger, grown = grow(config, state, np.array([towards, (0.0, 0.2, 1.5)]))
    assert np.all(np.array(larger.lower) <= np.array(towards))
    assert np.all(np.array(larger.upper) >= np.array(towards))
    assert jax.tree.map(jnp.shape, grown.params) == jax.tree.map(
        jnp.shape, grid(larger).init(jax.random.key(0))
    )

    points = points_in(config, 100)
    as_before = lambda old, new: assert_allclose(
        values_at(larger, new, jnp.asarray(points, jnp.float32)),
        values_at(config, old, jnp.asarray(points, jnp.float32)),
        atol=2e-4,  # positions in cells round differently
    )
    as_before(state.params, grown.params)
    as_before(moments(state), moments(grown))
    # New nodes that touch no old cell are free; moments there are zero.
    cell = config.voxel * 4 ** (config.levels - 1)
    points = points_in(larger, 500)
    outside = (points < np.array(config.lower) - cell) | (points > np.array(config.upper) + cell)
    points = jnp.asarray(points[outside.any(axis=1)], jnp.float32)
    assert len(points) > 10
    free = np.tile([0.3, 0.5, 0.5, 0.5], (len(points), 1))
    assert_allclose(values_at(larger, grown.params, points), free, atol=1e-5)
    assert_array_equal(values_at(larger, moments(grown), points), 0)
    if memory == "adam":
        assert grown.memory["count"] == 7


def test_growing_to_what_is_inside_changes_nothing():
    state = State(random_params(), jnp.zeros(3))
    config, same = grow(CONFIG, state, points_in(CONFIG, 5))
    assert config == CONFIG
    jax.tree.map(assert_array_equal, same, state)


@pytest.mark.parametrize("levels", [1, 2])
def test_a_box_covers_its_points(levels):
    points = np.random.default_rng(5).normal(size=(100, 3)) * [3, 1, 2]
    config = bounding_grid(points, levels=levels, nodes=400_000)
    assert np.all(points >= np.array(config.lower) + 0.2) and np.all(points <= np.array(config.upper) - 0.2)
    nodes = node_positions(config)
    assert nodes.shape[:3] == grid(config).init(jax.random.key(0))[-1].shape[:3]
    assert 300_000 < nodes[..., 0].size < 600_000
    assert_allclose(nodes[0, 0, 0], config.lower, rtol=1e-6)
    assert_allclose(nodes[-1, -1, -1], config.upper, rtol=1e-5)
    assert bounding_grid(points, voxel=0.5, levels=levels).voxel == 0.5


@pytest.mark.parametrize(
    "settings, message",
    [
        (dict(lower=(0.0, 0.0, 0.0), upper=(1.0, 0.0, 1.0)), "lower < upper"),
        (dict(voxel=0.0), "voxel > 0"),
        (dict(levels=0), "levels >= 1"),
    ],
)
def test_a_grid_that_means_nothing_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        GridConfig(**settings)
