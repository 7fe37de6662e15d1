"""Intrinsic motion: how many degrees of freedom a motion has, and the losses that make them few.

A camera's motion from frame to frame is written T = T_o . T_I, a slowly changing frame T_o and a simple
motion T_I in it (Ma et al. 2024, section 3.3); `fields.intrinsic` composes two fields so.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_STILL = 1e-4  # [m] a shorter motion has no direction
THRESHOLD = 0.01  # of a component that counts as a degree of freedom


def components(T: Float[Array, "*n 4 4"], angle_of_view: float) -> Float[Array, "*n 6"]:
    """[2 alpha / gamma, v / |v|] of motions: Euler angles against half the angle of view, and the direction.

    A rotation by 1 turns the middle of the image to its edge. A motion much shorter than a tenth of a
    millimetre has no direction.

    Args:
        T: motions (..., 4, 4) from frame to frame.
        angle_of_view: gamma [rad].

    Returns:
        Components (..., 6); alpha are the angles [rad] of R = R_x R_y R_z (Ma et al. 2024, section 3.3).

    >>> T = jnp.eye(4).at[0, 3].set(0.5)
    >>> print(components(T, 1.0).round(3) + 0.0)
    [0. 0. 0. 1. 0. 0.]
    """
    R, v = T[..., :3, :3], T[..., :3, 3]
    alpha = jnp.stack([
        jnp.arctan2(-R[..., 1, 2], R[..., 2, 2]),
        jnp.arcsin(jnp.clip(R[..., 0, 2], -1 + 1e-6, 1 - 1e-6)),
        jnp.arctan2(-R[..., 0, 1], R[..., 0, 0]),
    ], axis=-1)  # fmt: skip
    length = jnp.sqrt(jnp.sum(v**2, axis=-1, keepdims=True) + _STILL**2)
    return jnp.concatenate([alpha * (2 / angle_of_view), v / length], axis=-1)


def effective_dof(
    T: Float[Array, "*n 4 4"], angle_of_view: float, *, threshold: float = THRESHOLD
) -> Int[Array, "*n"]:
    """How many of the six `components` are larger than a threshold (Ma et al. 2024, figure 6).

    Args:
        T: motions (..., 4, 4) from frame to frame.
        angle_of_view: [rad].
        threshold: the paper does not print its own. With 0.01 a rotation counts from a two-hundredth of the
            angle of view on, 0.3 degrees of 57.

    Returns:
        Counts (...) from 0 to 6.
    """
    return jnp.sum(jnp.abs(components(T, angle_of_view)) > threshold, axis=-1)


def dof_loss(T_inner: Float[Array, "*n 4 4"], angle_of_view: float) -> Float[Array, "*n"]:
    """L_dof: the L1 norm of the `components` of a motion in the intrinsic frame (section 3.3).

    Args:
        T_inner: motions (..., 4, 4) in the intrinsic frame.
        angle_of_view: [rad].

    Returns:
        Losses (...).
    """
    return jnp.sum(jnp.abs(components(T_inner, angle_of_view)), axis=-1)


def outer_loss(T_outer: Float[Array, "*n 4 4"]) -> Float[Array, "*n"]:
    """L_o: the L1 norm of the intrinsic frame's translation, which leaves the path to T_I (section 3.3).

    Args:
        T_outer: poses (..., 4, 4) of the intrinsic frame.

    Returns:
        Losses (...) [m].
    """
    return jnp.sum(jnp.abs(T_outer[..., :3, 3]), axis=-1)
