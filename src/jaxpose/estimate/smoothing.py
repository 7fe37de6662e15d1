"""Batch smoothing: one spline through poses and inertial readings, with its sensors and its covariance."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxpose._checks import check_increasing, check_shapes
from jaxpose._memory import give_back_memory
from jaxpose.errors import DataError
from jaxpose.estimate import alignment, inertial, solver
from jaxpose.estimate.factors import Factor
from jaxpose.estimate.factors import checked as checked_factors
from jaxpose.estimate.noise_levels import calibrated, first_levels
from jaxpose.estimate.posterior import Posterior, posterior_calls, posterior_of
from jaxpose.estimate.system import Noise, Prior, Problem, State
from jaxpose.fields._bspline import control_poses_along
from jaxpose.fields._fit_input import checked_poses
from jaxpose.geometry import rigid
from jaxpose.imu import GRAVITY_WORLD, Imu, ImuNoise
from jaxpose.imu.types import check_readings

Quantity = Literal["biases", "gravity", "offset", "extrinsics", "scale"]
QUANTITIES = get_args(Quantity)
SENSORS = ("gyroscope", "accelerometer")

_KNOTS_HZ = 20.0  # beside an IMU: hands and drones move up to 10 Hz
_MARGIN_S = 0.2  # of the spline beyond the poses, where their time offset is estimated
_REACH_S = 0.5  # of the offsets that are tried
# What is known before, one sigma each: what no sensor that works is beyond
_GYRO_BIAS, _ACCELEROMETER_BIAS = 0.3, 1.0  # rad/s, m/s^2
_OFFSET_S, _LEVER_M, _TURN, _LOG_SCALE = 1.0, 1.0, 3.0, 10.0
_NO_DRIFT = 1e-9  # [m, rad] over a block
_WALK = ImuNoise(0.0, 0.0, 2e-5, 3e-3)  # of biases, where no data sheet says more: EuRoC's sensor


def smooth(
    times: ArrayLike,
    T_world_cam: ArrayLike,
    sigmas: ArrayLike,
    imu: Imu | None = None,
    *,
    use: Sequence[str] = ("gyroscope", "accelerometer"),
    estimate: Sequence[str] = ("biases", "gravity"),
    noise: ImuNoise | None = None,
    fit_noise: bool = True,
    T_body_cam: Float[np.ndarray, "4 4"] | None = None,
    gravity_world: Float[np.ndarray, "3"] | None = None,
    offset_s: float = 0.0,
    knots_hz: float | None = None,
    drift: ArrayLike | None = None,
    drift_s: float = np.inf,
    factors: Sequence[Factor] = (),
) -> Posterior:
    """The most likely trajectory through camera poses and inertial readings, and how sure it is.

    Args:
        times: timestamps of the poses (n,) [s], increasing.
        T_world_cam: camera poses (n, 4, 4), in metres, or in any unit if the scale is estimated.
        sigmas: one sigma of each pose, (6,) or (n, 6): position [their unit] and rotation [rad], along and
            about the camera's own axes; or covariances (n, 6, 6).
        imu: readings; None: poses alone, which are then as restless as they look, and none of `estimate`.
        use: which of the sensors' readings count.
        estimate: any of "biases", "gravity" (its direction), "offset" (t_imu = t_cam + offset), "extrinsics"
            (T_body_cam), "scale" (metres per unit).
        noise: data sheet of the IMU. Its densities are taken for optimistic, its walks are the biases'.
        fit_noise: estimate noise levels too, of the readings in bands from slow to fast, and a factor for all
            positions and one for all rotations. False: `noise` and `sigmas` are taken as they are.
        T_body_cam: mounting (4, 4), or where its estimate starts; None: the IMU is where the camera is, or,
            if "extrinsics" is estimated, unknown.
        gravity_world: [m/s^2], or where its estimate starts; None: unknown if "gravity" is estimated.
        offset_s: time offset, or where its estimate starts.
        knots_hz: knots a second; None: 20 beside an IMU (fewer beside a slow one), else one a pose.
        drift: covariances (n, 6, 6) of what each pose but the first adds to an error that all later ones
            share, over its right increment: as cameras are registered to a map that earlier ones made. None:
            errors are independent.
        drift_s: time [s] in which that shared error falls to 1/e, as what was mapped first is seen again.
        factors: what else was measured within the time of the poses, in their world and on their clock.

    Returns:
        The posterior.

    Raises:
        ValueError: shapes, sigmas or names that cannot be.
        DataError: readings that do not overlap with the poses, or say nothing of what is asked.

    >>> t, T = np.linspace(0.0, 2.0, 21), np.tile(np.eye(4), (21, 1, 1))
    >>> smooth(t, T, [0.01] * 3 + [0.002] * 3).covariance([1.0, 1.05]).shape
    (2, 6, 6)
    """
    if not drift_s > 0:
        raise ValueError(f"drift_s: expected seconds above 0, got {drift_s}")
    measured = _measured(times, T_world_cam, sigmas, drift, imu, use, estimate, noise, offset_s, factors)
    guess = _guess(measured, T_body_cam, gravity_world, offset_s)
    return _solved(measured, guess, fit_noise, knots_hz, drift_s)


def compile_ahead(
    times: ArrayLike, imu: Imu, estimate: Sequence[str], stopped: Callable[[], bool] = lambda: False
) -> None:
    """Compile what `smooth` and its posterior run, for about as many poses over the same time.

    For another thread, while the poses are being measured.

    Args:
        times: timestamps [s] at which poses will be measured; the first and last one count, and how many.
        imu: readings.
        estimate: as `smooth` has it.
        stopped: asked before each function whether it is still wanted.

    Raises:
        ValueError, DataError: as `smooth`.
    """
    T = np.tile(np.eye(4), (np.size(times), 1, 1))
    measured = _measured(times, T, np.ones(6), None, imu, SENSORS, estimate, None, 0.0, ())
    guess = _Guess(np.eye(4), np.array(GRAVITY_WORLD), 0.0, 1.0)
    with jax.enable_x64(True):
        problem, level, *_ = _posed(measured, guess, True, None, np.inf)
        span = float(measured.t[0]), float(measured.t[-1])
        calls = [*solver.compiled_calls(problem, level), *posterior_calls(problem, level, span)]
        for function, *args in calls:
            if stopped():
                return
            function.lower(*args).compile()
            give_back_memory()


class _Measured(NamedTuple):
    """What was measured, checked, and what is asked."""

    t: Float[np.ndarray, " n"]
    T: Float[np.ndarray, "n 4 4"]
    root_information: Float[np.ndarray, "n 6 6"]
    drift: Float[np.ndarray, "n 6 6"] | None
    imu: Imu | None
    used: Float[np.ndarray, "2"]
    noise: ImuNoise | None
    estimate: tuple[str, ...]
    factors: tuple[Factor, ...]


class _Guess(NamedTuple):
    """Where the sensors' estimate starts."""

    T_body_cam: Float[np.ndarray, "4 4"]
    gravity_world: Float[np.ndarray, "3"]
    offset_s: float
    scale: float


def _measured(
    times, T_world_cam, sigmas, drift, imu, use, estimate, noise, offset_s: float, factors
) -> _Measured:
    t, T = checked_poses(times, T_world_cam)
    if len(t) < 2:
        raise ValueError("poses: expected at least two, got one")
    for name, given, known in (("estimate", estimate, QUANTITIES), ("use", use, SENSORS)):
        if unknown := sorted(set(given) - set(known)):
            raise ValueError(f"{name}: expected any of {', '.join(known)}, got {', '.join(unknown)}")
    if not np.isfinite(offset_s):
        raise ValueError(f"offset_s: expected a number of seconds, got {offset_s}")
    if imu is not None:
        imu = _checked_readings(imu, t, offset_s)
    names = () if imu is None else tuple(name for name in QUANTITIES if name in estimate)
    used = np.array([imu is not None and name in use for name in SENSORS], np.float64)
    root = _root_information(sigmas, len(t))
    if drift is not None:
        drift = np.asarray(drift, np.float64)
        check_shapes(drift=(drift, f"{len(t)} 6 6"))
    known = checked_factors(factors, (t[0], t[-1]))
    return _Measured(t, T, root, drift, imu, used, noise, names, known)


def _guess(measured: _Measured, T_body_cam, gravity_world, offset_s: float) -> _Guess:
    """Mounting, gravity, offset and scale to start from: those that are given, and by alignment the rest."""
    t, T, imu, asked = measured.t, measured.T, measured.imu, measured.estimate
    if T_body_cam is None and "extrinsics" not in asked:
        T_body_cam = np.eye(4)
    gravity = np.array(GRAVITY_WORLD if gravity_world is None else gravity_world, np.float64)
    if imu is None:
        return _Guess(np.eye(4) if T_body_cam is None else T_body_cam, gravity, 0.0, 1.0)
    unknown_gravity = gravity_world is None and "gravity" in asked
    if T_body_cam is not None and not (unknown_gravity or {"offset", "scale"} & set(asked)):
        return _Guess(np.asarray(T_body_cam, np.float64), gravity, offset_s, 1.0)
    R = None if T_body_cam is None else np.asarray(T_body_cam, np.float64)[:3, :3]
    turned = alignment.gyro_orientation(imu)
    if R is None or "offset" in asked:
        reach = _REACH_S if "offset" in asked else 0.0
        shift, R = alignment.rotation_alignment(t + offset_s, T[:, :3, :3], turned, reach, R)
        offset_s += shift
    scale = 1.0
    if "scale" in asked or unknown_gravity:
        size, known = float(np.linalg.norm(gravity)), None if "scale" in asked else 1.0
        scale, found = alignment.scale_and_gravity(t + offset_s, T, imu, turned, R, size, scale=known)
        gravity = found if unknown_gravity else gravity
    T_body_cam = rigid.make(R, np.zeros(3)) if T_body_cam is None else np.asarray(T_body_cam, np.float64)
    return _Guess(T_body_cam, gravity, offset_s, scale)


class _Posed(NamedTuple):
    """A problem to be solved from where it starts, in float64."""

    problem: Problem
    level: Noise  # of noise: where its estimate starts
    usual: Noise
    readings: inertial.NodeReadings
    clock_s: float  # of the spline's start


def _solved(
    measured: _Measured, guess: _Guess, fit_noise: bool, knots_hz: float | None, drift_s: float
) -> Posterior:
    with jax.enable_x64(True):
        problem, level, usual, readings, first = _posed(measured, guess, fit_noise, knots_hz, drift_s)
        at = solver.optimise(problem, problem.start, level)
        if fit_noise:
            at, level = calibrated(problem, at, level, usual)
        return posterior_of(problem, at, level, readings, clock_s=first, estimated=measured.estimate)


def _posed(
    measured: _Measured, guess: _Guess, fit_noise: bool, knots_hz: float | None, drift_s: float
) -> _Posed:
    t, imu = measured.t + guess.offset_s, measured.imu
    margin = _MARGIN_S if "offset" in measured.estimate else 0.0
    first, last = t[0] - margin, t[-1] + margin
    if knots_hz is None:
        knots_hz = 1 / float(np.median(np.diff(t)))
        if imu is not None:
            knots_hz = min(_KNOTS_HZ, 1 / (4 * float(np.median(np.diff(imu.t)))))
    intervals = 3 * max(int(np.ceil((last - first) * knots_hz / 3)), 1)
    none = Imu(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    readings = inertial.node_readings(none if imu is None else imu, (first, last), intervals)
    metric = measured.T.copy()
    metric[:, :3, 3] *= guess.scale
    along_body = metric @ rigid.inverse(guess.T_body_cam)
    ends = np.linspace(first, last, intervals // 3 + 1)  # of blocks
    root_drift, to_camera = _drift_steps(measured.drift, t, metric, ends)
    control = control_poses_along((first, last), intervals, t, along_body)
    levels = first_levels(readings, measured.noise, imu, t, metric, fit_noise)
    f = lambda x: jnp.asarray(x, jnp.float64)
    padded = lambda x, mode: np.pad(x, [(0, _room_for(len(t)) - len(t)), *[(0, 0)] * (x.ndim - 1)], mode)
    none = np.zeros((intervals // 3 + 1, 6))
    sensors = (guess.gravity_world, guess.offset_s, guess.T_body_cam, np.log(guess.scale))
    problem = Problem(
        interval_s=f((last - first) / intervals),
        root=f(readings.root),
        value=f(readings.value),
        used=f(measured.used),
        t=f(padded(measured.t - first, "edge")),
        T=f(padded(measured.T, "edge")),
        root_information=f(padded(measured.root_information, "constant")),
        root_drift=f(root_drift),
        to_camera=f(to_camera),
        kept=f(np.exp(-3 * (last - first) / intervals / drift_s)),
        start=State(*map(f, (control, none, none, *sensors))),
        prior=jax.tree.map(jnp.asarray, _prior(measured.estimate, measured.noise)),
        factors=jax.tree.map(jnp.asarray, tuple(x._replace(t=x.t - first) for x in measured.factors)),
    )
    level, usual = jax.tree.map(f, levels)
    return _Posed(problem, level, usual, readings, first)


def _room_for(poses: int) -> int:
    """About as many, so that a few more or less are compiled once: those beyond them say nothing."""
    step = max(8, 2 ** (poses.bit_length() - 4))
    return -(-poses // step) * step


def _drift_steps(
    drift: Float[np.ndarray, "n 6 6"] | None,
    t: Float[np.ndarray, " n"],
    T_world_cam: Float[np.ndarray, "n 4 4"],
    ends: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, "m-1 6 6"], Float[np.ndarray, "m-1 6 6"]]:
    """Roots of the information of the drift's steps between times, in the axes of the camera after each.

    What is added at a pose is spread evenly over the time since the last one.

    Returns:
        The roots, and what brings twists of the world to those axes.
    """
    to_world = rigid.adjoint(T_world_cam)
    after = np.clip(np.searchsorted(t, ends[1:]), 0, len(t) - 1)
    to_camera = np.linalg.inv(to_world[after])
    if drift is None:
        return np.tile(np.eye(6) / _NO_DRIFT, (len(after), 1, 1)), to_camera
    added = np.cumsum(rigid.carried(T_world_cam, drift)[1:], axis=0)
    added = np.concatenate([np.zeros((1, 6, 6)), added]).reshape(len(t), 36)
    total = np.stack([np.interp(ends, t, column) for column in added.T], axis=1).reshape(-1, 6, 6)
    covariance = to_camera @ np.diff(total, axis=0) @ np.swapaxes(to_camera, 1, 2) + _NO_DRIFT**2 * np.eye(6)
    return np.linalg.inv(np.linalg.cholesky(covariance)), to_camera


def _prior(estimate: Sequence[str], noise: ImuNoise | None) -> Prior:
    """What is known before; what is not estimated is known."""
    walk = noise or _WALK
    bias = np.repeat([_GYRO_BIAS, _ACCELEROMETER_BIAS], 3)
    walks = np.repeat([walk.gyro_walk, walk.accelerometer_walk], 3)
    if "biases" not in estimate:
        bias, walks = np.zeros(6), np.zeros(6)
    border = np.array([_TURN] * 2 + [_OFFSET_S] + [_LEVER_M] * 3 + [_TURN] * 3 + [_LOG_SCALE])
    names = ["gravity"] * 2 + ["offset"] + ["extrinsics"] * 6 + ["scale"]
    free = np.array([name in estimate for name in names])
    return Prior(np.maximum(bias, 1e-9), np.maximum(walks, 1e-9), border, free)


def _root_information(sigmas: ArrayLike, count: int) -> Float[np.ndarray, "n 6 6"]:
    """Upper roots S of the information, S^T S, of each pose."""
    x = np.asarray(sigmas, np.float64)
    if x.shape in ((6,), (count, 6)):
        if not (np.isfinite(x).all() and (x > 0).all()):
            raise ValueError(f"sigmas: expected numbers above 0, got {x[~(x > 0) | np.isinf(x)][0]:g}")
        return (1 / np.broadcast_to(x, (count, 6)))[:, :, None] * np.eye(6)
    if x.shape != (count, 6, 6):
        raise ValueError(f"sigmas: expected shape (6,), ({count}, 6) or ({count}, 6, 6), got {x.shape}")
    try:
        roots = np.linalg.cholesky(np.linalg.inv(x))
    except np.linalg.LinAlgError:
        raise ValueError("sigmas: expected covariances that are positive definite") from None
    if not np.isfinite(roots).all():
        raise ValueError("sigmas: expected finite covariances")
    return np.swapaxes(roots, 1, 2)


def _checked_readings(imu: Imu, t: Float[np.ndarray, " n"], offset_s: float) -> Imu:
    """The readings in float64; an error for what cannot be used."""
    check_readings(imu)
    columns = {name: np.asarray(x, np.float64) for name, x in imu._asdict().items()}
    for name, x in columns.items():
        if not np.isfinite(x).all():
            row = int(np.flatnonzero(~np.isfinite(x.reshape(len(x), -1)).all(1))[0])
            raise DataError(f"IMU: expected finite numbers, got {name}[{row}] = {x[row]}")
    times = columns["t"]
    check_increasing(**{"imu.t": times})
    first, last = t[0] + offset_s, t[-1] + offset_s
    if len(times) < 2 or times[-1] <= first or times[0] >= last:
        found = f"between {times[0]:.3f} and {times[-1]:.3f} s" if len(times) else "nowhere"
        raise DataError(
            f"IMU: expected readings between {first:.3f} and {last:.3f} s (the poses), got them {found}"
        )
    return Imu(**columns)
