"""The reductions against numpy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxpose.losses import weighted_mean


def test_it_is_numpys_weighted_average(dtype):
    rng = np.random.default_rng(0)
    x, weight = rng.normal(size=(5, 3)), rng.uniform(0, 2, (5, 3))
    found = jax.jit(weighted_mean)(jnp.asarray(x, dtype), jnp.asarray(weight, dtype))
    assert found.dtype == dtype
    assert_allclose(found, np.average(x, weights=weight), rtol=1e-5)


def test_small_weights_are_not_swamped(dtype):
    assert_allclose(weighted_mean(jnp.asarray([3.0], dtype), jnp.asarray([1e-6], dtype)), 3, rtol=1e-5)


def test_without_weight_it_is_zero_and_so_is_its_gradient(dtype):
    x, zero = jnp.ones(4, dtype), jnp.zeros(4, dtype)
    value, gradient = jax.value_and_grad(weighted_mean)(x, zero)
    assert value == 0
    assert not np.any(gradient)


def test_shapes_do_not_broadcast(unchecked):
    with pytest.raises(ValueError, match=r"x, weight: expected one shape, got \(3,\) and \(3, 1\)"):
        weighted_mean(jnp.ones(3), jnp.ones((3, 1)))
