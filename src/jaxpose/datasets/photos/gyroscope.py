"""A gyroscope's readings beside a video: its axes, clock and unit are those that agree with the images."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd.frames import visible
from jaxpose.datasets.rgbd.imu_csv import read_rates
from jaxpose.datasets.video import Video
from jaxpose.errors import DataError
from jaxpose.geometry.rigid import nearest_rotation

_WIDTH, _FRAMES = 240, 300  # px, and frames from the first on that are looked at
_FEWEST = 12  # features, or frames, that a rotation is told by
_AGREES = 0.7  # of the squares of rates that images and gyroscope have in common
_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180}
_OFF = 1.5  # most that rates may differ by, as a focal length may be wrong


class Aligned(NamedTuple):
    """Readings on the clock of the video, in the axes of the camera, and what was found out."""

    t: Float[np.ndarray, " m"]  # [s] from the first frame on
    omega_cam: Float[np.ndarray, "m 3"]  # [rad/s]
    note: str


def find_readings(video: Path) -> Path | None:
    """The table of a gyroscope beside a video.

    Args:
        video: The video.

    Returns:
        The one whose name begins as the video's, else the only one; None where there is none.
    """
    tables = [file for file in visible(video.parent) if file.suffix.lower() in (".csv", ".txt")]
    found = [file for file in tables if _has_rates(file)]
    named = [file for file in found if file.stem.lower().startswith(video.stem.lower())]
    chosen = named or (found if len(found) == 1 else [])
    return chosen[0] if chosen else None


def _has_rates(file: Path) -> bool:
    try:
        read_rates(file)
    except DataError:
        return False
    return True


def align(video: Video, focal_px: float, file: Path) -> Aligned | str:
    """Bring a gyroscope to a video by how its images turn.

    The rotation between frames is that of features, as of a scene far away; the clocks' offset is where the
    rates correlate best, the axes are turned by least squares (Wahba's problem; Markley 1988), the unit is
    that whose rates are as large. Recorders have any clock and axes.

    Args:
        video: The video.
        focal_px: Focal length of its frames [px].
        file: The table of readings.

    Returns:
        The readings; or in words why they are not used.

    Raises:
        DataError: For a table or video that cannot be read.
    """
    rates, t = read_rates(file), 1e-9 * (np.array(video.ns[:_FRAMES]) - video.ns[0])
    at = (np.array(rates.ns) - rates.ns[0]) * 1e-9
    if at[-1] < t[-1]:
        return f"{file.name} is not used: {at[-1]:.3g} s of readings, {t[-1]:.3g} s of the video"
    seen = _turning(video, t, focal_px)
    known = np.isfinite(seen).all(1)
    if known.sum() < _FEWEST:
        return f"{file.name} is not used: the images show too few features to tell how they turn"
    steps = np.diff(at)[:, None] * _middles(rates.omega)
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def fit(start: float) -> _Fit:
        turned = np.stack([np.interp(start + t, at, column) for column in angle.T], axis=1)
        return _fit(seen[known], (np.diff(turned, axis=0) / np.diff(t)[:, None])[known])

    step, last = float(np.median(np.diff(t))), at[-1] - t[-1]
    start = max(np.arange(0.0, last + step, step), key=lambda s: fit(s).agreement)
    fine = np.clip(start + step * np.linspace(-1, 1, 21), 0, last)
    start = float(max(fine, key=lambda s: fit(s).agreement))
    agreement, turn, scale = fit(start)
    units = ("rad/s", "deg/s") if rates.unit is None else ("rad/s",)
    unit = next((u for u in units if 1 / _OFF < scale / _UNITS[u] < _OFF), None)
    if agreement < _AGREES or unit is None:
        got = f"{agreement:.0%} of the rates agree, at {scale:.3g} times the readings"
        return f"{file.name} is not used: it does not turn as the images do ({got})"
    said = f"{file.name}: {rates.unit or unit}, first frame {start:.3f} s after its first reading"
    note = f"{said}, axes turned to the camera's, by the images ({agreement:.0%} of the rates agree)"
    return Aligned(at - start, _UNITS[unit] * rates.omega @ turn.T, note)


def orientations(aligned: Aligned, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations of the camera by a gyroscope alone.

    Args:
        aligned: The readings.
        t: Times (n,) [s] from the first frame on, increasing.

    Returns:
        Camera to the axes of the camera at the first time.
    """
    times = np.union1d(aligned.t[(aligned.t > t[0]) & (aligned.t < t[-1])], t)
    omega = np.stack([np.interp(times, aligned.t, column) for column in aligned.omega_cam.T], axis=1)
    steps = Rotation.from_rotvec(_middles(omega) * np.diff(times)[:, None])
    turn, found = Rotation.identity(), [np.eye(3)]
    for step in steps:
        turn = turn * step
        found.append(turn.as_matrix())
    return np.stack(found)[np.searchsorted(times, t)]


def _middles(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n-1 3"]:
    return 0.5 * (values[1:] + values[:-1])


class _Fit(NamedTuple):
    agreement: float  # share of the squares that are explained
    turn: Float[np.ndarray, "3 3"]
    scale: float


def _fit(seen: Float[np.ndarray, "k 3"], read: Float[np.ndarray, "k 3"]) -> _Fit:
    """How `read` is turned and scaled to be as `seen`."""
    turn = nearest_rotation(seen.T @ read)
    total = float((read**2).sum())
    scale = float((seen * (read @ turn.T)).sum()) / max(total, 1e-12)
    left = float(((seen - scale * read @ turn.T) ** 2).sum())
    return _Fit(1 - left / max(float((seen**2).sum()), 1e-12), turn, scale)


def _turning(video: Video, t: Float[np.ndarray, " n"], focal_px: float) -> Float[np.ndarray, "n-1 3"]:
    """Rates of the camera [rad/s] between frames, by features; NaN where they are too few."""
    width = min(_WIDTH, video.size[0])
    size = width, max(1, round(width * video.size[1] / video.size[0]))
    focal, centre = focal_px * width / video.size[0], (np.array(size) - 1) / 2
    found = np.full((len(t) - 1, 3), np.nan)
    before = cv2.cvtColor(video.read(0, size), cv2.COLOR_RGB2GRAY)
    for k in range(len(t) - 1):
        after = cv2.cvtColor(video.read(k + 1, size), cv2.COLOR_RGB2GRAY)
        points = cv2.goodFeaturesToTrack(before, 200, 0.01, 5)
        if points is not None and len(points) >= _FEWEST:
            moved, there, _ = cv2.calcOpticalFlowPyrLK(before, after, points, points.copy())
            kept = there[:, 0] > 0
            first, last = ((x[kept, 0] - centre) / focal for x in (points, moved))
            if kept.sum() >= _FEWEST:
                found[k] = _rotation(first, last - first) / (t[k + 1] - t[k])
        before = after
    return found


def _rotation(at: Float[np.ndarray, "k 2"], flow: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "3"]:
    """The small rotation of a camera that moves points of z = 1 so (Longuet-Higgins and Prazdny 1980)."""
    x, y = at.T
    rows = np.stack([x * y, -(1 + x**2), y, 1 + y**2, -x * y, -x], axis=1).reshape(-1, 3)
    kept = np.ones(len(at), bool)
    turn = np.zeros(3)
    for _ in range(3):
        both = np.repeat(kept, 2)
        turn = np.linalg.lstsq(rows[both], flow.reshape(-1)[both], rcond=None)[0]
        off = np.linalg.norm(flow - (rows @ turn).reshape(-1, 2), axis=1)
        kept = off <= 2 * max(float(np.median(off)), 1e-9)
    return turn
