"""Inertial sensors: integration of the gyroscope, and residuals on the derivatives of a pose function.

Pose functions `t -> T_ref_body` are of the body, which is the IMU, in a frame that does not move: the
world, or the body's own frame at the last image. For a field of camera poses compose `T_cam_body` on the
right. Ma et al. 2024, section 3.4.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxpose._checks import check_increasing, check_shapes
from jaxpose.errors import DataError
from jaxpose.fields.derivatives import PoseFn, motion, velocity
from jaxpose.geometry import se3
from jaxpose.imu.preintegration import rotate
from jaxpose.imu.types import Imu, ImuNoise, check_readings


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

    Ma et al.'s lambda of 1 is a weight of sigma here for the accelerometer and of sigma / 2 for its
    quaternion residuals.

    Args:
        noise: The sensor's data sheet.
        rate_hz: Readings a second.
        duration: How long [s] the gyroscope was integrated: its error walks, so `loose` holds at the end of
            that time, and neighbouring samples share nearly all of it.

    Returns:
        One standard deviation of each residual; zero for a silent sensor.

    Raises:
        ValueError: For a rate that is not positive, or a duration below 0.

    >>> residual_sigmas(ImuNoise(1e-4, 2e-3, 0.0, 0.0), rate_hz=100.0, duration=1.0).tight
    0.001
    """
    if not (0 < rate_hz < np.inf and 0 <= duration < np.inf):
        raise ValueError(f"expected rate_hz above 0 and duration of 0 or more, got {rate_hz} and {duration}")
    per_sample = np.sqrt(rate_hz)
    return ResidualSigmas(
        loose=float(noise.gyro_density * np.sqrt(max(duration, 1 / rate_hz))),
        tight=float(noise.gyro_density * per_sample),
        accelerometer=float(noise.accelerometer_density * per_sample),
    )


# Why rotation vectors. Ma et al. 2024 take the L1 norm between quaternions, and between dq/dt and
# q * (0, omega) / 2. The first is, to first order, half the rotation vector from one to the other; the second
# is exactly half the difference of the body rates; both turned by q. Without the turn and the half they are
# the same loss along the sensor's own three axes, in radians, and signless: q and -q are one rotation matrix.


def gyro_loose_residual(
    pose_fn: PoseFn, times: Float[Array, " n"], R_ref_body: Float[Array, "n 3 3"]
) -> Float[Array, "n 3"]:
    """Rotation vectors from the integrated gyroscope to the field (Ma et al. 2024, gyroscope, loose).

    Args:
        pose_fn: The body's pose `T_ref_body` (4, 4) at a time [s], in a frame that does not move.
        times: (n,) [s].
        R_ref_body: (n, 3, 3), `integrate_gyro`'s, started in the frame that `pose_fn` refers to.

    Returns:
        (n, 3) [rad].

    Raises:
        ValueError: For other shapes.
    """
    check_shapes(times=(times, "n"), R_ref_body=(R_ref_body, "n 3 3"))
    return _rotation_error(R_ref_body, jax.vmap(pose_fn)(times))


def gyro_tight_residual(
    pose_fn: PoseFn, times: Float[Array, " n"], omega_body: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """Body rate of the field less the gyroscope's (Ma et al. 2024, gyroscope, tight).

    Args:
        pose_fn: The body's pose `T_ref_body` (4, 4) at a time [s], in a frame that does not move.
        times: (n,) [s].
        omega_body: Body rates (n, 3) [rad/s] as read.

    Returns:
        (n, 3) [rad/s].

    Raises:
        ValueError: For other shapes.
    """
    check_shapes(times=(times, "n"), omega_body=(omega_body, "n 3"))
    _, _, omega_field = jax.vmap(lambda t: velocity(pose_fn, t))(times)
    return omega_field - omega_body


def accelerometer_residual(
    pose_fn: PoseFn,
    times: Float[Array, " n"],
    acceleration_body: Float[Array, "n 3"],
    R_ref_body: Float[Array, "n 3 3"],
) -> Float[Array, "n 3"]:
    """Second derivative of the field's translation less the reading (Ma et al. 2024, eq. 8).

    Args:
        pose_fn: The body's pose `T_ref_body` (4, 4) at a time [s], in a frame that does not move.
        times: (n,) [s].
        acceleration_body: Readings without gravity (n, 3) [m/s^2], of `remove_gravity`.
        R_ref_body: (n, 3, 3), `integrate_gyro`'s, started in the frame that `pose_fn` refers to, which turns
            the readings into it.

    Returns:
        (n, 3) [m/s^2], in the frame that `pose_fn` refers to.

    Raises:
        ValueError: For other shapes.
    """
    check_shapes(
        times=(times, "n"), acceleration_body=(acceleration_body, "n 3"), R_ref_body=(R_ref_body, "n 3 3")
    )
    acceleration = jax.vmap(lambda t: motion(pose_fn, t).acceleration_world)(times)
    return acceleration - rotate(R_ref_body, acceleration_body)


def imu_residuals(
    pose_fn: PoseFn,
    times: Float[Array, " n"],
    omega_body: Float[Array, "n 3"],
    acceleration_body: Float[Array, "n 3"],
    R_ref_body: Float[Array, "n 3 3"],
) -> ImuResiduals:
    """All three residuals from one pass through the field.

    Args:
        pose_fn: The body's pose `T_ref_body` (4, 4) at a time [s], in a frame that does not move.
        times: (n,) [s].
        omega_body: Body rates (n, 3) [rad/s] as read.
        acceleration_body: Readings without gravity (n, 3) [m/s^2], of `remove_gravity`.
        R_ref_body: (n, 3, 3), `integrate_gyro`'s, started in the frame that `pose_fn` refers to.

    Returns:
        What `gyro_loose_residual`, `gyro_tight_residual` and `accelerometer_residual` return.

    Raises:
        ValueError: For other shapes.
    """
    check_shapes(
        times=(times, "n"),
        omega_body=(omega_body, "n 3"),
        acceleration_body=(acceleration_body, "n 3"),
        R_ref_body=(R_ref_body, "n 3 3"),
    )
    field = jax.vmap(lambda t: motion(pose_fn, t))(times)
    return ImuResiduals(
        loose=_rotation_error(R_ref_body, field.pose),
        tight=field.omega_body - omega_body,
        accelerometer=field.acceleration_world - rotate(R_ref_body, acceleration_body),
    )


def covers(imu: Imu, start: float, end: float) -> bool:
    """Whether readings reach from one time to another, to within one and a half samples.

    Args:
        imu: Readings (n,).
        start: [s] on their clock.
        end: [s].

    Returns:
        False without readings.
    """
    t = np.asarray(imu.t)
    slack = np.median(np.diff(t)) * 1.5 if len(t) > 1 else 0.0
    return bool(len(t) and start >= t[0] - slack and end <= t[-1] + slack)


def windows(imu: Imu, frame_times: Float[np.ndarray, " m"]) -> tuple[Imu, Bool[np.ndarray, "m-1 s"]]:
    """Cut readings into the intervals between frames, padded to one size `s`.

    Each interval starts and ends at its frames, readings interpolated there; padding repeats the end.

    Args:
        imu: Readings (n,), numpy.
        frame_times: (m,) [s] on their clock, increasing.

    Returns:
        Readings (m - 1, s), and a mask (m - 1, s) that is False for padding and for intervals that the IMU
        does not cover.

    Raises:
        DataError: If the IMU covers no interval, and for fewer than two readings or frames.
        ValueError: For times that do not increase, and for other shapes.

    >>> imu = Imu(np.arange(5.0), np.zeros((5, 3)), np.zeros((5, 3)))
    >>> windows(imu, np.array([0.5, 2.5]))[0].t.tolist()
    [[0.5, 1.0, 2.0, 2.5]]
    """
    check_readings(imu)
    check_shapes(frame_times=(frame_times, "m"))
    check_increasing(**{"imu.t": np.asarray(imu.t), "frame_times": frame_times})
    if len(imu.t) < 2 or len(frame_times) < 2:
        raise DataError(
            f"IMU: expected at least 2 readings and 2 frames, got {len(imu.t)} and {len(frame_times)}"
        )
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
