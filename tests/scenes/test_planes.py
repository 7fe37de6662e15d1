"""Planes and lines: against scipy's interpolation, around the core, and how empty a scene is said to be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import RegularGridInterpolator

from jaxpose.fields import set_progress
from jaxpose.scenes import PlanesConfig, occupancy, planes, with_occupancy

CONFIG = PlanesConfig((0.5, -1.0, 2.0), (1.0, 2.0, 0.5), nodes=16, levels=2)
FORWARD = jnp.array([0.0, 0.0, 1.0])


def filled(key: int = 0, progress: float = 1.0):
    """Parameters drawn at random on all levels."""
    params = planes(CONFIG).init(jax.random.key(key))
    leaves, tree = jax.tree.flatten(params["grids"])
    keys = jax.random.split(jax.random.key(key + 1), len(leaves))
    drawn = [0.5 * jax.random.normal(k, leaf.shape) for k, leaf in zip(keys, leaves, strict=True)]
    return set_progress(params | {"grids": jax.tree.unflatten(tree, drawn)}, jnp.asarray(progress))


def density(params, point):
    return float(planes(CONFIG).query(params, jnp.asarray(point, jnp.float32), FORWARD)[0])


@pytest.mark.parametrize("progress", [0.0, 1.0])
def test_density_inside_the_core_is_that_of_scipys_interpolation(progress):
    params = filled(progress=progress)
    point = np.array([0.9, -1.7, 1.8])
    inside = (point - CONFIG.centre) / CONFIG.half  # -1 to 1 in the core, which takes 3/4 of the nodes
    total = 0.0
    for number, (i, j, k) in enumerate(((0, 1, 2), (0, 2, 1), (1, 2, 0))):
        plane = line = 0.0
        for level in range(2 if progress else 1):  # the finer one is closed at the start
            values = np.asarray(params["grids"][f"plane_{level}"][number, ..., : CONFIG.density_rank])
            ends = np.linspace(-4 / 3, 4 / 3, values.shape[0])
            along = np.asarray(params["grids"][f"line_{level}"][number, ..., : CONFIG.density_rank])
            # The coarse level is interpolated at the fine one's nodes first, and then between those.
            fine = np.linspace(-4 / 3, 4 / 3, CONFIG.nodes)
            at = np.stack(np.meshgrid(fine, fine, indexing="ij"), -1)
            spread = RegularGridInterpolator((ends, ends), values)(at)
            plane += RegularGridInterpolator((fine, fine), spread)(inside[[i, j]])[0]
            line += RegularGridInterpolator((fine,), RegularGridInterpolator((ends,), along)(fine))(
                inside[[k]]
            )[0]
        total += (plane * line).sum()
    wanted = 20 / (3.5 / 3) * np.log1p(np.exp(3 * total - 5))
    assert_allclose(density(params, point), wanted, rtol=1e-3)


def test_all_of_space_is_seen_and_smoothly():
    params = filled()
    for far in (1.0, 10.0, 1e6, 1e12):
        assert np.isfinite(density(params, [far, -far, far]))
    assert_allclose(density(params, [1e7, 0, 0]), density(params, [1e9, 0, 0]), rtol=1e-2)
    gradient = jax.grad(lambda x: planes(CONFIG).query(params, x, FORWARD)[0])
    edge = jnp.array([1.5, -1.0, 2.0])  # where the core ends along x
    assert_allclose(gradient(edge - 1e-4)[0], gradient(edge + 1e-4)[0], rtol=0.05, atol=1e-3)


def test_fine_levels_open_without_a_jump():
    """They start as zeros."""
    scene = planes(CONFIG)
    params = scene.init(jax.random.key(0))
    now, later = (
        scene.query(set_progress(params, jnp.asarray(p)), jnp.zeros(3), FORWARD) for p in (0.0, 1.0)
    )
    jax.tree.map(assert_allclose, now, later)


def test_occupancy_is_no_less_than_the_density():
    params = filled()
    assert np.isinf(occupancy(CONFIG, params, jnp.zeros(3)))
    known = jax.jit(lambda p: with_occupancy(CONFIG, p))(params)
    points = np.random.default_rng(0).normal(0, 2, (200, 3)) + CONFIG.centre
    most = jax.vmap(lambda x: occupancy(CONFIG, known, x))(jnp.asarray(points, jnp.float32))
    found = jax.vmap(lambda x: planes(CONFIG).query(known, x, FORWARD)[0])(jnp.asarray(points, jnp.float32))
    assert np.mean(np.asarray(most) >= np.asarray(found)) > 0.97  # between the cells' middles it may be more
    assert np.all(np.asarray(most) >= 0.7 * np.asarray(found))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"half": (1.0, 0.0, 1.0)}, "half: expected more than 0"),
        ({"nodes": 30, "levels": 3}, "nodes: expected a multiple of 4, got 30"),
        ({"levels": 0}, "expected levels, ranks and width >= 1"),
    ],
)
def test_bad_configurations(changes, message):
    with pytest.raises(ValueError, match=message):
        PlanesConfig(**changes)
