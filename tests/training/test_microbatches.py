"""Sums by chunks against the plain sum and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxpose.training.steps import microbatched_sum

ITEMS = 11
RTOL = {jnp.float32: 2e-5, jnp.float64: 1e-12}


def setting(dtype):
    """Parameters, and a batch that depends on more parameters, as rays depend on poses."""
    rng = np.random.default_rng(0)
    array = lambda *shape: jnp.asarray(rng.normal(size=shape), dtype)
    params = {"kernel": array(3, 4), "unused": array(2)}
    return params, array(3), {"x": array(ITEMS, 3), "index": jnp.arange(ITEMS) % 4}


def loss(params, item):
    hidden = jnp.tanh(jnp.matmul(item["x"], params["kernel"], precision="highest"))
    return jnp.sum(hidden**2) * hidden[item["index"]]


def plain(params, shift, batch):
    moved = batch | {"x": jnp.sin(batch["x"] + shift[None])}
    return 3 * jnp.sum(jax.vmap(loss, in_axes=(None, 0))(params, moved))


def chunked(chunk):
    total = microbatched_sum(loss, chunk)
    return lambda params, shift, batch: 3 * total(params, batch | {"x": jnp.sin(batch["x"] + shift[None])})


@pytest.mark.parametrize("chunk", [1, 4, ITEMS, 20])  # 4 leaves a rest of 3
def test_value_and_gradients_are_those_of_the_plain_sum(chunk, dtype):
    arguments = setting(dtype)
    expected, gradients = jax.value_and_grad(plain, argnums=(0, 1))(*arguments)
    value, found = jax.jit(jax.value_and_grad(chunked(chunk), argnums=(0, 1)))(*arguments)
    assert value.dtype == dtype
    assert_allclose(value, expected, rtol=RTOL[dtype])
    jax.tree.map(
        lambda a, b: assert_allclose(a, b, rtol=RTOL[dtype], atol=10 * RTOL[dtype]), found, gradients
    )
    assert_allclose(jax.jit(chunked(chunk))(*arguments), expected, rtol=RTOL[dtype])


def test_items_with_random_keys():
    def noisy(params, item):
        x, key = item
        return params * jnp.sum(x * jax.random.normal(key, x.shape))

    keys = jax.random.split(jax.random.key(0), 6)
    noise = np.stack([jax.random.normal(key, (2,)) for key in jax.random.split(jax.random.key(0), 6)])
    x = jnp.asarray(np.random.default_rng(0).normal(size=(6, 2)), jnp.float32)
    gradient = jax.grad(lambda x: microbatched_sum(noisy, 3)(jnp.float32(2), (x, keys)))(x)
    assert_allclose(gradient, 2 * noise, rtol=1e-6)


def test_the_network_is_traced_once_and_the_value_alone_takes_no_gradient():
    """Counted in the loss: as often as it is run, what it calls back is run once an item and direction."""
    seen = []

    @jax.custom_vjp
    def watched(x):
        return x

    def forward(x):
        jax.debug.callback(lambda: seen.append("gradient"))
        return x, ()

    watched.defvjp(forward, lambda _, cotangent: (cotangent,))
    total = microbatched_sum(lambda params, x: watched(params * x), 2)
    x = jnp.ones(6)
    assert jax.jit(total)(jnp.ones(()), x) == 6
    jax.effects_barrier()
    assert seen == []
    step = jax.jit(jax.grad(total))
    assert step(jnp.ones(()), x) == 6
    assert step(jnp.ones(()), 2 * x) == 12
    assert step._cache_size() == 1
    jax.effects_barrier()
    assert seen


def test_wrong_chunk():
    with pytest.raises(ValueError, match="chunk: expected at least 1 item, got 0"):
        microbatched_sum(loss, 0)
