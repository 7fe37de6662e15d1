"""Inertial sensors: integration of the gyroscope, and residuals on the derivatives of a pose function.

Pose functions `t -> T_ref_body` are of the body, which is the IMU, in a frame that does not move: the
world, or the body's own frame at the last image. For a field of camera poses compose `T_cam_body` on the
right. Simulation is in `imu_simulation.py`.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxpose.errors import DataError
from jaxpose.fields.derivatives import PoseFn, motion, velocity
from jaxpose.geometry import se3
from jaxpose.imu.preintegration import rotate
from jaxpose.imu.types import Imu, ImuNoise


class ImuResiduals(NamedTuple):
    """The three residuals at the same times, axis by axis, SI units."""

    loose: Float[Array, "n 3"]  # rad
    tight: Float[Array, "n 3"]  # rad/s
    accelerometer: Float[Array, "n 3"]  # m/s^2


class ResidualSigmas(NamedTuple):
    """One standard deviation of each residual that the sensor's white noise explains, per axis."""

    loose: float  # rad
    tight: float  # rad/s
    accelerometer: float  # m/s^2


def residual_sigmas(noise: ImuNoise, rate_hz: float, duration: float) -> ResidualSigmas:
    """What to divide the residuals by so that a weight of 1 means one sigma of the sensor.

    `duration` [s] is how long the gyroscope was integrated: its error walks, so `loose` holds at the end of
    that time, and neighbouring samples share nearly all of it. METHOD's lambda of 1 is a weight of sigma here
    for the accelerometer and of sigma / 2 for its quaternion residuals. Zero for a silent sensor.
    """
    per_sample = np.sqrt(rate_hz)
    return ResidualSigmas(
        loose=float(noise.gyro_density * np.sqrt(max(duration, 1 / rate_hz))),
        tight=float(noise.gyro_density * per_sample),
        accelerometer=float(noise.accelerometer_density * per_sample),
    )


# Why rotation vectors. METHOD takes the L1 norm between quaternions, and between dq/dt and
# q * (0, omega) / 2. The first is, to first order, half the rotation vector from one to the other; the second
# is exactly half the difference of the body rates; both turned by q. Without the turn and the half they are
# the same loss along the sensor's own three axes, in radians, and signless: q and -q are one rotation matrix.


def gyro_loose_residual(
    pose_fn: PoseFn, times: Float[Array, " n"], R_ref_body: Float[Array, "n 3 3"]
) -> Float[Array, "n 3"]:
    """Rotation vector [rad] from the integrated gyroscope to the field (METHOD section 5, gyro, loose).

    `R_ref_body` is `integrate_gyro`'s, started in the frame that `pose_fn` refers to.
    """
    return _rotation_error(R_ref_body, jax.vmap(pose_fn)(times))


def gyro_tight_residual(
    pose_fn: PoseFn, times: Float[Array, " n"], omega_body: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """Body rate of the field minus the gyroscope's [rad/s] (METHOD section 5, gyro, tight)."""
    chex.assert_equal_shape_prefix([times, omega_body], 1)
    _, _, omega_field = jax.vmap(lambda t: velocity(pose_fn, t))(times)
    return omega_field - omega_body


def accelerometer_residual(
    pose_fn: PoseFn,
    times: Float[Array, " n"],
    acceleration_body: Float[Array, "n 3"],
    R_ref_body: Float[Array, "n 3 3"],
) -> Float[Array, "n 3"]:
    """Second derivative of the field's translation minus the gravity-free reading [m/s^2] (METHOD eq. 8).

    In the frame that `pose_fn` refers to; `R_ref_body` (`integrate_gyro`) turns the reading into it.
    """
    acceleration = jax.vmap(lambda t: motion(pose_fn, t).acceleration_world)(times)
    return acceleration - rotate(R_ref_body, acceleration_body)


def imu_residuals(
    pose_fn: PoseFn,
    times: Float[Array, " n"],
    omega_body: Float[Array, "n 3"],
    acceleration_body: Float[Array, "n 3"],
    R_ref_body: Float[Array, "n 3 3"],
) -> ImuResiduals:
    """All three residuals from one pass through the field; arguments as the single ones have them."""
    chex.assert_equal_shape_prefix([times, omega_body, acceleration_body, R_ref_body], 1)
    field = jax.vmap(lambda t: motion(pose_fn, t))(times)
    return ImuResiduals(
        loose=_rotation_error(R_ref_body, field.pose),
        tight=field.omega_body - omega_body,
        accelerometer=field.acceleration_world - rotate(R_ref_body, acceleration_body),
    )


def covers(imu: Imu, start: float, end: float) -> bool:
    """Whether readings reach from `start` to `end` [s], to within one and a half samples."""
    t = np.asarray(imu.t)
    slack = np.median(np.diff(t)) * 1.5 if len(t) > 1 else 0.0
    return bool(len(t) and start >= t[0] - slack and end <= t[-1] + slack)


def windows(imu: Imu, frame_times: Float[np.ndarray, " m"]) -> tuple[Imu, Bool[np.ndarray, "m-1 s"]]:
    """Cut readings (numpy) into the intervals between frames, padded to one size `s`, with a mask.

    Each interval starts and ends at its frames, readings interpolated there; padding repeats the end.
    An interval that the IMU does not cover is masked out. DataError if it covers none.
    """
    t = np.asarray(imu.t)
    slack = np.median(np.diff(t)) * 1.5  # one sample short of a frame is no gap
    first, last = frame_times[:-1], frame_times[1:]
    covered = (first >= t[0] - slack) & (last <= t[-1] + slack)
    if not covered.any():
        raise DataError(
            f"IMU: expected readings between {frame_times[0]:.3f} and {frame_times[-1]:.3f} s (the frames), "
            f"got them between {t[0]:.3f} and {t[-1]:.3f} s"
        )
    begin, end = np.searchsorted(t, first, side="right"), np.searchsorted(t, last, side="left")
    size = (end - begin)[covered].max() + 2
    index = begin[:, None] + np.arange(size) - 1  # -1: the first place is the frame's
    inside = t[np.clip(index, 0, len(t) - 1)]
    at = np.where(np.arange(size) == 0, first[:, None], np.where(index < end[:, None], inside, last[:, None]))
    mask = covered[:, None] & (index <= end[:, None])
    readings = [
        np.stack([np.interp(at, t, channel) for channel in np.asarray(values).T], axis=-1)
        for values in (imu.omega_body, imu.acceleration_body)
    ]
    return Imu(at, *readings), mask


def _rotation_error(R_ref_a: Float[Array, "n 3 3"], T_ref_b: Float[Array, "n 4 4"]) -> Float[Array, "n 3"]:
    chex.assert_equal_shape_prefix([R_ref_a, T_ref_b], 1)
    return se3.so3_log(jnp.einsum("nji,njk->nik", R_ref_a, T_ref_b[:, :3, :3], precision="highest"))
