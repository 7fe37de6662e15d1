"""The descent against a plain loop of optax's own, and closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose

from jaxpose import optim
from jaxpose.optim import minimize, scale_by_rates

START = {"a": np.array([3.0, -2.0], np.float32), "b": np.array([[1.0, 4.0]], np.float32)}


def bowl(params, step):
    """Steeper in `b`; the bottom moves with the step."""
    shift = 0.01 * step.astype(jnp.float32)
    return jnp.sum((params["a"] - shift) ** 2) + 3 * jnp.sum(params["b"] ** 2)


def plain(tx, steps):
    """What a user of optax writes."""
    params, losses = jax.tree.map(jnp.asarray, START), []
    state = tx.init(params)
    with jax.numpy_dtype_promotion("standard"):
        for step in range(steps):
            loss, gradient = jax.value_and_grad(bowl)(params, jnp.asarray(step))
            updates, state = tx.update(gradient, state, params)
            params = optax.apply_updates(params, updates)
            losses.append(float(loss))
    return params, losses


@pytest.mark.parametrize(
    "tx",
    [
        optax.adam(optax.exponential_decay(0.3, 12, 0.1)),
        optax.sgd(0.05, momentum=0.9),
        optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(0.1)),
    ],
)
def test_a_descent_is_optaxs_own_loop(tx):
    expected, losses = plain(tx, 12)
    found = jax.jit(partial(minimize, bowl, tx=tx, steps=12))(START)
    assert_allclose(found.params["a"], expected["a"], rtol=1e-5)
    assert_allclose(found.params["b"], expected["b"], rtol=1e-5, atol=1e-6)
    assert_allclose(found.loss, losses[-1], rtol=1e-5)
    assert int(found.steps) == 12


def test_two_descents_go_on_where_one_goes_through():
    """With the state of the first; the number of steps may be traced."""
    tx = optax.adam(0.1)
    still = lambda params, step: bowl(params, jnp.zeros_like(step))
    descent = jax.jit(lambda params, state, steps: minimize(still, params, tx, steps, state=state))
    start = jax.tree.map(jnp.asarray, START)
    first = descent(start, tx.init(start), 5)
    second = descent(first.params, first.state, 7)
    through = descent(start, tx.init(start), 12)
    jax.tree.map(partial(assert_allclose, rtol=1e-6), second.params, through.params)
    assert descent._cache_size() == 1


def test_it_stops_when_nothing_is_gained():
    """A loss that falls by a tenth a step for 20 steps and then stays: patience of 5 ends it at 26."""
    loss = lambda x, step: 0.9 ** jnp.minimum(step, 20).astype(x.dtype) + 0 * x
    descend = lambda **options: minimize(loss, jnp.zeros(()), optax.sgd(0.1), 100, **options)
    assert int(descend(patience=5).steps) == 26
    assert int(descend().steps) == 100
    # A running mean follows the loss late, and so is still falling when the loss no longer is.
    assert int(descend(patience=5, smoothing=0.8).steps) > 35


def test_aux_is_a_running_mean():
    loss = lambda x, step: (x**2, {"step": step.astype(x.dtype)})
    found = minimize(loss, jnp.ones(()), optax.sgd(0.0), 4, has_aux=True, smoothing=0.5)
    assert float(found.aux["step"]) == 3 / 2 + 2 / 4 + 1 / 8
    assert float(minimize(loss, jnp.ones(()), optax.sgd(0.0), 4, has_aux=True).aux["step"]) == 3


def test_a_line_search_has_what_it_needs():
    """L-BFGS, with Rosenbrock's valley: optax asks it for values of the loss along the way."""
    valley = lambda x, step: (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
    found = jax.jit(lambda x: minimize(valley, x, optax.lbfgs(), 60))(jnp.array([-1.2, 1.0]))
    assert_allclose(found.params, [1.0, 1.0], atol=1e-3)


def test_parts_have_rates_of_their_own():
    """A schedule and an array that broadcasts; the first step of Adam has the length of its rate."""
    rates = {"a": lambda count: 0.1 / (1.0 + count), "b": np.array([[0.0, 0.2]], np.float32)}
    tx = optax.chain(optax.scale_by_adam(), scale_by_rates(rates))
    still = lambda params, step: bowl(params, jnp.zeros_like(step))
    found = minimize(still, jax.tree.map(jnp.asarray, START), tx, 1)
    assert_allclose(found.params["a"], [2.9, -1.9], rtol=1e-5)
    assert_allclose(found.params["b"], [[1.0, 3.8]], rtol=1e-5)
    again = minimize(still, found.params, tx, 1, state=found.state)
    assert_allclose(found.params["a"] - again.params["a"], [0.05, -0.05], rtol=0.05)


def test_one_step_of_a_loop_of_ones_own():
    tx, params = optax.sgd(0.1), jnp.asarray([1.0, 2.0])
    moved, _ = optim.apply(tx, params, jnp.asarray([10.0, 0.0]), tx.init(params))
    assert_allclose(moved, [0.0, 2.0], atol=1e-7)
