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
    by_next = jax.vmap(_inverse_right_jacobian)(increment)
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
    identity = jnp.eye(6, dtype=segment.start.dtype)
    step = weights[0, :, None] * segment.increment
    moved = se3.exp(step)
    back = se3.adjoint(se3.inverse(moved))
    turned = weights[0, :, None, None] * jax.vmap(right_jacobian)(step)
    own = weights[1, :, None] * segment.increment
    bracket = jax.vmap(ad)(own)
    T, twist, rate = segment.start, 0 * own[0], 0 * own[0]
    # Derivatives by the start (of the pose alone), then by each increment so far.
    by_pose, by_twist, by_rate = identity, identity[:, :0], identity[:, :0]
    for j, (_, speed, change) in enumerate(weights.T):
        carried_twist, carried_rate = back[j] @ twist, back[j] @ rate
        twist = carried_twist + own[j]
        rate = carried_rate - bracket[j] @ twist + change * segment.increment[j]
        own_twist = ad(carried_twist) @ turned[j] + speed * identity
        own_rate = ad(carried_rate) @ turned[j] + speed * ad(twist) + change * identity
        by_pose = jnp.concatenate([back[j] @ by_pose, turned[j]], axis=1)
        by_twist = jnp.concatenate([back[j] @ by_twist, own_twist], axis=1)
        by_rate = jnp.concatenate([back[j] @ by_rate, own_rate], axis=1) - bracket[j] @ by_twist
        T = se3.compose(T, moved[j])
    by_increment = jnp.concatenate([by_pose[:, 6:], by_twist, by_rate])
    by_control = _by_control_poses(by_increment, segment)
    return Kinematics(
        T, twist, rate, by_control[:6].at[:, :6].add(by_pose[:, :6]), *by_control[6:].reshape(2, 6, 24)
    )


def _by_control_poses(d: Float[Array, "n 18"], segment: Segment) -> Float[Array, "n 24"]:
    """Derivatives by the four control poses from those by the three increments between them."""
    pairs = jnp.concatenate([segment.by_previous, segment.by_next], axis=2)
    x, y, z = (d[:, 6 * j : 6 * j + 6] @ pairs[j] for j in range(3))
    return jnp.concatenate([x[:, :6], x[:, 6:] + y[:, :6], y[:, 6:] + z[:, :6], z[:, 6:]], axis=1)


def ad(x: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """The Lie bracket with a twist as a matrix: `ad(x) y = [x, y]`.

    Args:
        x: a twist.

    Returns:
        The derivative of `adjoint(exp(s x))` by s at 0 (Sola et al. 2018, table 1).
    """
    return _of_twists(se3.hat(x[3:]), se3.hat(x[:3]))


def right_jacobian(x: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """How an exponential moves on its right: `exp(x + d) = exp(x) exp(J d)` for small d.

    Of a rotation's vector it is what a transform's translation is multiplied by, transposed; a twist is that
    vector with a dual part, so that the block beside it is a derivative along the translation.

    Args:
        x: a twist.

    Returns:
        J.
    """
    unit = jnp.eye(3, dtype=x.dtype)

    def of_rotation(phi):
        return se3.exp(jnp.concatenate([unit, jnp.broadcast_to(phi, (3, 3))], axis=1))[:, :3, 3]

    return _of_twists(*jax.jvp(of_rotation, (x[3:],), (x[:3],)))


def of_logarithm(phi: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """How the logarithm of a rotation moves with it: `log(R exp(d)) = phi + J d` for small d.

    Args:
        phi: `log(R)`, less than a whole turn.

    Returns:
        J, the inverse of the rotations' right Jacobian (Sola et al. 2018, equation 144).
    """
    squared = jnp.sum(phi**2)
    small = squared < 1e-4
    half = jnp.sqrt(jnp.where(small, 1.0, squared)) / 2
    factor = jnp.where(small, 1 / 12 + squared / 720, (1 - half / jnp.tan(half)) / (4 * half**2))
    W = se3.hat(phi)
    return jnp.eye(3, dtype=phi.dtype) + W / 2 + factor * W @ W


def _inverse_right_jacobian(x: Float[Array, "6"]) -> Float[Array, "6 6"]:
    turn = of_logarithm(x[3:])
    return _of_twists(turn, -turn @ right_jacobian(x)[:3, 3:] @ turn)


def _of_twists(turn: Float[Array, "3 3"], beside: Float[Array, "3 3"]) -> Float[Array, "6 6"]:
    """What does `turn` to both halves of a twist, and adds `beside` of its rotation to its translation."""
    upper = jnp.concatenate([turn, beside], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([jnp.zeros_like(turn), turn], axis=1)])
