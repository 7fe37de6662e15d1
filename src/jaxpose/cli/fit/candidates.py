"""Pose fields fitted to stamped poses, and what is left: at poses held out, and against inertial readings."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.ndimage import median_filter

from jaxpose import fields
from jaxpose.cli.fit.types import FEWEST, Fitted, Inertial, Sensor
from jaxpose.datasets.rgbd import euroc
from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.fields import Params, PoseField, PoseNetConfig
from jaxpose.fields.derivatives import motion
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry import rigid
from jaxpose.imu import Imu, ImuNoise, residual_sigmas

_SHARE = 0.95  # of the power of the speeds, below what is called the motion's bandwidth
_NOISY = 0.8  # share of the highest frequency from where on poses are taken to hold nothing but noise
_BIAS_WEIGHT = 1e-3  # of a square m/s^2 of bias beside one of a reading


class Candidate(NamedTuple):
    """A field to try on a span of time, as a constructor."""

    name: str
    highest_hz: float  # the fastest motion that it carries
    make: Callable[[tuple[float, float]], PoseField]
    key: PRNGKeyArray | None  # draws the start


class Frame(NamedTuple):
    """Where fields live: lengths in half the trajectory's extent from its middle, times from the first."""

    t0: float  # [s]
    middle: Float[np.ndarray, "3"]  # [m]
    scale: float  # [m]


def posenet(span_s: float, octaves: int, layers: int, width: int, seed: int) -> Candidate:
    """A smooth PoseNet; the fastest band of its encoding turns 2^(octaves - 1) times in the whole span."""
    config = lambda span: PoseNetConfig(
        span=span,
        octaves=octaves,
        layers=layers,
        width=width,
        activation="softplus",
        gain=2.0,
        head="free",
    )
    return Candidate(
        f"PoseNet F={octaves} {layers}x{width}",
        2.0 ** (octaves - 1) / span_s if octaves else 0.5 / span_s,
        lambda span: fields.posenet(config(span)),
        jax.random.key(seed),
    )


def bspline(span_s: float, knots_hz: float) -> Candidate:
    """A cubic B-spline with so many knots a second, half of which is the fastest that it can follow."""
    intervals = max(1, round(span_s * knots_hz))

    return Candidate(
        f"B-spline {knots_hz:g} knots/s",
        knots_hz / 2,
        lambda span: fields.bspline(span, intervals),
        None,
    )


def frame(trajectory: Trajectory) -> Frame:
    """The frame that makes the trajectory's numbers small and of order one."""
    position = trajectory.T[:, :3, 3]
    low, high = position.min(0), position.max(0)
    half = float((high - low).max()) / 2
    return Frame(float(trajectory.t[0]), (low + high) / 2, half if half > 0 else 1.0)


def fit_field(
    candidate: Candidate,
    trajectory: Trajectory,
    held: Bool[np.ndarray, " n"],
    around: Frame,
    imu: Imu | None,
    steps: int,
) -> tuple[Fitted, PoseField, Params]:
    """Fit to the poses that are not `held`, and measure on those that are, and on all of the IMU's readings.

    The field comes back on the trajectory's clock, in the units of `around`. The trajectory's body is the
    IMU; `imu.t` is on the trajectory's clock, within its span.
    """
    started = time.perf_counter()
    local = _into(around, trajectory)
    seen = Trajectory(local.t[~held], local.T[~held])
    field = candidate.make((0.0, float(local.t[-1])))
    result = fields.fit(field, seen.t, seen.T, key=candidate.key, steps=steps)
    params = jax.block_until_ready(result.params)
    seconds = time.perf_counter() - started
    poses = jax.jit(jax.vmap(field.pose, (None, 0)))  # parameters as constants would be worked on for seconds
    T = np.asarray(poses(params, jnp.asarray(local.t[held], jnp.float32)), np.float64)
    distance = around.scale * np.linalg.norm(T[:, :3, 3] - local.T[held, :3, 3], axis=1)
    angle = np.degrees(rigid.rotation_angle(T[:, :3, :3], local.T[held, :3, :3]))
    fitted = Fitted(
        candidate.name,
        candidate.highest_hz,
        sum(leaf.size for leaf in jax.tree.leaves(params)),
        seconds,
        trajectory_error.statistics(distance),
        trajectory_error.statistics(angle),
        None if imu is None else _inertial(field, params, around, imu),
    )
    return fitted, fields.shifted(field, around.t0 + trajectory.t0_ns / 10**9), params


def readings(folder: Path, trajectory: Trajectory) -> tuple[Imu, Sensor, tuple[str, ...]]:
    """The readings within the trajectory's span, on its clock."""
    log = euroc.load_imu(folder, trajectory.t0_ns)
    t = np.asarray(log.imu.t, np.float64)
    first, last = trajectory.t[[0, -1]]
    within = (t >= first) & (t <= last)
    if within.sum() < FEWEST:
        t0 = trajectory.t0_ns / 10**9
        raise DataError(
            f"{folder}: expected an IMU on the clock of the poses, {t0 + first:.3f} to {t0 + last:.3f} s, "
            f"got {t0 + t[0]:.3f} to {t0 + t[-1]:.3f} s"
        )
    omega, force = (np.asarray(x)[within] for x in (log.imu.omega_body, log.imu.acceleration_body))
    rate_hz = 1 / float(np.median(np.diff(np.asarray(log.imu.t))))
    measured = (sample_noise(omega), sample_noise(force))
    sensor = Sensor(int(within.sum()), rate_hz, noise_floor(log.noise, rate_hz), measured)
    notes = log.notes
    if not within.all():
        notes += (f"{int((~within).sum())} of {len(t)} inertial readings lie outside of the poses: not used",)
    return Imu(t[within], omega, force), sensor, notes


def bandwidth_hz(trajectory: Trajectory) -> float:
    """The frequency [Hz] below which 95% of the power of velocity and body rate lies, the higher of the two.

    From differences of neighbouring poses, freed of single jumps by a median of five. White noise of the
    poses, which differences raise towards high frequencies, is estimated from the highest fifth of them and
    taken away; what noise of other colours the poses have still counts as motion.
    """
    t = trajectory.t
    step = float(np.median(np.diff(t)))
    turn = rigid.so3_log((rigid.inverse(trajectory.T[:-1]) @ trajectory.T[1:])[:, :3, :3])
    speeds = np.concatenate([np.diff(trajectory.T[:, :3, 3], axis=0), turn], axis=1) / np.diff(t)[:, None]
    speeds = median_filter(speeds, (5, 1))
    middle = (t[1:] + t[:-1]) / 2
    grid = np.arange(middle[0], middle[-1], step)
    even = np.stack([np.interp(grid, middle, column) for column in speeds.T], axis=1)
    spectrum = np.abs(np.fft.rfft(even * np.hanning(len(even))[:, None], axis=0)) ** 2
    hz = np.fft.rfftfreq(len(even), step)
    noise = 1 - np.cos(2 * np.pi * hz * step)  # of the difference of two independent errors
    high = hz >= _NOISY * hz[-1]
    highest = 0.0
    for power in (spectrum[:, :3].sum(1), spectrum[:, 3:].sum(1)):
        below = np.cumsum(power - noise * (power[high].sum() / noise[high].sum()))
        if below[-1] > 0:
            highest = max(highest, float(hz[np.argmax(below >= _SHARE * below[-1])]))
    return highest


def sample_noise(readings: Float[np.ndarray, "n 3"]) -> float:
    """White noise that would make neighbouring readings differ as they do: RMS second difference / sqrt 6."""
    return float(np.sqrt(np.mean(np.diff(readings, 2, axis=0) ** 2) / 6))


def noise_floor(noise: ImuNoise, rate_hz: float) -> tuple[float, float]:
    """One sigma of a reading by the data sheet: rad/s and m/s^2."""
    stated = residual_sigmas(noise, rate_hz, duration=0.0)
    return stated.tight, stated.accelerometer


def _into(around: Frame, trajectory: Trajectory) -> Trajectory:
    T = trajectory.T.copy()
    T[:, :3, 3] = (T[:, :3, 3] - around.middle) / around.scale
    return Trajectory(trajectory.t - around.t0, T)


def _inertial(field: PoseField, params: Any, around: Frame, imu: Imu) -> Inertial:
    at = jax.jit(jax.vmap(lambda params, t: motion(partial(field.pose, params), t), (None, 0)))
    moved = at(params, jnp.asarray(np.asarray(imu.t) - around.t0, jnp.float32))
    R = np.asarray(moved.pose[:, :3, :3], np.float64)
    omega = np.asarray(moved.omega_body, np.float64) - np.asarray(imu.omega_body)
    free = around.scale * np.einsum("nji,nj->ni", R, np.asarray(moved.acceleration_world, np.float64))
    # reading = R^T (a - g) + bias: linear in gravity and bias. A turn about one axis does not tell them
    # apart along it; the bias is then taken to be the smaller one.
    count = len(omega)
    design = np.concatenate([-np.swapaxes(R, 1, 2), np.tile(np.eye(3), (count, 1, 1))], axis=2).reshape(-1, 6)
    wanted = (np.asarray(imu.acceleration_body) - free).reshape(-1)
    small_bias = np.sqrt(count) * _BIAS_WEIGHT * np.eye(3, 6, k=3)
    solution = np.linalg.lstsq(
        np.concatenate([design, small_bias]), np.concatenate([wanted, np.zeros(3)]), rcond=None
    )[0]
    left = wanted - design @ solution
    bias = -omega.mean(0)
    return Inertial(
        float(np.sqrt(np.mean((omega + bias) ** 2))),
        float(np.sqrt(np.mean(left**2))),
        bias,
        solution[:3],
        count,
    )
