"""Integration of gyroscope readings."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxpose.geometry import se3
from jaxpose.imu.types import GRAVITY_WORLD, Gravity, Imu


def integrate_gyro(
    R_ref_start: Float[Array, "3 3"],
    t: Float[Array, " n"],
    omega_body: Float[Array, "n 3"],
    mask: Bool[Array, " n"] | None = None,
) -> Float[Array, "n 3 3"]:
    """Rotation `R_ref_body` at the timestamps from the body rate [rad/s], starting at the first.

    Midpoint rule.

    Where `mask` is False (padding at the end) the rotation stays what it was.
    """
    chex.assert_equal_shape_prefix([t, omega_body], 1)
    increments = (omega_body[1:] + omega_body[:-1]) / 2 * jnp.diff(t)[:, None]
    if mask is not None:
        increments = jnp.where((mask[1:] & mask[:-1])[:, None], increments, 0)

    def step(R_ref_a, R_a_b):
        R_ref_b = jnp.matmul(R_ref_a, R_a_b, precision="highest")
        return R_ref_b, R_ref_b

    _, R_ref_body = jax.lax.scan(step, R_ref_start, se3.so3_exp(increments))
    return jnp.concatenate([R_ref_start[None], R_ref_body])


def remove_gravity(
    imu: Imu, R_world_body: Float[Array, "*n 3 3"], gravity_world: Gravity = GRAVITY_WORLD
) -> Float[Array, "*n 3"]:
    """Acceleration of the body without gravity, in body axes [m/s^2]: f + R_world_body^T g_world."""
    gravity = jnp.asarray(gravity_world, R_world_body.dtype)
    gravity_body = jnp.einsum("...ji,j->...i", R_world_body, gravity, precision="highest")
    return jnp.asarray(imu.acceleration_body, R_world_body.dtype) + gravity_body


def rotate(R_a_b: Float[Array, "n 3 3"], vector_b: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    chex.assert_equal_shape_prefix([R_a_b, vector_b], 1)
    return jnp.einsum("nij,nj->ni", R_a_b, vector_b, precision="highest")
