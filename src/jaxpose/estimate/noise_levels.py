"""How noisy sensors and poses are, by how large residuals are beside what is expected of them."""

import jax
import numpy as np
from jaxtyping import Float

from jaxpose.estimate import inertial, solver
from jaxpose.estimate.system import Noise, Problem
from jaxpose.geometry import rigid
from jaxpose.imu import Imu, ImuNoise, residual_sigmas
from jaxpose.imu.types import AnyArray

_ROUNDS = 10  # at most
_CALM = 0.05  # share by which a level changes when it is found
_SEEN = 20.0  # residuals that the usual noise counts as
_OPTIMISM = 3.0  # times its data sheet: what a mounted sensor's noise usually is
_RESTLESS = 1e-3  # m/s^2/sqrt(Hz), rad/s^2/sqrt(Hz): of what seems to stand still
_UNKNOWN = np.array([0.01, 0.1])  # rad/s, m/s^2: where readings are too few to say


def first_levels(
    readings: inertial.NodeReadings,
    noise: ImuNoise | None,
    imu: Imu | None,
    t: Float[np.ndarray, " n"],
    T: Float[np.ndarray, "n 4 4"],
    fit_noise: bool,
) -> tuple[Noise, Noise]:
    """Levels of noise to start from, and the usual ones, which hold where residuals are too few to say.

    Args:
        readings: reduced readings, whose own noise says how good the sensor is at best.
        noise: data sheet.
        imu: the readings; None without.
        t: times of the poses [s].
        T: the poses in metres.
        fit_noise: whether levels are estimated; else they are the data sheet's.

    Raises:
        ValueError: no data sheet where one is needed.
    """
    sheet = np.zeros(2)
    if noise is not None and imu is not None:
        stated = residual_sigmas(noise, 1 / float(np.median(np.diff(imu.t))), duration=0.0)
        sheet = np.array([stated.tight, stated.accelerometer])
    found = inertial.white_noise(readings)
    white = np.where(np.isfinite(found) & (found > 0), found, _UNKNOWN)
    start = np.maximum(white, sheet) if fit_noise or imu is None else sheet
    if not (start > 0).all():
        raise ValueError("noise: expected a data sheet with densities above 0, as fit_noise is off")
    usual = np.where(sheet > 0, np.minimum(white, _OPTIMISM * sheet), white)
    bands, one = np.ones(inertial.BANDS), np.ones(())
    restless = map(np.asarray, _restlessness(t, T))
    first = Noise(start[0] * bands, start[1] * bands, one, one, *restless)
    return first, first._replace(gyro=usual[0] * bands, accelerometer=usual[1] * bands)


def calibrated(
    problem: Problem, at: solver.Linearisation, level: Noise, usual: Noise
) -> tuple[solver.Linearisation, Noise]:
    """The best state, and the levels of noise at which residuals are as large as they are expected to be.

    A group's sum of squares is expected to be its number less what the unknowns explain of it, which is the
    estimate of variance components by restricted maximum likelihood (Patterson and Thompson 1971). A factor
    of poses is known where a sensor measures the same: one sensor of the two tells it for positions and
    rotations alike, none tells nothing.
    """
    level, usual = jax.device_get((level, usual))  # few numbers: compiling takes longer than they do
    for _ in range(_ROUNDS):
        fit = jax.device_get(solver.spread(at)[2])
        new = Noise(*map(_level, level, usual, fit.squares, fit.degrees))
        new = new._replace(**_of_poses(problem, level, new))
        calm = all(np.all(np.abs(a / b - 1) < _CALM) for a, b in zip(new, level, strict=True))
        level = new
        at = solver.optimise(problem, at.state, level, steps=1)
        if calm:
            break
    return solver.optimise(problem, at.state, level), level


def _of_poses(problem: Problem, level: Noise, new: Noise) -> dict[str, Float[AnyArray, ""]]:
    gyro, accelerometer = (float(x) > 0 for x in problem.used)
    if gyro and accelerometer:
        return {"position": new.position, "rotation": new.rotation}
    one = new.rotation if gyro else new.position if accelerometer else level.position
    return {"position": one, "rotation": one}


def _level(level, usual, squares, degrees) -> Float[np.ndarray, "*m"]:
    """The level of a group, if the usual one was seen `_SEEN` times."""
    found = (squares * level**2 + _SEEN * usual**2) / (np.maximum(degrees, 0) + _SEEN)
    return np.asarray(np.clip(np.sqrt(found), level / 3, level * 3))


def _restlessness(t: Float[np.ndarray, " n"], T: Float[np.ndarray, "n 4 4"]) -> tuple[float, float]:
    """Density of acceleration and of angular acceleration by differences of neighbouring poses."""
    dt = np.diff(t)[:, None]
    turn = rigid.so3_log(np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3]) / dt
    speed = np.diff(T[:, :3, 3], axis=0) / dt
    step = (dt[1:] + dt[:-1]) / 2
    if len(t) < 3:
        return 1.0, 1.0
    density = lambda x: float(np.sqrt(np.mean(np.diff(x, axis=0) ** 2 / step))) + _RESTLESS
    return density(speed), density(turn)
