"""Encodings, activations and perceptrons against formulas and a forward pass written in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxpose import nn


def numpy_mlp(params, x, skip, activation):
    """The perceptron in float64, with no code in common."""
    layers = [params[f"layer_{i}"] for i in range(len(params))]
    hidden = x
    for i, layer in enumerate(layers):
        if i == skip:
            hidden = np.concatenate([hidden, x], axis=-1)
        hidden = hidden @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        if i < len(layers) - 1:
            hidden = activation(hidden)
    return hidden


def random_like(params, dtype):
    """The same tree with other numbers, so that no bias is zero."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(0.5 * rng.normal(size=x.shape), dtype), params)


def test_encoding_of_time_is_the_papers(dtype):
    t = jnp.asarray([0.3], dtype)
    angles = np.pi * 0.3 * 2.0 ** np.arange(5)
    expected = np.concatenate([[0.3], np.sin(angles), np.cos(angles)])
    assert_allclose(nn.frequency_encoding(t, 5), expected, atol=2e-6 if dtype == jnp.float32 else 1e-13)
    assert_allclose(nn.frequency_encoding(t, 0), t)


def test_encoding_of_points_keeps_the_bands_of_a_coordinate_together():
    x = jnp.asarray([[0.1, -0.7, 0.4], [1.3, 0.0, -2.2]])
    angles = np.pi * np.asarray(x, np.float64)[:, :, None] * 2.0 ** np.arange(4)
    bands = np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)  # (2, 3, 8)
    expected = np.concatenate([x, bands.reshape(2, 24)], axis=-1)
    assert_allclose(nn.frequency_encoding(x, 4), expected, atol=5e-6)


def test_high_bands_are_as_exact_as_low_ones():
    """Sine of 2^9 pi t computed as it stands would be off by 1e-4 in float32."""
    t = jnp.linspace(-1, 1, 1001, dtype=jnp.float32)[:, None]
    angles = np.pi * np.asarray(t, np.float64) * 2.0 ** np.arange(10)
    expected = np.concatenate([t, np.sin(angles), np.cos(angles)], axis=-1)
    assert_allclose(nn.frequency_encoding(t, 10), expected, atol=1e-6)


def test_derivatives_of_the_encoding(dtype):
    rates = np.pi * 2.0 ** np.arange(5)
    encode = lambda t: nn.frequency_encoding(t[None], 5)
    first_derivative, second_derivative = jax.jit(jax.jacfwd(encode)), jax.jit(jax.jacfwd(jax.jacfwd(encode)))
    for t in (-1.0, 0.0, 0.5, 0.3):
        first, second = first_derivative(jnp.asarray(t, dtype)), second_derivative(jnp.asarray(t, dtype))
        expected = [[1], rates * np.cos(rates * t), -rates * np.sin(rates * t)]
        assert_allclose(first, np.concatenate(expected), atol=2e-4 if dtype == jnp.float32 else 1e-11)
        expected = [[0], -(rates**2) * np.sin(rates * t), -(rates**2) * np.cos(rates * t)]
        assert_allclose(second, np.concatenate(expected), atol=1e-2 if dtype == jnp.float32 else 1e-10)


@pytest.mark.parametrize(
    ("progress", "expected"),
    [
        (0.0, [0, 0, 0, 0]),
        (0.1, [0, 0, 0, 0]),
        (0.15, [0.5, 0, 0, 0]),  # alpha = 0.5
        (0.3, [1, 1, 0, 0]),
        (0.3 + 0.1 / 3, [1, 1, 0.25, 0]),  # alpha = 2 + 1/3: (1 - cos 60 deg) / 2
        (0.5, [1, 1, 1, 1]),
        (1.0, [1, 1, 1, 1]),
    ],
)
def test_window_opens_one_band_after_another(progress, expected):
    weights = nn.window_weights(jnp.asarray(progress), 4, (0.1, 0.5))
    assert_allclose(weights, expected, atol=1e-6)


def test_window_never_hides_the_raw_input():
    x = jnp.asarray([0.2, -0.9])
    masked = nn.frequency_encoding(x, 3, weights=jnp.asarray([1.0, 0.5, 0.0]))
    full = nn.frequency_encoding(x, 3)
    assert_allclose(masked, full * np.array([1, 1] + 4 * [1, 0.5, 0]), atol=1e-7)


@pytest.mark.parametrize("x", [-200.0, -30.0, -1.0, -1e-3, 0.0, 1e-3, 1.0, 30.0, 200.0])
def test_softplus_and_its_derivatives(x, dtype):
    point = jnp.asarray(x, dtype)
    tolerance = 2e-7 if dtype == jnp.float32 else 1e-15
    sigmoid = 1 / (1 + np.exp(-x))
    assert_allclose(nn.softplus(point), np.logaddexp(0, x), rtol=3 * tolerance, atol=1e-45)
    assert_allclose(jax.grad(nn.softplus)(point), sigmoid, atol=tolerance)
    assert_allclose(jax.grad(jax.grad(nn.softplus))(point), sigmoid * (1 - sigmoid), atol=tolerance)


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("relu", lambda x: np.maximum(x, 0)),
        ("softplus", lambda x: np.logaddexp(0, x)),
        ("sigmoid", lambda x: 1 / (1 + np.exp(-x))),
    ],
)
@pytest.mark.parametrize("skip", [None, 2])
def test_mlp_is_the_forward_pass_written_out(name, function, skip, dtype):
    network = nn.mlp(5, 3, layers=4, width=8, skip=skip, activation=name, precision="highest")
    params = random_like(jax.eval_shape(network.init, jax.random.key(0)), dtype)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(6, 5)), dtype)
    expected = numpy_mlp(params, np.asarray(x, np.float64), skip, function)
    assert_allclose(network.apply(params, x), expected, atol=1e-5 if dtype == jnp.float32 else 1e-13)
    assert_allclose(network.apply(params, x[0]), expected[0], atol=1e-5 if dtype == jnp.float32 else 1e-13)


def test_initial_weights():
    """Xavier-uniform: bounded by gain sqrt(6 / (in + out)) and filling that range; the last layer tiny."""
    network = nn.mlp(11, 3, layers=6, width=128, gain=2.0, small_output=True)
    params = jax.jit(network.init)(jax.random.key(0))
    assert [params[f"layer_{i}"]["kernel"].shape[0] for i in range(6)] == [11, 128, 128, 128, 139, 128]
    for i in range(5):
        kernel = params[f"layer_{i}"]["kernel"]
        bound = 2 * np.sqrt(6 / sum(kernel.shape))
        assert 0.97 * bound < np.max(np.abs(kernel)) <= bound
        assert abs(np.std(kernel) / (bound / np.sqrt(3)) - 1) < 0.05
    last = params["layer_5"]["kernel"]
    assert 0 <= np.min(last) and 0.97e-7 < np.max(last) <= 1e-7
    assert all(np.all(params[f"layer_{i}"]["bias"] == 0) for i in range(6))
