"""Integration of gyroscope readings, and accelerations without gravity."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxpose._checks import check_shapes
from jaxpose.geometry import se3
from jaxpose.imu.types import GRAVITY_WORLD, Gravity, Imu


@jax.jit
def integrate_gyro(
    R_ref_start: Float[Array, "3 3"],
    t: Float[Array, " n"],
    omega_body: Float[Array, "n 3"],
    mask: Bool[Array, " n"] | None = None,
) -> Float[Array, "n 3 3"]:
    """The rotation that a gyroscope's readings add up to, by the midpoint rule.

    Args:
        R_ref_start: (3, 3), where the body is at the first timestamp.
        t: Timestamps (n,) [s].
        omega_body: Body rates (n, 3) [rad/s].
        mask: (n,), False for padding at the end, where the rotation stays what it was.

    Returns:
        `R_ref_body` (n, 3, 3) at the timestamps.

    Raises:
        ValueError: For other shapes.

    >>> t, omega = jnp.linspace(0.0, 1.0, 11), jnp.tile(jnp.array([0.0, 0.0, jnp.pi / 2]), (11, 1))
    >>> integrate_gyro(jnp.eye(3), t, omega)[-1, :, 0].round(5).tolist()
    [-0.0, 1.0, 0.0]
    """
    check_shapes(R_ref_start=(R_ref_start, "3 3"), t=(t, "n"), omega_body=(omega_body, "n 3"))
    if mask is not None:
        check_shapes(t=(t, "n"), mask=(mask, "n"))
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
    """The body's own acceleration: the reading, and gravity turned into the body's axes.

    Args:
        imu: Readings, of which `acceleration_body` (..., 3) is used.
        R_world_body: (..., 3, 3) at the readings.
        gravity_world: (3,) [m/s^2].

    Returns:
        f + R_world_body^T g_world (..., 3) [m/s^2], in body axes.

    Raises:
        ValueError: For other shapes.

    >>> at_rest = Imu(jnp.zeros(1), jnp.zeros((1, 3)), jnp.array([[0.0, 0.0, 9.80665]]))
    >>> remove_gravity(at_rest, jnp.eye(3)[None]).tolist()
    [[0.0, 0.0, 0.0]]
    """
    check_shapes(
        R_world_body=(R_world_body, "*n 3 3"),
        acceleration_body=(imu.acceleration_body, "*n 3"),
        gravity_world=(gravity_world, "3"),
    )
    gravity = jnp.asarray(gravity_world, R_world_body.dtype)
    gravity_body = jnp.einsum("...ji,j->...i", R_world_body, gravity, precision="highest")
    return jnp.asarray(imu.acceleration_body, R_world_body.dtype) + gravity_body


def rotate(R_a_b: Float[Array, "n 3 3"], vector_b: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Vectors (n, 3) in frame a by rotations (n, 3, 3), one for each.

    Args:
        R_a_b: (n, 3, 3).
        vector_b: (n, 3).

    Returns:
        (n, 3).
    """
    chex.assert_equal_shape_prefix([R_a_b, vector_b], 1)
    return jnp.einsum("nij,nj->ni", R_a_b, vector_b, precision="highest")
