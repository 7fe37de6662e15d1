"""Training: sums over many items whose gradient takes the memory of a few."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Params = Any
Batch = Any


def sum_by_chunks(
    loss: Callable[[Params, Any], Float[Array, ""]], chunk: int
) -> Callable[[Params, Batch], Float[Array, ""]]:
    """`total(params, batch)`: the sum of `loss(params, item)` over the items of `batch`, `chunk` at a time.

    `batch` is a pytree whose arrays share their leading axis; `item` is one entry of it (the chunks are
    vmapped here). Gradients reach `params` and `batch`, so that rays, say, may depend on poses that are
    trained too. They are computed together with the value, one chunk after the other, and the way back only
    scales them: what is stored is never more than one chunk's intermediate values, which stay in the cache.
    Whole numbers and random keys in `batch` get no gradient, nor does anything else that `loss` refers to:
    what is differentiated must come in by the two arguments. For reverse mode only.
    """
    if chunk < 1:
        raise ValueError(f"chunk: expected at least 1 item, got {chunk}")

    def summed(params, items):
        return jnp.sum(jax.vmap(loss, in_axes=(None, 0))(params, items))

    @jax.custom_vjp
    def total(params, batch):
        return _over_chunks(lambda items: (summed(params, items), ()), batch, chunk)[0]

    def forward(params, batch):
        leaves, structure = jax.tree.flatten(batch)
        real = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]

        def of_chunk(leaves):
            def value(params, moved):
                merged = iter(moved)
                both = [next(merged) if is_real else leaf for leaf, is_real in zip(leaves, real, strict=True)]
                return summed(params, jax.tree.unflatten(structure, both))

            moved = [leaf for leaf, is_real in zip(leaves, real, strict=True) if is_real]
            result, (of_params, of_moved) = jax.value_and_grad(value, argnums=(0, 1))(params, moved)
            return (result, of_params), of_moved

        (result, of_params), of_moved = _over_chunks(of_chunk, leaves, chunk)
        moved = iter(of_moved)
        of_batch = jax.tree.unflatten(structure, [next(moved) if is_real else None for is_real in real])
        return result, (of_params, of_batch)

    def backward(gradients, cotangent):
        return jax.tree.map(lambda gradient: gradient * cotangent.astype(gradient.dtype), gradients)

    total.defvjp(forward, backward)
    return total


def _over_chunks(function: Callable[[Batch], tuple[Any, Any]], batch: Batch, chunk: int) -> tuple[Any, Any]:
    """Sum of the first results of `function` over chunks of `batch`, and its second results joined."""
    count = len(jax.tree.leaves(batch)[0])
    whole = count - count % chunk
    sums = []
    joined = []
    if whole:
        chunks = jax.tree.map(lambda x: x[:whole].reshape(-1, chunk, *x.shape[1:]), batch)
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), chunks)
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function, shapes)[0])

        def step(total, items):
            result, rest = function(items)
            return jax.tree.map(jnp.add, total, result), rest

        total, rest = jax.lax.scan(step, zero, chunks)
        sums.append(total)
        joined.append(jax.tree.map(lambda x: x.reshape(whole, *x.shape[2:]), rest))
    if whole < count:
        total, rest = function(jax.tree.map(lambda x: x[whole:], batch))
        sums.append(total)
        joined.append(rest)
    return jax.tree.map(lambda *x: sum(x[1:], x[0]), *sums), jax.tree.map(
        lambda *x: jnp.concatenate(x), *joined
    )
