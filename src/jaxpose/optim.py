"""Minimise a loss by any optax transformation: the one descent of this package, compiled as one loop."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

Params = Any
Schedule = Callable[[Int[Array, ""]], Any]

_LOWER = 1e-3  # share by which a loss must fall to count as lower


class Minimum(NamedTuple):
    """Where a descent ended."""

    params: Params
    state: Any  # of the transformation, to go on from
    loss: Float[Array, ""]  # before the last step; a running mean with `smoothing`
    aux: Any  # likewise
    steps: Int[Array, ""]  # taken


def minimize(
    loss: Callable[[Params, Int[Array, ""]], Any],
    params: Params,
    tx: optax.GradientTransformation,
    steps: int | Int[Array, ""],
    *,
    state: Any = None,
    has_aux: bool = False,
    smoothing: float = 0.0,
    patience: int | None = None,
) -> Minimum:
    """Take steps of an optax transformation down a loss.

    Call it within `jax.jit`, or not at all often: it compiles one loop for every `loss` and `tx`.

    Args:
        loss: `loss(params, step)`, a scalar, of step 0, 1, ...; with `has_aux` a pair of it and a pytree of
            arrays. What is random or drawn from data in it follows from the step's number.
        params: where to start.
        tx: any optax transformation, learning rate and schedule included, such as
            `optax.adam(optax.exponential_decay(1e-3, steps, 0.01))`; `scale_by_rates` gives parts of the
            parameters rates of their own.
        steps: how many; traced or not.
        state: of an earlier `Minimum`, to go on from; None: `tx.init(params)`.
        has_aux: whether `loss` returns a pair.
        smoothing: share of the mean so far in the running means of loss and aux; 0: the last values.
        patience: stop as soon as the loss has not been a thousandth lower than its least for so many steps.

    Returns:
        Parameters, state, last loss and aux, and the steps taken.

    >>> found = minimize(lambda x, step: jnp.sum((x - 3) ** 2), jnp.zeros(2), optax.sgd(0.1), steps=100)
    >>> print(jnp.allclose(found.params, 3), int(found.steps))
    True 100
    """
    improve = partial(_improve, loss, optax.with_extra_args_support(tx), has_aux, smoothing)

    def goes_on(carry):
        minimum, _, least_at = carry
        left = minimum.steps < steps
        return left if patience is None else left & (minimum.steps - least_at <= patience)

    shapes = jax.eval_shape(loss, params, jnp.int32(0))
    value, aux = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes if has_aux else (shapes, ()))
    start = Minimum(params, tx.init(params) if state is None else state, value, aux, jnp.int32(0))
    return jax.lax.while_loop(goes_on, improve, (start, jnp.full_like(value, jnp.inf), jnp.int32(0)))[0]


def _improve(loss, tx, has_aux, smoothing, carry):
    """One step, from and to a `Minimum`, the least loss so far and the step that it was found in."""
    minimum, least, least_at = carry
    params, step = minimum.params, minimum.steps
    found, gradient = jax.value_and_grad(loss, has_aux=has_aux)(params, step)
    value, aux = found if has_aux else (found, ())
    again = lambda p: loss(p, step)[0] if has_aux else loss(p, step)  # for line searches
    params, state = _apply(tx, params, gradient, minimum.state, value=value, grad=gradient, value_fn=again)
    if smoothing:
        keep = jnp.where(step == 0, 0.0, smoothing).astype(value.dtype)
        mean = lambda old, new: keep * old + (1 - keep) * new
        value, aux = jax.tree.map(mean, (minimum.loss, minimum.aux), (value, aux))
    lower = value < least * (1 - _LOWER)
    least, least_at = jnp.where(lower, value, least), jnp.where(lower, step, least_at)
    return Minimum(params, state, value, aux, step + 1), least, least_at


def apply(
    tx: optax.GradientTransformation, params: Params, gradient: Params, state: Any
) -> tuple[Params, Any]:
    """One step of a transformation, for a loop of one's own.

    Args:
        tx: any optax transformation.
        params: the parameters, and
        gradient: that of the loss there.
        state: `tx.init(params)`, or what the last step returned.

    Returns:
        The new parameters and the new state.
    """
    return _apply(optax.with_extra_args_support(tx), params, gradient, state)


def scale_by_rates(rates: Any) -> optax.GradientTransformation:
    """The last link of a chain: a learning rate for each part of the parameters.

    Args:
        rates: a prefix of the parameter tree, such as `{"translation": 1e-3, "rotation": 2e-4}`, whose leaves
            are numbers, arrays that broadcast against the parameters, or schedules `step -> rate`. 0 keeps a
            part as it is.

    Returns:
        A transformation, for `optax.chain(optax.scale_by_adam(), scale_by_rates(rates))`.

    >>> tx = scale_by_rates({"a": 0.5, "b": 0.0})
    >>> gradient = {"a": jnp.ones(2), "b": jnp.ones(2)}
    >>> print(tx.update(gradient, tx.init(gradient))[0]["a"])
    [-0.5 -0.5]
    """

    def init(params):
        del params
        return optax.ScaleByScheduleState(jnp.zeros((), jnp.int32))

    def update(updates, state, params=None):
        del params
        now = jax.tree.map(lambda rate: rate(state.count) if callable(rate) else rate, rates)
        now = jax.tree.broadcast(now, updates)
        scaled = jax.tree.map(lambda rate, u: -jnp.asarray(rate, u.dtype) * u, now, updates)
        return scaled, optax.ScaleByScheduleState(optax.safe_increment(state.count))

    return optax.GradientTransformation(init, update)


def _apply(tx, params, gradient, state, **extra):
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # optax needs them
        updates, state = tx.update(gradient, state, params, **extra)
        return optax.apply_updates(params, updates), state
