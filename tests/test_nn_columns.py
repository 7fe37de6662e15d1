"""Layers for many points against numpy, under every vmap and in both directions of differentiation."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxpose import nn, nn_columns
from jaxpose.nn_columns import dense, frequency_encoding, product, spread

TOLERANCE = {jnp.float32: 3e-5, jnp.float64: 1e-12}
# Axes of the vmaps, inner ones first, with the shape of what each mapped argument gains.
RNG = np.random.default_rng(0)
LAYER = {"kernel": RNG.normal(size=(5, 3)), "bias": RNG.normal(size=3)}


@pytest.fixture(autouse=True, params=["primitives", "plain"])
def rules(request, monkeypatch):
    """Every test twice: with rules of our own, which this JAX takes, and as on one that does not."""
    assert nn_columns._product is not None and nn_columns._spread is not None
    if request.param == "plain":
        monkeypatch.setattr(nn_columns, "_product", None)
        monkeypatch.setattr(nn_columns, "_spread", None)


@pytest.mark.parametrize("gone", ["jax.core", "jax.extend.core", "jax.interpreters.batching"])
def test_a_jax_without_a_place_for_rules(gone, monkeypatch):
    monkeypatch.setitem(sys.modules, gone, None)
    if gone == "jax.interpreters.batching":
        monkeypatch.delattr(jax.interpreters, "batching")
    assert nn_columns._primitives() == (None, None)


def layer_as(dtype):
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), LAYER)


def test_dense_at_one_and_many_points(dtype):
    x = RNG.normal(size=(4, 6, 5))
    expected = x @ LAYER["kernel"] + LAYER["bias"]
    layer, points = layer_as(dtype), jnp.asarray(x, dtype)
    exact = lambda layer, x: dense(layer, x, precision="highest")
    assert_allclose(exact(layer, points[1, 2]), expected[1, 2], rtol=TOLERANCE[dtype])
    many = jax.vmap(jax.vmap(exact, in_axes=(None, 0)), in_axes=(None, 0))
    assert_allclose(jax.jit(many)(layer, points), expected, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])
    moved = jax.vmap(jax.vmap(exact, (None, 1), 1), (None, 0))(layer, jnp.swapaxes(points, 1, 2))
    assert_allclose(jnp.swapaxes(moved, 1, 2), expected, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


def test_a_layer_of_its_own_for_every_point():
    kernels, x = RNG.normal(size=(4, 5, 3)), RNG.normal(size=(4, 5))
    biases = RNG.normal(size=(4, 3))
    layers = {"kernel": jnp.asarray(kernels, jnp.float32), "bias": jnp.asarray(biases, jnp.float32)}
    points = jnp.asarray(x, jnp.float32)
    expected = np.einsum("nio,ni->no", kernels, x) + biases
    assert_allclose(jax.vmap(dense)(layers, points), expected, atol=1e-5)
    one_point = np.einsum("nio,i->no", kernels, x[0]) + biases
    assert_allclose(jax.vmap(dense, in_axes=(0, None))(layers, points[0]), one_point, atol=1e-5)


@pytest.mark.parametrize("values_axes", [(None, None), (0, None), (None, 0), (0, 0)], ids=str)
def test_spread_is_the_identity_under_every_vmap(values_axes):
    """Inner vmap of 6, outer of 4; the sum of what is spread has the number of points as its gradient."""
    inner, outer = values_axes
    shape = (4,) * (outer is not None) + (6,) * (inner is not None) + (3,)
    values, x = jnp.asarray(RNG.normal(size=shape), jnp.float32), jnp.ones((4, 6, 5), jnp.float32)
    many = jax.vmap(jax.vmap(spread, in_axes=(inner, 0)), in_axes=(outer, 0))
    middle = np.asarray(values).reshape(4 if outer == 0 else 1, 6 if inner == 0 else 1, 3)
    assert_allclose(many(values, x), np.broadcast_to(middle, (4, 6, 3)))
    weights = jnp.asarray(RNG.normal(size=(4, 6, 3)), jnp.float32)
    gradient = jax.grad(lambda values: jnp.sum(weights * many(values, x)))(values)
    over = tuple(axis for axis, mapped in ((0, outer), (1, inner)) if mapped is None)
    assert_allclose(gradient, np.asarray(weights).sum(axis=over), rtol=1e-5, atol=1e-6)


def test_spread_of_what_is_not_mapped():
    """Only the values have an axis, x has none."""
    values = jnp.asarray(RNG.normal(size=(4, 3)), jnp.float32)
    assert_allclose(jax.vmap(spread, in_axes=(0, None))(values, jnp.ones(5)), values)


def test_gradients_of_two_layers(dtype):
    """Backward, forward, and forward over backward, against the formula with plain products."""
    second = {"kernel": RNG.normal(size=(3, 2)), "bias": RNG.normal(size=2)}
    layers = [layer_as(dtype), jax.tree.map(lambda x: jnp.asarray(x, dtype), second)]
    points = jnp.asarray(RNG.normal(size=(4, 6, 5)), dtype)

    def plain(layers, x):
        for layer in layers:
            x = jnp.tanh(jnp.matmul(x, layer["kernel"], precision="highest") + layer["bias"])
        return jnp.sum(x**2)

    def columns(layers, x):
        for layer in layers:
            x = jnp.tanh(dense(layer, x, precision="highest"))
        return jnp.sum(x**2)

    def derivatives(one):
        loss = lambda layers, x: jnp.sum(jax.vmap(jax.vmap(one, (None, 0)), (None, 0))(layers, x))
        gradient = jax.grad(loss, argnums=(0, 1))
        shift = jax.tree.map(jnp.ones_like, (layers, points))
        return jax.jit(lambda a, b: jax.jvp(gradient, (a, b), shift))(layers, points)

    # jax.vmap of the plain form broadcasts the bias.
    with jax.numpy_rank_promotion("allow"):
        expected = derivatives(plain)
    close = lambda a, b: assert_allclose(a, b, rtol=TOLERANCE[dtype], atol=30 * TOLERANCE[dtype])
    jax.tree.map(close, derivatives(columns), expected)


def test_gradient_of_every_point_by_itself():
    """vmap of grad, not grad of vmap: nothing may be summed over the points."""
    points, kernel = jnp.asarray(RNG.normal(size=(4, 5)), jnp.float32), layer_as(jnp.float32)["kernel"]
    gradients = jax.vmap(jax.grad(lambda k, x: product(k, x)[1]), in_axes=(None, 0))(kernel, points)
    expected = np.zeros((4, 5, 3))
    expected[:, :, 1] = points
    assert_allclose(gradients, expected)


@pytest.mark.parametrize("weights", [None, [1.0, 0.5, 0.0]])
def test_encoding_is_that_of_nn(weights, dtype):
    x = jnp.asarray(RNG.uniform(-3, 3, size=(4, 6, 2)), dtype)
    weights = None if weights is None else jnp.asarray(weights, dtype)
    columns = lambda x: frequency_encoding(x, 3, weights=weights)
    found = jax.jit(jax.vmap(jax.vmap(columns)))(x)
    assert found.dtype == dtype
    assert_allclose(found, nn.frequency_encoding(x, 3, weights=weights), atol=1e-6)
    one = lambda x: nn.frequency_encoding(x, 3, weights=weights)
    for derivative in (jax.jacrev, lambda f: jax.jacfwd(jax.jacfwd(f))):
        expected = jax.jit(derivative(one))(x[0, 0])
        assert_allclose(jax.jit(jax.vmap(derivative(columns)))(x[0])[0], expected, rtol=1e-4, atol=1e-3)


def test_high_bands_are_as_exact_as_low_ones():
    t = jnp.linspace(-1, 1, 1001, dtype=jnp.float32)[:, None]
    angles = np.pi * np.asarray(t, np.float64) * 2.0 ** np.arange(10)
    expected = np.concatenate([t, np.sin(angles), np.cos(angles)], axis=-1)
    assert_allclose(jax.vmap(lambda t: frequency_encoding(t, 10))(t), expected, atol=1e-6)
