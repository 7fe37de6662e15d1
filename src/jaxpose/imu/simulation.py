"""What an IMU, ideal or noisy, reads along a pose function or along splines through poses."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.fields.derivatives import PoseFn, motion
from jaxpose.geometry import rigid
from jaxpose.imu.types import GRAVITY_WORLD, QUIET, Gravity, Imu, ImuNoise, check_readings


def simulate(
    pose_fn: PoseFn,
    times: Float[Array, " n"],
    *,
    noise: ImuNoise = QUIET,
    key: PRNGKeyArray | None = None,
    gravity_world: Gravity = GRAVITY_WORLD,
) -> Imu:
    """Readings of an IMU along a pose function, by forward mode.

    Args:
        pose_fn: `T_world_body` (4, 4) at a time [s], body = IMU. For an IMU on a camera `lambda t:
            se3.compose(camera_pose(t), T_cam_body)`.
        times: (n,) [s].
        noise: Of the sensor; none by default.
        key: Makes the noise.
        gravity_world: (3,) [m/s^2].

    Returns:
        Readings (n,), jax arrays.

    Raises:
        ValueError: For noise without a key, and for other shapes.

    >>> imu = simulate(lambda t: jnp.eye(4), jnp.arange(3.0))
    >>> np.asarray(imu.acceleration_body, np.float64)[0].round(3).tolist()
    [0.0, 0.0, 9.807]
    """
    check_shapes(times=(times, "n"), gravity_world=(gravity_world, "3"))
    at = jax.vmap(lambda t: motion(pose_fn, t))(times)
    gravity = jnp.asarray(gravity_world, at.pose.dtype)
    force = _to_body(at.pose[:, :3, :3], at.acceleration_world - gravity[None])
    return add_noise(Imu(times, at.omega_body, force), noise, key)


def simulate_from_poses(
    times: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 4 4"],
    rate_hz: float,
    *,
    rotation: Literal["slerp", "spline"] = "slerp",
    T_cam_body: Float[np.ndarray, "4 4"] | None = None,
    noise: ImuNoise = QUIET,
    key: PRNGKeyArray | None = None,
    gravity_world: Gravity = GRAVITY_WORLD,
) -> Imu:
    """Readings of an IMU along splines through poses, from the first to the last of them.

    Args:
        times: Timestamps (n,) [s], increasing.
        poses: `T_world_body` (n, 4, 4), or `T_world_cam` with the extrinsics of an IMU mounted elsewhere;
            rows with NaN are left out and bridged.
        rate_hz: Readings a second.
        rotation: As in `interpolant`; "slerp" is Ma et al.'s.
        T_cam_body: Where the IMU is on the camera (4, 4).
        noise: Of the sensor; none by default.
        key: Makes the noise.
        gravity_world: (3,) [m/s^2].

    Returns:
        Readings, numpy float64.

    Raises:
        DataError: For fewer than two finite poses, and times that do not increase.
        ValueError: For a rate that is not positive, noise without a key, and other shapes.
    """
    check_shapes(times=(times, "n"), poses=(poses, "n 4 4"), gravity_world=(gravity_world, "3"))
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
    if T_cam_body is not None:
        check_shapes(T_cam_body=(T_cam_body, "4 4"))
        # Before the splines: the body's own path is then smooth even where slerp makes it turn at once.
        poses = poses @ T_cam_body
    path = interpolant(times, poses, rotation)
    count = int(np.floor((path.last - path.first) * rate_hz + 1e-9)) + 1
    t = np.minimum(path.first + np.arange(count) / rate_hz, path.last)
    force = _to_body(path.pose(t)[:, :3, :3], path.acceleration_world(t) - np.asarray(gravity_world))
    return add_noise(Imu(t, path.omega_body(t), force), noise, key)


class Interpolant(NamedTuple):
    """A path through poses: functions of times (n,) between `first` and `last` [s], float64."""

    first: float
    last: float
    pose: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 4 4"]]
    velocity_world: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 3"]]
    acceleration_world: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 3"]]
    omega_body: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 3"]]


def interpolant(
    times: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 4 4"],
    rotation: Literal["slerp", "spline"] = "slerp",
) -> Interpolant:
    """A path through poses: cubic splines through positions, slerp or a spline through rotations.

    Slerp's body rate is constant between two timestamps and jumps at each (Ma et al. 2024, section 4.1); the
    spline is twice differentiable. Derivatives are the splines' own.

    Args:
        times: Timestamps (n,) [s], increasing.
        poses: (n, 4, 4); rows with NaN (no ground truth) are left out and bridged.
        rotation: "slerp" or "spline".

    Returns:
        The path as functions of time.

    Raises:
        DataError: If fewer than two poses are left, or the times do not increase.
        ValueError: For another name, and for other shapes.
    """
    check_shapes(times=(times, "n"), poses=(poses, "n 4 4"))
    if rotation not in ("slerp", "spline"):
        raise ValueError(f"rotation: expected slerp or spline, got {rotation!r}")
    usable = np.isfinite(poses).all(axis=(1, 2))
    times, poses = np.asarray(times, np.float64)[usable], np.asarray(poses, np.float64)[usable]
    if len(times) < 2:
        raise DataError(f"poses to interpolate: expected at least 2 finite ones, got {len(times)}")
    if not (np.diff(times) > 0).all():
        row = int(np.argmin(np.diff(times))) + 1
        raise DataError(
            f"poses to interpolate: expected rising times, got {times[row]} after {times[row - 1]}"
        )
    position = CubicSpline(times, poses[:, :3, 3])
    orientation, omega_body = _rotation_path(times, Rotation.from_matrix(poses[:, :3, :3]), rotation)

    return Interpolant(
        first=float(times[0]),
        last=float(times[-1]),
        pose=lambda t: rigid.make(orientation(t).as_matrix(), position(t)),
        velocity_world=lambda t: position(t, 1),
        acceleration_world=lambda t: position(t, 2),
        omega_body=omega_body,
    )


def add_noise(imu: Imu, noise: ImuNoise, key: PRNGKeyArray | None) -> Imu:
    """Readings with white noise (density / sqrt(dt)) and biases that walk from zero.

    The draws are float32 in every case, so a key means the same noise in both precisions.

    Args:
        imu: Readings (n,), numpy or jax.
        noise: Of the sensor.
        key: Makes the noise.

    Returns:
        Readings of the same kind.

    Raises:
        ValueError: For noise without a key, or without two readings, whose spacing is dt; and for other
            shapes.
    """
    check_readings(imu)
    if noise == QUIET:
        return imu
    if key is None or len(imu.t) < 2:
        raise ValueError(f"expected a key and at least 2 readings for {noise}, got {key} and {len(imu.t)}")
    gyro_key, accelerometer_key = jax.random.split(key)
    return Imu(
        imu.t,
        imu.omega_body + _noise(gyro_key, imu, noise.gyro_density, noise.gyro_walk),
        imu.acceleration_body
        + _noise(accelerometer_key, imu, noise.accelerometer_density, noise.accelerometer_walk),
    )


def _noise(key: PRNGKeyArray, imu: Imu, density: float, walk: float):
    """White noise plus walking bias at the timestamps, an array of the readings' own kind and precision."""
    normal = jax.random.normal(key, (2, len(imu.t), 3), jnp.float32)
    lib = np if isinstance(imu.omega_body, np.ndarray) else jnp
    white, steps = lib.asarray(normal, imu.omega_body.dtype)
    period = lib.diff(imu.t)[:, None].astype(imu.omega_body.dtype)
    period = lib.concatenate([period[:1], period])
    return density / lib.sqrt(period) * white + lib.cumsum(walk * lib.sqrt(period) * steps, axis=0)


def _rotation_path(times: Float[np.ndarray, " n"], rotations: Rotation, kind: Literal["slerp", "spline"]):
    """Orientation and body rate [rad/s] as functions of times."""
    if kind == "spline":
        spline = RotationSpline(times, rotations)
        return spline, lambda t: spline(t, 1)
    rates = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / np.diff(times)[:, None]
    interval = lambda t: np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(rates) - 1)
    return Slerp(times, rotations), lambda t: rates[interval(t)]


def _to_body(R_world_body, vector_world):
    """R^T v for numpy and jax arrays alike; a sum of products, so never in TF32."""
    return (R_world_body * vector_world[..., None]).sum(axis=-2)
