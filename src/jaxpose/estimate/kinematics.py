"""Pose, body twist and its rate along a cumulative cubic B-spline on SE(3), with Jacobians in closed form.

A control pose is moved on its right, `C <- C exp(delta)`; twists are [translation, rotation] in body axes.
The recursion is that of Sommer et al. 2020, "Efficient derivative computation for cumulative B-splines on Lie
groups", sections 4 and 5, on SE(3). Functions are of one place on the spline: `vmap` them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxpose.geometry import se3


class Segment(NamedTuple):
    """An interval between knots: the control pose that it starts from, and the three increments after it."""

    start: Float[Array, "*n 4 4"]
    increment: Float[Array, "*n 3 6"]  # log(C_j-1^-1 C_j)
    by_next: Float[Array, "*n 3 6 6"]  # derivative of each by its later control pose
    by_previous: Float[Array, "*n 3 6 6"]  # and by its earlier one


class Kinematics(NamedTuple):
    """The motion at one place of a segment, and its derivatives by the segment's four control poses."""

    T: Float[Array, "*n 4 4"]  # T_ref_body
    twist: Float[Array, "*n 6"]  # [m/s, rad/s] in body axes
    twist_rate: Float[Array, "*n 6"]  # d twist / dt
    pose_jacobian: Float[Array, "*n 6 24"]  # of the body's own increment, T exp(.)
    twist_jacobian: Float[Array, "*n 6 24"]
    rate_jacobian: Float[Array, "*n 6 24"]


def segments(control_poses: Float[Array, "k 4 4"]) -> Segment:
    """All k - 3 segments of a spline.

    Args:
        control_poses: `T_ref_body` (k, 4, 4); neighbours less than half a turn apart.

    Returns:
        Arrays with leading axis k - 3.
    """
    relative = se3.compose(se3.inverse(control_poses[:-1]), control_poses[1:])
    increment = se3.log(relative)
    by_next = jnp.linalg.inv(jax.vmap(right_jacobian)(increment))
    # exp(-d) exp(x) is exp(x) exp(-Ad(exp(-x)) d)
    by_previous = -by_next @ se3.adjoint(se3.inverse(relative))
    three = lambda x: jnp.stack([x[j : len(x) - 2 + j] for j in range(3)], axis=1)
    return Segment(control_poses[:-3], three(increment), three(by_next), three(by_previous))


def basis(u: Float[Array, "*n"], interval: Float[Array, ""]) -> Float[Array, "*n 3 3"]:
    """The cumulative basis of a cubic B-spline with its first two derivatives in time.

    Args:
        u: place in the segment, 0 to 1.
        interval: length of the segment [s].

    Returns:
        Rows [value, first [1/s], second [1/s^2]]; columns are the three increments.
    """
    zero = jnp.zeros_like(u)
    value = [(5 + u * (3 + u * (u - 3))) / 6, (1 + u * (3 + u * (3 - 2 * u))) / 6, u**3 / 6]
    first = [(1 - u) ** 2 / 2, (1 + 2 * u * (1 - u)) / 2, u**2 / 2]
    second = [u - 1, 1 - 2 * u, u + zero]
    rows = [jnp.stack(x, axis=-1) / interval**k for k, x in enumerate((value, first, second))]
    return jnp.stack(rows, axis=-2)


def kinematics(segment: Segment, weights: Float[Array, "3 3"]) -> Kinematics:
    """The motion at one place of one segment.

    Args:
        segment: without leading axes.
        weights: of `basis` at the place.

    Returns:
        The motion with its Jacobians.
    """
    dtype = segment.start.dtype
    identity, nothing = jnp.eye(6, dtype=dtype), jnp.zeros((4, 6, 6), dtype)

    def increment(so_far, of_one):
        T, twist, rate, by_pose, by_twist, by_rate = so_far
        x, (step, speed, change), own = of_one
        moved = se3.exp(step * x)
        back = se3.adjoint(se3.inverse(moved))
        turned = step * right_jacobian(step * x)
        carried_twist, carried_rate = back @ twist, back @ rate
        twist = carried_twist + speed * x
        bracket = speed * ad(x)
        rate = carried_rate - bracket @ twist + change * x
        by_pose = back @ by_pose + own * turned[None]
        own_twist = ad(carried_twist) @ turned + speed * identity
        by_twist = back @ by_twist + own * own_twist[None]
        own_rate = ad(carried_rate) @ turned + speed * ad(twist) + change * identity
        by_rate = back @ by_rate + own * own_rate[None] - bracket @ by_twist
        return (se3.compose(T, moved), twist, rate, by_pose, by_twist, by_rate), None

    # derivatives by the start, then by each increment
    start = (segment.start, jnp.zeros(6, dtype), jnp.zeros(6, dtype))
    start += (nothing.at[0].set(identity), nothing, nothing)
    each = (segment.increment, weights.T, jnp.eye(4, dtype=dtype)[1:, :, None, None])
    (T, twist, rate, *derivatives), _ = jax.lax.scan(increment, start, each)
    return Kinematics(T, twist, rate, *(_by_control_poses(d, segment) for d in derivatives))


def _by_control_poses(d: Float[Array, "4 6 6"], segment: Segment) -> Float[Array, "6 24"]:
    """Derivatives by the four control poses from those by the start and by the three increments."""
    by = [d[0] + d[1] @ segment.by_previous[0]]
    by += [d[j] @ segment.by_next[j - 1] + d[j + 1] @ segment.by_previous[j] for j in (1, 2)]
    return jnp.concatenate([*by, d[3] @ segment.by_next[2]], axis=1)


def ad(x: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """The Lie bracket with a twist as a matrix: `ad(x) y = [x, y]`.

    Args:
        x: a twist.

    Returns:
        The derivative of `adjoint(exp(s x))` by s at 0 (Sola et al. 2018, table 1).
    """
    turn, shift = se3.hat(x[3:]), se3.hat(x[:3])
    upper = jnp.concatenate([turn, shift], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([jnp.zeros_like(turn), turn], axis=1)])


def right_jacobian(x: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """How an exponential moves on its right: `exp(x + d) = exp(x) exp(J d)` for small d.

    Args:
        x: a twist.

    Returns:
        J, by forward mode through `se3.exp`, whose series at 0 it inherits.
    """
    T, dT = se3.exp(x), jax.jacfwd(se3.exp)(x)
    own = jnp.einsum("ji,jkd->ikd", T[:3, :3], dT[:3], precision="highest")
    return jnp.concatenate([own[:, 3], jnp.stack([own[2, 1], own[0, 2], own[1, 0]])])
