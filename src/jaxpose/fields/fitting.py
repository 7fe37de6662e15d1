"""Fit any pose field to stamped poses: how a trajectory is started, kept and read from a list."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose.fields.types import Params, PoseField

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

    The start is `params` (a warm start), else `field.init(key)`. The loss is the mean over poses of a
    pseudo-Huber function of distance / length_scale and of the chord 2 sin(angle / 2): `length_scale` [m] is
    the displacement that matters as much as one radian. (The chord is smooth at half a turn, where the twist
    log(P(t)^-1 T) jumps, and the same as the angle for small ones.) Of more than `batch` poses each step
    takes every k-th, the offset going round.

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
        distance, chord = _squares(field, params, times, poses)
        return jnp.mean(_pseudo_huber(distance / length_scale**2) + _pseudo_huber(chord))

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
    distance, chord = _squares(field, params, times, poses)
    angle = 2 * jnp.arcsin(jnp.minimum(jnp.sqrt(chord) / 2, 1))
    return FitResult(params, jnp.sqrt(jnp.mean(distance)), jnp.rad2deg(jnp.sqrt(jnp.mean(angle**2))))


def _squares(field, params, times, poses) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Squares of the distance [m] and of the chord of the angle between found and given poses."""
    error = jax.vmap(field.pose, in_axes=(None, 0))(params, times) - poses
    return jnp.sum(error[:, :3, 3] ** 2, axis=-1), jnp.sum(error[:, :3, :3] ** 2, axis=(-2, -1)) / 2


def _pseudo_huber(square: Float[Array, " n"]) -> Float[Array, " n"]:
    # sqrt(1 + x) - 1, written so that it does not cancel for small residuals.
    x = square / _DELTA**2
    return x / (1 + jnp.sqrt(1 + x))
