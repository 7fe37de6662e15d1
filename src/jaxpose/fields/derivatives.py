"""Velocity, body rate and acceleration of any pose function, by forward mode: exact, never differenced.

A pose function maps one time [s] to `T_world_body`; whatever time scaling it does inside, the derivatives
here are per second. `world` stands for the frame that the pose function expresses its poses in. For many
times, `jax.vmap`: a network then sees them as one matrix.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.geometry import se3

PoseFn = Callable[[Any], Float[Array, "4 4"]]


class Motion(NamedTuple):
    """A pose and its first two derivatives in time.

    Linear quantities are those of the body's origin in world axes, angular ones are relative to the world in
    body axes: `dR/dt = R hat(omega_body)`. Gravity is no part of `acceleration_world`.
    """

    pose: Float[Array, "*n 4 4"]  # T_world_body
    velocity_world: Float[Array, "*n 3"]  # m/s
    omega_body: Float[Array, "*n 3"]  # rad/s
    acceleration_world: Float[Array, "*n 3"]  # m/s^2
    alpha_body: Float[Array, "*n 3"]  # rad/s^2, d omega_body / dt


def velocity(pose_fn: PoseFn, t: Any) -> tuple[Float[Array, "4 4"], Float[Array, "3"], Float[Array, "3"]]:
    """The pose at a time, its velocity in world axes and its body rate.

    Args:
        pose_fn: `t -> T_world_body`, such as `partial(field.pose, params)`.
        t: one time [s]: a float, an int, or an array of shape ().

    Returns:
        `T_world_body` (4, 4), the velocity (3,) [m/s] and the body rate (3,) [rad/s].

    Raises:
        ValueError: more than one time.
    """
    t = _one_time(t)
    T, dT = jax.jvp(pose_fn, (t,), (jnp.ones_like(t),))
    return T, dT[:3, 3], _body_rate(T, dT)


def motion(pose_fn: PoseFn, t: Any) -> Motion:
    """The pose at a time with its first and second derivatives, from one shared forward pass.

    Args:
        pose_fn: `t -> T_world_body`, such as `partial(field.pose, params)`.
        t: one time [s]: a float, an int, or an array of shape ().

    Returns:
        A `Motion`, its parts without leading axes.

    Raises:
        ValueError: more than one time.

    >>> turning = lambda t: se3.exp(t * jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.4]))
    >>> print(motion(turning, 1.5).omega_body.round(6) + 0.0)
    [0.  0.  0.4]
    """
    t = _one_time(t)
    one = jnp.ones_like(t)
    (T, dT), (_, ddT) = jax.jvp(lambda s: jax.jvp(pose_fn, (s,), (one,)), (t,), (one,))
    # d/dt R^T R' = R^T R'' + R'^T R', of which the second term is symmetric and so no part of the rate.
    return Motion(T, dT[:3, 3], _body_rate(T, dT), ddT[:3, 3], _body_rate(T, ddT))


def _one_time(t: Any) -> Float[Array, ""]:
    if np.shape(t) != ():
        raise ValueError(f"t: expected one time [s], of shape (), got shape {np.shape(t)}: use jax.vmap")
    t = jnp.asarray(t)
    return t if jnp.issubdtype(t.dtype, jnp.floating) else t.astype(jnp.zeros(()).dtype)


def _body_rate(T: Float[Array, "4 4"], dT: Float[Array, "4 4"]) -> Float[Array, "3"]:
    """The vector of R^T dR, the rotation part of T^-1 dT."""
    return se3.vee(se3.compose(se3.inverse(T), dT)[:3, :3])
