"""Motion from gyroscope, accelerometer and poses of the same body: denoised, free of bias and of gravity.

The numpy side of `eskf`: what is checked, which pose belongs to which reading, and the result per reading.

Tested on EuRoC, whose ground truth is a smoothed fusion and no measurement: white noise of a stated size is
added to its poses, and the IMU's densities are fitted by likelihood on half of one recording
(experiments/README.md).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.imu import eskf
from jaxpose.imu.eskf import PoseNoise
from jaxpose.imu.types import GRAVITY_WORLD, Gravity, Imu, ImuNoise, check_readings


class Prior(NamedTuple):
    """One standard deviation, per axis, of what the first pose does not tell; the biases' mean is zero."""

    velocity: float = 1.0  # m/s, about the difference of the first poses
    gyro_bias: float = 0.1  # rad/s
    accelerometer_bias: float = 0.5  # m/s^2


DEFAULT_PRIOR = Prior()
_MOST_PERIODS = 10  # the trapezoidal rule knows nothing of what happens in between


class Filtered(NamedTuple):
    """The body's motion at every IMU timestamp, SI units; rows before the first pose are NaN.

    Readings are free of bias, the acceleration of gravity too. Innovations are [translation (world), rotation
    (body)] of the measured pose against the predicted one, NaN where there was no pose.
    """

    t: Float[np.ndarray, " n"]
    T_world_body: Float[np.ndarray, "n 4 4"]
    velocity_world: Float[np.ndarray, "n 3"]
    omega_body: Float[np.ndarray, "n 3"]
    acceleration_body: Float[np.ndarray, "n 3"]
    acceleration_world: Float[np.ndarray, "n 3"]
    gyro_bias: Float[np.ndarray, "n 3"]
    accelerometer_bias: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 15 15"]  # of the error
    innovation: Float[np.ndarray, "n 6"]
    innovation_covariance: Float[np.ndarray, "n 6 6"]
    nis: Float[np.ndarray, " n"]  # normalised innovation squared, chi-square of 6 dof if all is as stated
    log_likelihood: float  # of the poses after the first
    poses_used: int
    poses_skipped: int  # not finite, beyond the readings, or not the nearest to any timestamp


def filter_imu(
    imu: Imu,
    t_pose: Float[np.ndarray, " m"],
    T_world_body: Float[np.ndarray, "m 4 4"],
    noise: ImuNoise,
    pose_noise: PoseNoise,
    *,
    prior: Prior = DEFAULT_PRIOR,
    smooth: bool = False,
    gravity_world: Gravity = GRAVITY_WORLD,
) -> Filtered:
    """Fuse readings with poses of the same body: motion free of noise, bias and gravity.

    An error-state Kalman filter (Sola 2017) in JAX's default precision. A pose corrects the state at the
    reading nearest to it, which is carried to the pose's own time by its own velocity and rate: nothing is
    interpolated. A data sheet knows nothing of vibration or of the timing of poses, so on a real machine its
    densities are too small by far. State those that hold there, for example the ones of the highest
    `log_likelihood`.

    Args:
        imu: Readings (n,), at most ten periods apart.
        t_pose: Timestamps (m,) [s] of the poses, on the clock of the readings, increasing.
        T_world_body: Poses (m, 4, 4) [m]; those with NaN are left out and counted.
        noise: Of the readings.
        pose_noise: Of the poses.
        prior: Of what the first pose does not tell.
        smooth: Let later poses speak for earlier states too. The innovations stay those of the forward pass,
            and the acceleration is then the slope of the velocity.
        gravity_world: (3,) [m/s^2].

    Returns:
        The motion at every reading.

    Raises:
        DataError: For timestamps that do not increase, readings that are not finite or too far apart, and
            fewer than two poses within the readings.
        ValueError: For sigmas below 0, and for other shapes.
    """
    check_shapes(
        t_pose=(t_pose, "m"), T_world_body=(T_world_body, "m 4 4"), gravity_world=(gravity_world, "3")
    )
    _check_sigmas(noise, pose_noise, prior)
    t = _readings_checked(imu)
    time_offset, row = _nearest_poses(t, np.asarray(t_pose, np.float64), np.asarray(T_world_body, np.float64))
    used = np.flatnonzero(row >= 0)
    if len(used) < 2:
        raise DataError(
            f"poses: expected at least 2 finite ones within the readings ({t[0]:.3f} to {t[-1]:.3f} s),"
            f" got {len(used)} of {len(t_pose)}"
        )
    first, measured = used[0], row[used[0] + 1 :] >= 0
    steps = _steps(t, imu, time_offset, row, first, T_world_body)
    start = _start(t, imu, time_offset, row, used, t_pose, T_world_body)
    covariance = _covariance(pose_noise, prior)
    gravity = jnp.asarray(gravity_world, covariance.dtype)
    settings = jax.tree.map(lambda x: jnp.asarray(x, covariance.dtype), (noise, pose_noise))
    filtered = eskf.forward(start, covariance, steps, *settings, gravity)
    if smooth:
        states = eskf.backward(start, covariance, filtered)
    else:
        begin = lambda a, later: jnp.concatenate([a[None], later])
        states = jax.tree.map(begin, (start, covariance), (filtered.state, filtered.covariance))
    return _output(imu, t, first, states, filtered, measured, len(used), len(t_pose), gravity_world, smooth)


def _check_sigmas(noise: ImuNoise, pose_noise: PoseNoise, prior: Prior) -> None:
    if not all(np.isfinite(noise)) or min(noise) < 0 or min(pose_noise) <= 0 or min(prior) <= 0:
        raise ValueError(
            f"expected noise of at least 0 and sigmas above 0, got {noise}, {pose_noise}, {prior}"
        )


def _covariance(pose_noise: PoseNoise, prior: Prior) -> Float[jax.Array, "15 15"]:
    """Of the first state's error."""
    position, rotation = pose_noise
    sigmas = [position, prior.velocity, rotation, prior.gyro_bias, prior.accelerometer_bias]
    return jnp.asarray(np.diag(np.repeat(sigmas, 3).astype(np.float64) ** 2))


def _steps(t, imu: Imu, time_offset, row, first, T_world_body) -> eskf.Step:
    """What the filter takes, from the reading of the first pose on."""
    pairs = lambda values: np.stack([values[first:-1], values[first + 1 :]], axis=1)
    measured, T_measured = row[first + 1 :] >= 0, np.array(T_world_body, np.float64)[row[first + 1 :]]
    # The row of a step without a pose must be finite: what is masked out would still turn gradients into NaN.
    T_measured[~measured] = np.eye(4)
    return eskf.Step(
        dt=jnp.asarray(np.diff(t[first:])),
        omega_body=jnp.asarray(pairs(np.asarray(imu.omega_body))),
        acceleration_body=jnp.asarray(pairs(np.asarray(imu.acceleration_body))),
        T_world_body=jnp.asarray(T_measured),
        time_offset=jnp.asarray(time_offset[first + 1 :]),
        measured=jnp.asarray(measured),
    )


def _readings_checked(imu: Imu) -> Float[np.ndarray, " n"]:
    """The timestamps of readings that can be used."""
    t = np.asarray(imu.t, np.float64)
    check_readings(imu)
    _check_rising("IMU", t)
    finite = np.isfinite(np.concatenate([imu.omega_body, imu.acceleration_body], axis=1)).all(axis=1)
    if len(t) < 2 or not finite.all():
        found = f"{len(t)}" if len(t) < 2 else f"NaN or infinity in row {int(np.argmin(finite))}"
        raise DataError(f"IMU: expected at least 2 finite readings, got {found}")
    step, most = np.diff(t), _MOST_PERIODS * np.median(np.diff(t))
    if step.max() > most:
        row = int(step.argmax())
        raise DataError(
            f"IMU: expected readings at most {most:.3g} s apart ({_MOST_PERIODS} periods),"
            f" got {step[row]:.3g} s after {t[row]:.3f} s: filter the parts one by one"
        )
    return t


def _check_rising(name: str, t: Float[np.ndarray, " n"]) -> None:
    rise = np.diff(t) > 0
    if not rise.all():
        row = int(np.argmin(rise)) + 1
        raise DataError(f"{name}: expected rising timestamps, got {t[row]} after {t[row - 1]} s")


def _nearest_poses(
    t: Float[np.ndarray, " n"], t_pose: Float[np.ndarray, " m"], poses: Float[np.ndarray, "m 4 4"]
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """For each reading how much later its pose comes [s], and the pose's row, -1 where there is none."""
    _check_rising("poses", t_pose)
    near = np.searchsorted((t[1:] + t[:-1]) / 2, t_pose)
    time_offset = t_pose - t[near]
    usable = np.isfinite(poses).all(axis=(1, 2)) & (np.abs(time_offset) <= np.median(np.diff(t)))
    nearest_last = np.argsort(-np.abs(time_offset))  # of several at one reading, the last written stays
    order = nearest_last[usable[nearest_last]]
    row, wait = np.full(len(t), -1), np.zeros(len(t))
    row[near[order]], wait[near[order]] = order, time_offset[order]
    return wait, row


def _start(t, imu: Imu, time_offset, row, used, t_pose, poses) -> eskf.State:
    """The first pose, with the mean velocity to the pose a tenth of a second on, carried to the reading."""
    first = used[0]
    ahead = used[min(max(1, np.searchsorted(t[used], t[first] + 0.1)), len(used) - 1)]
    a, b = row[first], row[ahead]
    velocity = (poses[b, :3, 3] - poses[a, :3, 3]) / (t_pose[b] - t_pose[a])
    T = np.array(poses[a], np.float64)
    T[:3, 3] -= velocity * time_offset[first]
    T[:3, :3] = T[:3, :3] @ rigid.so3_exp(-np.asarray(imu.omega_body)[first] * time_offset[first])
    return eskf.State(*map(jnp.asarray, (T, velocity, np.zeros(3), np.zeros(3))))


def _output(imu, t, first, states, filtered, measured, used, given, gravity_world, smooth) -> Filtered:
    """Everything as numpy, one row per reading."""
    (state, covariance), filtered, measured = jax.tree.map(np.asarray, (states, filtered, measured))

    def rows(values, valid=None):
        full = np.full((len(t), *values.shape[1:]), np.nan, values.dtype)
        full[len(t) - len(values) :] = values
        if valid is not None:
            full[len(t) - len(values) :][~valid] = np.nan
        return full

    R = state.T_world_body[:, :3, :3]
    force = np.asarray(imu.acceleration_body)[first:] - state.accelerometer_bias
    acceleration = np.einsum("nij,nj->ni", R, force) + np.asarray(gravity_world)
    if smooth:  # what the poses say of the noise of the readings is in the velocity already
        acceleration = np.gradient(state.velocity_world, t[first:], axis=0)
    S, nis = filtered.innovation_covariance[measured], filtered.nis[measured]
    log_likelihood = -(nis + np.linalg.slogdet(2 * np.pi * S)[1]).sum() / 2
    return Filtered(
        t=t,
        T_world_body=rows(state.T_world_body),
        velocity_world=rows(state.velocity_world),
        omega_body=rows(np.asarray(imu.omega_body)[first:] - state.gyro_bias),
        acceleration_body=rows(np.einsum("nji,nj->ni", R, acceleration)),
        acceleration_world=rows(acceleration),
        gyro_bias=rows(state.gyro_bias),
        accelerometer_bias=rows(state.accelerometer_bias),
        covariance=rows(covariance),
        innovation=rows(filtered.innovation, measured),
        innovation_covariance=rows(filtered.innovation_covariance, measured),
        nis=rows(filtered.nis, measured),
        log_likelihood=float(log_likelihood),
        poses_used=used,
        poses_skipped=given - used,
    )
