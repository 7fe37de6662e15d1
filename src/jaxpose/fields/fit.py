"""Fit any pose field to stamped poses: how a trajectory is started, kept and read from a list."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose import se3
from jaxpose.fields.base import Params, PoseField

_DELTA = 1e-2  # [rad or length scales] smaller residuals count by their square, larger by their size


class FitResult(NamedTuple):
    """Fitted parameters, and what is left: root mean square errors over all poses."""

    params: Params
    translation_rmse_m: Float[Array, ""]
    rotation_rmse_deg: Float[Array, ""]


def fit(
    field: PoseField,
    times: Float[Array | np.ndarray, " n"],
    poses: Float[Array | np.ndarray, "n 4 4"],
    *,
    key: PRNGKeyArray | None = None,
    params: Params | None = None,
    steps: int = 1000,
    learning_rate: Any = 1e-3,
    decay: float = 1e-2,
    length_scale: float = 1.0,
    batch: int = 256,
) -> FitResult:
    """Fit a field to poses `T_reference_body` at `times` [s] by Adam, in one compiled call.

    The start is `params` (a warm start), else `field.init(key)`. With log(P(t)^-1 T) = [rho, phi] the loss is
    the mean over poses of a pseudo-Huber function of |rho| / length_scale and of |phi|: `length_scale` [m] is
    the displacement that matters as much as one radian. Of more than `batch` poses each step takes every
    k-th, the offset going round.

    `learning_rate` is a number or a prefix of the parameter tree, such as METHOD's `{"translation": 1e-3,
    "rotation": 2e-4}`; 0 keeps a part as it is. It falls exponentially, to `decay` times itself at the end
    (1: constant). 1e-3 suits networks; a table or a spline, whose parameters are poses, takes 3e-2.

    Other values of arrays, rates, decay and length scale do not recompile. Another field object, shape or
    number of steps does, so make the field once.
    """
    if params is None:
        if key is None:
            raise ValueError("fit: expected `params` or a `key` to start from")
        params = field.init(key)
    dtype = jax.tree.leaves(params)[0].dtype
    rates = jax.tree.broadcast(learning_rate, params)
    arrays = jax.tree.map(lambda x: jnp.asarray(x, dtype), (times, poses, rates, decay, length_scale))
    return _fit(field, steps, batch, params, *arrays)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _fit(field, steps, batch, params, times, poses, rates, decay, length_scale) -> FitResult:
    adam = optax.scale_by_adam(eps=1e-15)  # one pose in thousands has gradients below the usual 1e-8
    count = times.shape[0]
    rounds = -(-count // batch)  # steps in which every pose comes up once
    indices = jnp.arange(0, count, rounds)

    def loss(params, times, poses):
        rho, phi = jnp.split(_residuals(field, params, times, poses), 2, axis=-1)
        return jnp.mean(_pseudo_huber(rho / length_scale) + _pseudo_huber(phi))

    def step(carry, number):
        params, state = carry
        chosen = (indices + number % rounds) % count
        gradient = jax.grad(loss)(params, times[chosen], poses[chosen])
        with jax.numpy_dtype_promotion("standard"):  # optax needs it
            direction, state = adam.update(gradient, state)
        fall = decay ** (number.astype(decay.dtype) / steps)
        params = jax.tree.map(lambda p, rate, d: p - rate * fall * d, params, rates, direction)
        return (params, state), None

    (params, _), _ = jax.lax.scan(step, (params, adam.init(params)), jnp.arange(steps))
    rho, phi = jnp.split(_residuals(field, params, times, poses), 2, axis=-1)
    return FitResult(params, _rms(rho), jnp.rad2deg(_rms(phi)))


def _residuals(field, params, times, poses) -> Float[Array, "n 6"]:
    found = jax.vmap(field.pose, in_axes=(None, 0))(params, times)
    return se3.log(se3.compose(se3.inverse(found), poses))


def _pseudo_huber(x: Float[Array, "n 3"]) -> Float[Array, " n"]:
    # sqrt(1 + square) - 1, written so that it does not cancel for small residuals.
    square = jnp.sum(x**2, axis=-1) / _DELTA**2
    return square / (1 + jnp.sqrt(1 + square))


def _rms(x: Float[Array, "n 3"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.mean(jnp.sum(x**2, axis=-1)))
