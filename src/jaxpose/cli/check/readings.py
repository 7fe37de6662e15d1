"""Tests of inertial readings by themselves, by gravity: units, no gravity, swapped columns, sign."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.cli.check.findings import Checked, Fact, Finding
from jaxpose.imu import Imu

STANDARD = 9.80665
_UNITS = {
    "m/s^2": 1.0,
    "g": 1 / STANDARD,
    "cm/s^2 (Gal)": 100.0,
    "mm/s^2": 1e3,
    "mg": 1e3 / STANDARD,
    **{f"counts of 1/{count} g": count / STANDARD for count in (16384, 8192, 4096, 2048)},
}
_OFF_GRAVITY = 0.15  # of the length of mean forces
_WINDOW_S = 1.0  # over which a body's own acceleration is nothing, for the most part
_STEADY = 0.4  # quartiles of the means' length, over their median: 0.6 where it is of random vectors
_LONG_S = 10.0  # over which forces that turn with the body have no mean in the world, but gravity has
_WEAK = 3.0  # m/s^2: means below it are no gravity
_TURN_S, _STEP_S = 0.4, 0.02  # between two forces, and of the rotations between them
_MOST_RATE = 40.0  # rad/s RMS: no gyroscope reads more
_BETTER = 0.6  # of the other's error, for a unit to be told by it
_UPSIDE_DOWN = -0.8  # cosine between forces and the upper edge of the image


class Alone(NamedTuple):
    """What readings say of themselves."""

    checked: Checked
    si: Imu  # with what is known to be in another unit brought to SI
    swapped: bool
    gyroscope_named: bool  # whether a fault of the gyroscope was found


class _Force(NamedTuple):
    """Means of vectors over windows: their median length, and how much that length varies."""

    level: float
    spread: float

    @property
    def unit(self) -> str | None:
        """Of a steady force that is as long as gravity; None for any other."""
        fits = [u for u, factor in _UNITS.items() if abs(self.level / (STANDARD * factor) - 1) < _OFF_GRAVITY]
        return fits[0] if fits and self.spread < _STEADY else None


def check_readings(imu: Imu, R_cam_imu: Float[np.ndarray, "3 3"] | None) -> Alone:
    """Readings without poses; `R_cam_imu` is for the sign of the force, None where it is not to be tested."""
    omega, force = np.asarray(imu.omega_body), np.asarray(imu.acceleration_body)
    t = np.asarray(imu.t)
    rate, pull = _force(t, omega), _force(t, force)
    if max(_in_the_world(t, scale * omega, force) for scale in (1.0, np.pi / 180)) < 0.5 * pull.level:
        pull = pull._replace(spread=np.inf)  # it turns about itself, as a body's own acceleration does
    text = (
        f"median {np.median(np.linalg.norm(omega, axis=1)):.3g} rad/s and {pull.level:.4g} m/s^2 (means of "
    )
    text += f"{_WINDOW_S:g} s), as the units of the format are"
    fact = Fact("readings", text, {"omega": rate.level, "acceleration": pull.level})
    if pull.unit is None and rate.unit in ("m/s^2", "g"):
        found = f"rates of a steady {rate.level:.4g} and forces of {pull.level:.4g}"
        fix = "swap the columns of the gyroscope and the accelerometer"
        swapped = Finding(
            "warning", "gyroscope and accelerometer", found, "gravity in the accelerometer", fix
        )
        return Alone(Checked((fact,), (swapped,)), imu, True, True)
    findings, notes = [_unit_of_force(pull)], []
    force_si = force / _UNITS[pull.unit] if pull.unit else force
    omega_si, named = omega, _gyroscope(t, omega, force_si, pull)
    if named is not None:
        findings.append(named)
        omega_si = np.radians(omega) if "deg/s" in named.found else omega
    if pull.unit and R_cam_imu is not None:
        findings += _sign(force @ R_cam_imu.T)
    elif pull.unit:
        notes.append(
            "the sign of the accelerometer shows against poses, or a camera that is known to be upright"
        )
    checked = Checked((fact,), tuple(findings), tuple(notes))
    return Alone(checked, Imu(imu.t, omega_si, force_si), False, named is not None)


def _unit_of_force(pull: _Force) -> Finding:
    """Whether the mean force is gravity's, and in which unit."""
    test, expected = "accelerometer unit", f"about {STANDARD:.2f} m/s^2 at the median"
    if pull.unit == "m/s^2":
        return Finding("ok", test, f"{pull.level:.4g} m/s^2 at the median, gravity's")
    found = f"{pull.level:.4g}"
    if pull.unit:
        found += f": readings in {pull.unit}"
        return Finding("warning", test, found, expected, f"multiply by {1 / _UNITS[pull.unit]:.6g}")
    if pull.level < _WEAK:
        fix = "record the specific force, gravity in it: jaxpose cannot put it back"
        return Finding("warning", "gravity", f"{found}: gravity was removed", expected, fix)
    return Finding("warning", test, found, expected, "check its unit, and whether gravity was removed")


def _gyroscope(
    t: Float[np.ndarray, " n"], omega: Float[np.ndarray, "n 3"], force: Float[np.ndarray, "n 3"], pull: _Force
) -> Finding | None:
    """A warning where gravity turns in the body's axes as the gyroscope does not say, or says in degrees."""
    test, expected = "gyroscope unit", "rates in rad/s"
    rms = float(np.sqrt((omega**2).sum(1).mean()))
    convert = "convert the gyroscope to rad/s"
    if rms > _MOST_RATE:
        return Finding("warning", test, f"{rms:.3g} RMS: they are in deg/s", expected, convert)
    if pull.unit is None:
        return None
    still, radians, degrees = (_turned_error(t, scale * omega, force) for scale in (0.0, 1.0, np.pi / 180))
    if still == 0.0 or min(radians, degrees) > 0.9 * still:
        worse = radians > 1.5 * still > 0.0 and degrees > 0.9 * still
        if not worse or degrees < _BETTER * radians:
            return _by_size(rms, radians, degrees, still)
        found = (
            f"gravity that turns {radians:.2g} m/s^2 off the gyroscope in {_TURN_S:g} s, {still:.2g} off none"
        )
        fix = "check the axes and signs of the gyroscope against those of the accelerometer"
        return Finding("warning", "gyroscope axes", found, "gravity that turns as the gyroscope says", fix)
    if degrees < _BETTER * radians:
        found = f"gravity that turns 1/57 as fast as the gyroscope says, {rms:.3g} RMS: they are in deg/s"
        return Finding("warning", test, found, expected, convert)
    return None


def _by_size(rms: float, radians: float, degrees: float, still: float) -> Finding | None:
    """Degrees where the body hardly tilts, and rates in rad/s would turn gravity away from where it is."""
    if not (degrees < _BETTER * radians and radians > 0.1 * STANDARD and degrees <= 1.1 * still):
        return None
    found = f"gravity that stays while the gyroscope says {rms:.3g} RMS: they are in deg/s"
    return Finding("warning", "gyroscope unit", found, "rates in rad/s", "convert the gyroscope to rad/s")


def _turned_error(
    t: Float[np.ndarray, " n"], omega: Float[np.ndarray, "n 3"], force: Float[np.ndarray, "n 3"]
) -> float:
    """Median difference between mean forces and those of 0.4 s earlier, turned as the rates say."""
    grid = np.arange(t[0], _end(t), _STEP_S)
    k = round(_TURN_S / _STEP_S)
    if len(grid) < 3 * k:
        return 0.0
    rate, pull = _means(t, omega, grid), _means(t, force, grid)
    smooth = np.stack([np.convolve(column, np.ones(k) / k, "valid") for column in pull.T], axis=1)
    first, turn = np.arange(0, len(smooth) - k, k), Rotation.identity(len(np.arange(0, len(smooth) - k, k)))
    for j in range(k):  # from the middle of one window to that of the next
        turn = turn * Rotation.from_rotvec(rate[first + k // 2 + j] * _STEP_S)
    return float(np.median(np.linalg.norm(smooth[first + k] - turn.inv().apply(smooth[first]), axis=1)))


def _in_the_world(
    t: Float[np.ndarray, " n"], omega: Float[np.ndarray, "n 3"], force: Float[np.ndarray, "n 3"]
) -> float:
    """Median length of means over 10 s of forces that are turned into one frame, as the rates say."""
    grid = np.arange(t[0], _end(t), _STEP_S)
    if len(grid) < 2:
        return np.inf
    rate, pull = _means(t, omega, grid), _means(t, force, grid)
    k = min(round(_LONG_S / _STEP_S), len(pull))
    first = np.arange(0, len(pull) - k + 1, k)
    turn, total = Rotation.identity(len(first)), np.zeros((len(first), 3))
    for j in range(k):
        total += turn.apply(pull[first + j])
        turn = turn * Rotation.from_rotvec(rate[first + j] * _STEP_S)
    return float(np.median(np.linalg.norm(total, axis=1))) / k


def _sign(force_cam: Float[np.ndarray, "n 3"]) -> list[Finding]:
    """A force that points to the lower edge of the image."""
    up = -force_cam[:, 1] / np.maximum(np.linalg.norm(force_cam, axis=1), 1e-12)
    if float(np.median(up)) > _UPSIDE_DOWN:
        return []
    found = f"a force that points to the lower edge of the image ({np.median(up):.2f} of it up)"
    fix = "change the sign of the accelerometer, unless the camera hangs upside down"
    return [Finding("warning", "gravity", found, "a specific force that points up", fix)]


def _end(t: Float[np.ndarray, " n"]) -> float:
    """Until when readings are tested [s]: no longer than one for each window would reach."""
    return float(min(t[-1], t[0] + len(t) * _WINDOW_S))


def _force(t: Float[np.ndarray, " n"], vectors: Float[np.ndarray, "n 3"]) -> _Force:
    end = _end(t)
    windows = np.linspace(t[0], end, max(round((end - t[0]) / _WINDOW_S), 1) + 1)
    length = np.linalg.norm(_means(t, vectors, windows), axis=1)
    low, middle, high = np.quantile(length, [0.25, 0.5, 0.75])
    return _Force(float(middle), float((high - low) / max(middle, 1e-12)))


def _means(
    t: Float[np.ndarray, " n"], vectors: Float[np.ndarray, "n 3"], edges: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m-1 3"]:
    """Means over the spans between `edges` [s] of what is linear between readings."""
    area = np.cumsum((vectors[1:] + vectors[:-1]) / 2 * np.diff(t)[:, None], axis=0)
    area = np.concatenate([np.zeros((1, 3)), area])
    at = np.stack([np.interp(edges, t, column) for column in area.T], axis=1)
    return np.diff(at, axis=0) / np.diff(edges)[:, None]
