"""Joint training of a scene and a pose field, and sums over many items in the memory of a few."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxpose.fields import set_progress

Params = Any
Batch = Any


class Rate(NamedTuple):
    """Adam's learning rate over the training: exponential from `first` to `last`, zero before `start`.

    `start` is a share of the training. All three may be arrays that broadcast against the parameters.
    """

    first: Any
    last: Any
    start: Any = 0.0


class State(NamedTuple):
    """All that a training goes on from."""

    scene: Params
    pose: Params
    adam: Any
    key: PRNGKeyArray
    step: Int[Array, ""]


class Trainer(NamedTuple):
    """Compiled functions of one training."""

    start: Callable[[PRNGKeyArray], State]
    # Some steps (static) on the data, and the loss of each.
    advance: Callable[[State, Batch, int], tuple[State, Float[Array, " k"]]]


def joint(
    loss: Callable[[Params, Params, Batch, PRNGKeyArray], Float[Array, ""]],
    init_scene: Callable[[PRNGKeyArray], Params],
    init_pose: Callable[[PRNGKeyArray], Params],
    scene_rates: Any,
    pose_rates: Any,
    steps: int,
) -> Trainer:
    """Adam on `loss(scene, pose, data, key)`, jointly over the parameters of scene and poses.

    The rates are trees of `Rate`, each a prefix of its parameters. Coarse-to-fine windows of scene and field
    follow the steps.
    """
    adam = optax.scale_by_adam()

    def start(key):
        scene_key, pose_key, key = jax.random.split(key, 3)
        first = init_scene(scene_key), init_pose(pose_key)
        return State(*first, adam.init(first), key, jnp.zeros((), jnp.int32))

    def step(state, _, data):
        key, loss_key = jax.random.split(state.key)
        progress = state.step.astype(jnp.zeros(()).dtype) / steps
        params = _at(state.scene, progress), _at(state.pose, progress)
        value, gradient = jax.value_and_grad(lambda both: loss(both[0], both[1], data, loss_key))(params)
        with jax.numpy_dtype_promotion("standard"):  # optax needs it
            direction, memory = adam.update(gradient, state.adam)
        rates = scene_rates, pose_rates
        moves = jax.tree.map(lambda rate: _rate(rate, progress), rates, is_leaf=_is_rate)
        moves = jax.tree.broadcast(moves, params)
        scene_params, pose_params = jax.tree.map(lambda p, rate, d: p - rate * d, params, moves, direction)
        return State(scene_params, pose_params, memory, key, state.step + 1), value

    def advance(state, data, count):
        return jax.lax.scan(partial(step, data=data), state, length=count)

    return Trainer(jax.jit(start), jax.jit(advance, static_argnums=2))


def microbatched_sum(
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
        return _over_microbatches(lambda items: (summed(params, items), ()), batch, chunk)[0]

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

        (result, of_params), of_moved = _over_microbatches(of_chunk, leaves, chunk)
        moved = iter(of_moved)
        of_batch = jax.tree.unflatten(structure, [next(moved) if is_real else None for is_real in real])
        return result, (of_params, of_batch)

    def backward(gradients, cotangent):
        return jax.tree.map(lambda gradient: gradient * cotangent.astype(gradient.dtype), gradients)

    total.defvjp(forward, backward)
    return total


def _over_microbatches(
    function: Callable[[Batch], tuple[Any, Any]], batch: Batch, chunk: int
) -> tuple[Any, Any]:
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


def _at(params: Params, progress: Float[Array, ""]) -> Params:
    """Parameters whose coarse-to-fine window, if they have one, is where the training is."""
    has_window = isinstance(params, dict) and "progress" in params
    return set_progress(params, progress) if has_window else params


def _is_rate(x: Any) -> bool:
    return isinstance(x, Rate)


def _rate(rate: Rate, progress: Float[Array, ""]) -> Float[Array, "*n"]:
    first, last, start = (jnp.asarray(x, progress.dtype) for x in rate)
    # Not first (last / first)^progress: a rate of zero keeps its parameters at rest.
    return jnp.where(progress >= start, first ** (1 - progress) * last**progress, 0)
