"""NeRF's perceptron against BARF's network written in numpy, its window, its initial draw."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.fields import set_progress
from jaxpose.scenes import NerfConfig, nerf

SMALL = NerfConfig(layers=4, width=12, skip=2, colour_width=6, octaves=3, direction_octaves=2)
POINTS = np.random.default_rng(0).uniform(-2, 2, (5, 3))
DIRECTIONS = np.random.default_rng(1).normal(size=(5, 3))
TOLERANCE = {jnp.float32: 2e-5, jnp.float64: 1e-12}


def encode(x, octaves, progress, window):
    """x, then for each coordinate all sines and all cosines of 2^k pi x, weighted by BARF's window."""
    parts = list(x)
    alpha = octaves if window is None else octaves * (progress - window[0]) / (window[1] - window[0])
    weights = [(1 - np.cos(np.pi * np.clip(alpha - k, 0, 1))) / 2 for k in range(octaves)]
    for coordinate in x:
        for wave in (np.sin, np.cos):
            parts += [weights[k] * wave(2.0**k * np.pi * coordinate) for k in range(octaves)]
    return np.array(parts)


def barf(params, config, point, direction, progress):
    layer = lambda name, x: (
        x @ np.asarray(params[name]["kernel"], np.float64) + np.asarray(params[name]["bias"])
    )
    encoded = encode(point, config.octaves, progress, config.window)
    along = encode(direction / np.linalg.norm(direction), config.direction_octaves, progress, config.window)
    hidden = encoded
    for number in range(config.layers):
        if number == config.skip:
            hidden = np.concatenate([hidden, encoded])
        if number == config.layers - 1:
            density = np.log1p(np.exp(layer("density", hidden)[0]))
        hidden = np.maximum(layer(f"layer_{number}", hidden), 0)
    hidden = np.maximum(layer("colour_0", np.concatenate([hidden, along])), 0)
    return density, 1 / (1 + np.exp(-layer("colour_1", hidden)))


def random_params(config, dtype):
    """Biases drawn too, so that they count."""
    params = nerf(config).init(jax.random.key(0))
    rng = np.random.default_rng(2)
    params = jax.tree.map(
        lambda x: jnp.asarray(np.asarray(x) + 0.1 * rng.normal(size=x.shape), dtype), params
    )
    return params if config.window is None else set_progress(params, jnp.zeros((), dtype))


@pytest.mark.parametrize("progress", [None, 0.0, 0.25, 0.37, 1.0])
def test_it_is_barfs_network(progress, dtype):
    config = SMALL if progress is not None else NerfConfig(**{**vars(SMALL), "window": None})
    params = random_params(config, dtype)
    if progress is not None:
        params = set_progress(params, jnp.asarray(progress, dtype))
    query = jax.jit(jax.vmap(partial(nerf(config).query, params)))
    density, rgb = query(jnp.asarray(POINTS, dtype), jnp.asarray(DIRECTIONS, dtype))
    assert density.dtype == rgb.dtype == dtype
    for k in range(5):
        expected = barf(params, config, POINTS[k], DIRECTIONS[k], progress)
        assert_allclose(density[k], expected[0], rtol=10 * TOLERANCE[dtype])
        assert_allclose(rgb[k], expected[1], atol=TOLERANCE[dtype])


def test_the_default_has_barfs_number_of_parameters_and_its_draw():
    params = nerf(NerfConfig(window=None)).init(jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(params)) == 530_052
    for name, layer in params.items():
        gain = 1.0 if name in ("density", "colour_1") else np.sqrt(2)
        bound = gain * np.sqrt(6 / sum(layer["kernel"].shape))
        assert 0.98 * bound < np.abs(layer["kernel"]).max() <= bound
        assert float(layer["kernel"].std()) == pytest.approx(bound / np.sqrt(3), rel=0.05)
        assert_array_equal(layer["bias"], 0)


def test_quiet_bands_start_at_zero_and_wake():
    config = NerfConfig(**{**vars(SMALL), "zero_bands": True})
    params = set_progress(nerf(config).init(jax.random.key(0)), jnp.ones(()))
    loud = nerf(SMALL).init(jax.random.key(0))
    for name, first in (("layer_0", 3), ("layer_2", 12 + 3), ("colour_0", 12 + 3)):
        kernel = params[name]["kernel"]
        assert_array_equal(kernel[first:], 0)
        assert_array_equal(kernel[:first], loud[name]["kernel"][:first])
    shut = set_progress(params, jnp.zeros(()))
    query = nerf(config).query
    point, direction = jnp.asarray(POINTS[0], jnp.float32), jnp.asarray(DIRECTIONS[0], jnp.float32)
    assert_allclose(query(params, point, direction)[1], query(shut, point, direction)[1], atol=1e-7)
    gradient = jax.grad(lambda params: jnp.sum(query(params, point, direction)[1]))(params)
    assert np.abs(gradient["layer_0"]["kernel"][3:]).max() > 0


def test_the_window_decides_which_bands_are_seen():
    params = random_params(SMALL, jnp.float32)
    query = nerf(SMALL).query
    point, direction = jnp.asarray(POINTS[0], jnp.float32), jnp.asarray(DIRECTIONS[0], jnp.float32)
    slope = jax.grad(lambda params: query(params, point, direction)[0])
    highest = [3 + 6 * c + 2 + s for c in range(3) for s in (0, 3)]  # sine and cosine of the third octave
    for progress, seen in ((0.1, False), (0.35, False), (0.45, True)):
        gradient = slope(set_progress(params, jnp.asarray(progress, jnp.float32)))
        assert (np.abs(gradient["layer_0"]["kernel"][jnp.asarray(highest)]).max() > 0) == seen, progress
        assert float(gradient["progress"]) == 0, "no gradient reaches it"


def test_directions_count_by_where_they_point():
    params = set_progress(random_params(SMALL, jnp.float32), jnp.ones(()))
    query = partial(nerf(SMALL).query, params, jnp.asarray(POINTS[0], jnp.float32))
    direction = jnp.asarray(DIRECTIONS[0], jnp.float32)
    assert_allclose(query(direction)[1], query(7 * direction)[1], atol=1e-6)
    assert np.abs(query(direction)[1] - query(-direction)[1]).max() > 1e-3
    assert float(query(direction)[0]) == float(query(-direction)[0]), "density does not depend on them"
    for derivative in (query, jax.jacrev(query)):
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(derivative(jnp.zeros(3))))


def test_gradients_are_those_of_finite_differences():
    with jax.enable_x64(True):
        params = set_progress(random_params(SMALL, jnp.float64), jnp.asarray(0.4, jnp.float64))
        direction = jnp.asarray(DIRECTIONS[0])
        value = lambda point: jnp.append(*reversed(nerf(SMALL).query(params, point, direction)))
        found = jax.jit(jax.jacrev(value))(jnp.asarray(POINTS[1]))
        for axis in range(3):
            step = 1e-6 * np.eye(3)[axis]
            difference = (value(jnp.asarray(POINTS[1] + step)) - value(jnp.asarray(POINTS[1] - step))) / 2e-6
            assert_allclose(found[:, axis], difference, atol=1e-6)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"layers": 0}, "sizes >= 1"),
        ({"layers": 4, "skip": 3}, "skip: expected a layer from 1 to 2"),
        ({"octaves": -1}, "octaves >= 0"),
        ({"window": (0.5, 0.1)}, "start < end"),
    ],
)
def test_settings_that_mean_nothing(setting, message):
    with pytest.raises(ValueError, match=message):
        NerfConfig(**setting)


def test_the_window_shuts_bands_wherever_an_encoding_enters():
    """Rows of every octave in both encodings: its weights get a gradient once it opens, and none before."""
    params = random_params(SMALL, jnp.float32)
    point, direction = jnp.asarray(POINTS[0], jnp.float32), jnp.asarray(DIRECTIONS[0], jnp.float32)
    slope = jax.jit(jax.grad(lambda params: jnp.sum(nerf(SMALL).query(params, point, direction)[1])))
    for progress, open_3, open_2 in ((0.05, 0, 0), (0.2, 1, 1), (0.28, 2, 1), (0.36, 2, 2), (0.5, 3, 2)):
        gradient = slope(set_progress(params, jnp.asarray(progress, jnp.float32)))
        for name, first, octaves, expected in (
            ("layer_0", 0, 3, open_3),
            ("layer_2", 12, 3, open_3),
            ("colour_0", 12, 2, open_2),
        ):
            bands = np.abs(gradient[name]["kernel"])[first + 3 :].reshape(3, 2, octaves, -1).max((0, 1, 3))
            assert_array_equal(bands > 0, np.arange(octaves) < expected, f"{name} at {progress}")


def test_samples_of_many_rays_are_one_point_at_a_time():
    params = set_progress(random_params(SMALL, jnp.float32), jnp.asarray(0.4, jnp.float32))
    query = partial(nerf(SMALL).query, params)
    points = jnp.asarray(np.random.default_rng(3).uniform(-2, 2, (3, 4, 3)), jnp.float32)
    directions = jnp.asarray(DIRECTIONS[:3], jnp.float32)
    density, rgb = jax.jit(jax.vmap(jax.vmap(query, (0, None))))(points, directions)
    for ray, sample in np.ndindex(3, 4):
        one = query(points[ray, sample], directions[ray])
        assert_allclose(density[ray, sample], one[0], rtol=1e-5)
        assert_allclose(rgb[ray, sample], one[1], atol=1e-6)
