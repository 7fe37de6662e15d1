"""Tests of inertial readings against true poses: units, clock, mounting, gravity, biases."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, Slerp

from jaxpose.cli.check.findings import Checked, Fact, Finding
from jaxpose.cli.check.poses import Order, reorder
from jaxpose.cli.check.readings import STANDARD
from jaxpose.geometry import rigid
from jaxpose.imu import Imu

_WINDOW_S = 0.05  # over which rates are compared
_MOST_GAP_S = 0.2  # between two true poses that a rate is taken from
_MOST_OFFSET_S = 1.0
_STEP_S = 0.005
_LEAST_RATE = 0.02  # rad/s RMS; less tells nothing
_AGREE, _BETTER, _SAME = 0.9, 0.1, 0.005  # correlations
_OFFSET_S, _OFF_DEG = 0.01, 5.0  # clock and mounting: more is told
_GYRO_BIAS = 0.3  # rad/s
_MOST_BIAS = 1.0  # m/s^2


class _Match(NamedTuple):
    """How rates of the poses and of a gyroscope agree best: rate = R_body_imu (reading - bias) / ratio."""

    correlation: float
    offset_s: float  # reading at t + offset is the motion at t
    R_body_imu: Float[np.ndarray, "3 3"]
    ratio: float
    bias: Float[np.ndarray, "3"]  # in readings


def check_imu(
    imu: Imu,
    t: Float[np.ndarray, " n"],
    T_world_body: Float[np.ndarray, "n 4 4"],
    R_body_imu: Float[np.ndarray, "3 3"] | None,
    read_as: Order = "wxyz",
    gyroscope_named: bool = False,
) -> Checked:
    """Readings in SI against poses on the same clock; z is taken to point up.

    `R_body_imu` is the stated mounting, None where none is; `gyroscope_named`: its fault is known already.
    """
    rates = {
        "poses as read": T_world_body,
        "world-to-body poses (inverted)": rigid.inverse(T_world_body),
        f"quaternions in the order {'xyzw' if read_as == 'wxyz' else 'wxyz'}": reorder(T_world_body, read_as),
    }
    matches = {name: match for name, T in rates.items() if (match := _match(imu, t, T))}
    if len(matches) < len(rates):
        note = "the poses turn too little, or overlap too little with the IMU, to test it against them"
        return Checked(notes=(note,))
    given = matches["poses as read"]
    stated = given.R_body_imu if R_body_imu is None else R_body_imu
    off_deg = {name: _angle_deg(match.R_body_imu @ stated.T) for name, match in matches.items()}
    off = off_deg["poses as read"]
    mounting = "not stated" if R_body_imu is None else f"{off:.1f} deg from the stated"
    text = f"gyroscope and poses: correlation {given.correlation:.3f}, clock offset "
    text += f"{1e3 * given.offset_s:.1f} ms, mounting {mounting}, "
    text += f"bias {np.round(given.bias, 4).tolist()} rad/s"
    numbers = {"correlation": given.correlation, "offset_s": given.offset_s, "rotation_deg": off}
    numbers |= {"gyro_ratio": given.ratio, "gyro_bias": float(np.linalg.norm(given.bias))}
    fact = Fact("IMU and poses", text, numbers)
    if given.correlation < _AGREE:
        return Checked((fact,), (_wrong_poses(matches, off_deg),))
    findings = _rates(given, off, gyroscope_named)
    findings.append(_gravity(imu, t + given.offset_s, T_world_body @ _turned(stated)))
    return Checked((fact,), tuple(findings))


def _wrong_poses(matches: dict[str, _Match], off_deg: dict[str, float]) -> Finding:
    """What has to be done with the poses for them to turn as the gyroscope says."""
    test, expected = "IMU and poses", "poses that turn as the gyroscope says"
    given = matches["poses as read"].correlation
    found = f"a correlation of {given:.2f} at best"
    top = max(match.correlation for match in matches.values())
    if top < max(_AGREE, given + _BETTER):
        fix = "check that the IMU belongs to these poses, by the same clock"
        return Finding("warning", test, found, expected, fix)
    # Inverted poses and misread quaternions turn alike, but for a constant rotation: the mounting tells.
    near = [name for name, match in matches.items() if match.correlation > top - _SAME]
    best = min(near, key=lambda name: off_deg[name])
    found += f", but {matches[best].correlation:.2f} with {best}"
    if "quaternion" in best:
        return Finding("warning", "quaternion order", found, expected, "write them in the format's order")
    return Finding("warning", test, found, expected, "invert the poses")


def _rates(match: _Match, off_deg: float, named: bool) -> list[Finding]:
    findings = []
    if not named and not 0.8 < match.ratio < 1.25:
        degrees = 0.8 < np.radians(match.ratio) < 1.25
        found = f"readings {match.ratio:.4g} times as large" + (": they are in degrees/s" if degrees else "")
        fix = "convert the gyroscope to rad/s" if degrees else "check the unit of the gyroscope"
        findings.append(Finding("warning", "gyroscope unit", found, "body rates of the poses in rad/s", fix))
    elif np.linalg.norm(match.bias) > _GYRO_BIAS:
        found = f"{np.linalg.norm(match.bias):.3g} rad/s"
        findings.append(
            Finding("warning", "gyroscope bias", found, f"a bias below {_GYRO_BIAS:g} rad/s", "calibrate it")
        )
    if abs(match.offset_s) > _OFFSET_S:
        late = "late" if match.offset_s > 0 else "early"
        found = f"timestamps of the IMU {1e3 * abs(match.offset_s):.1f} ms {late} against those of the poses"
        fix = f"add {-match.offset_s:.4f} s to the timestamps of the IMU"
        findings.append(Finding("warning", "clock offset", found, f"at most {1e3 * _OFFSET_S:g} ms", fix))
    if off_deg > _OFF_DEG:
        found = f"{off_deg:.1f} deg between the axes that the readings have and those stated"
        R = np.round(match.R_body_imu, 3).tolist()
        fix = f"the rotation body from IMU is about {R}"
        findings.append(Finding("warning", "IMU rotation", found, f"at most {_OFF_DEG:g} deg", fix))
    if not findings and not named:
        found = f"gyroscope in rad/s, {1e3 * match.offset_s:.1f} ms and {off_deg:.1f} deg off the poses"
        findings.append(Finding("ok", "gyroscope", found))
    return findings


def _gravity(imu: Imu, t: Float[np.ndarray, " n"], T_world_imu: Float[np.ndarray, "n 4 4"]) -> Finding:
    """Whether the specific force, turned into the world, is gravity's on average."""
    at = np.asarray(imu.t)
    inside = (at >= t[0]) & (at <= t[-1])
    R = Slerp(t, Rotation.from_matrix(T_world_imu[:, :3, :3]))(at[inside]).as_matrix()
    force = np.asarray(imu.acceleration_body)[inside]
    up = np.einsum("nij,nj->i", R, force) / len(R)  # the acceleration is nothing on average
    off = np.degrees(rigid.vector_angle(up, np.array([0.0, 0.0, 1.0])))
    test, expected = "gravity", "a specific force that points up, along z of the world"
    told = f"{np.round(up, 2).tolist()} m/s^2 on average in the world"
    if off > 180 - _OFF_DEG:
        return Finding("warning", test, f"{told}, down", expected, "change the sign of the accelerometer")
    if off > _OFF_DEG:
        fix = "turn the world upright, or check that IMU and poses have the same body"
        return Finding("warning", test, f"{told}, {off:.1f} deg off", expected, fix)
    if abs(np.linalg.norm(up) - STANDARD) > _MOST_BIAS:
        fix = "calibrate the accelerometer: it has a bias along the vertical, or a wrong scale"
        return Finding("warning", test, told, f"{STANDARD:.2f} m/s^2 within {_MOST_BIAS:g}", fix)
    return Finding("ok", test, f"{told}, {off:.1f} deg off z")


def _match(imu: Imu, t: Float[np.ndarray, " n"], T: Float[np.ndarray, "n 4 4"]) -> _Match | None:
    """Mean body rates over windows between poses against means of the readings, at every clock offset."""
    if len(t) < 2:
        return None
    rows = slice(None, None, max(1, round(_WINDOW_S / float(np.median(np.diff(t))))))
    t, R, at = t[rows], Rotation.from_matrix(T[rows, :3, :3]), np.asarray(imu.t)
    step = np.diff(t)
    most = min(_MOST_OFFSET_S, float(np.ptp(at)) / 4)
    used: Bool[np.ndarray, " m"] = (step < _MOST_GAP_S) & (t[:-1] > at[0] + most) & (t[1:] < at[-1] - most)
    if used.sum() < 20:
        return None
    turned = (R[:-1].inv() * R[1:]).as_rotvec() / step[:, None]
    rate = turned[used] - turned[used].mean(0)
    if np.sqrt((rate**2).sum(1).mean()) < _LEAST_RATE:
        return None
    omega = np.asarray(imu.omega_body)
    angle = np.cumsum((omega[1:] + omega[:-1]) / 2 * np.diff(at)[:, None], axis=0)
    angle = np.concatenate([np.zeros((1, 3)), angle])

    def readings(offset: float) -> Float[np.ndarray, "m 3"]:
        ends = np.stack([np.interp(t + offset, at, column) for column in angle.T], axis=1)
        return (np.diff(ends, axis=0) / step[:, None])[used]

    def agreement(offset: float) -> tuple[float, Float[np.ndarray, "3 3"]]:
        reading = readings(offset)
        reading = reading - reading.mean(0)
        u, s, v = np.linalg.svd(rate.T @ reading)
        signs = np.array([1, 1, np.linalg.det(u @ v)])
        size = np.linalg.norm(rate) * np.linalg.norm(reading)
        return float(s @ signs / max(size, 1e-12)), (u * signs) @ v

    steps = round(most / _STEP_S)
    offsets = _STEP_S * np.arange(-steps, steps + 1)
    correlations = np.array([agreement(offset)[0] for offset in offsets])
    k = int(np.clip(correlations.argmax(), 1, len(offsets) - 2))
    before, top, after = correlations[k - 1 : k + 2]
    curve = before - 2 * top + after
    offset = float(offsets[k] + (_STEP_S * 0.5 * (before - after) / curve if curve < 0 else 0.0))
    correlation, R_body_imu = agreement(offset)
    reading = readings(offset)
    ratio = float(np.linalg.norm(reading - reading.mean(0)) / np.linalg.norm(rate))
    bias = reading.mean(0) - ratio * turned[used].mean(0) @ R_body_imu
    return _Match(correlation, offset, R_body_imu, ratio, bias)


def _angle_deg(R: Float[np.ndarray, "3 3"]) -> float:
    return float(np.degrees(rigid.rotation_angle(np.eye(3), R)))


def _turned(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    return rigid.make(R, np.zeros(3))
