"""Files of a run: trajectories (TUM, KITTI, EuRoC), run folders, JSON. Files appear whole or not at all."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.files.atomic import write_text
from jaxpose.files.tables import format_rows, read_numbers
from jaxpose.geometry import rigid

_TUM_COLUMNS = "8 numbers (t tx ty tz qx qy qz qw)"
_KITTI_COLUMNS = "12 numbers (the rows of a 3x4 pose)"
_EUROC_COLUMNS = "17 numbers (timestamp, position, quaternion wxyz, velocity, biases) or the first 8 of them"
_EUROC_NAMES = [f"p_RS_R_{axis} [m]" for axis in "xyz"] + [f"q_RS_{axis} []" for axis in "wxyz"]
_MOST_OFF_ROTATION = 1e-2  # entries of a rotation matrix; more is not rounding


class Trajectory(NamedTuple):
    """Stamped poses: seconds, increasing, and `T_world_cam` (or of the body), both float64."""

    t: Float[np.ndarray, " n"]
    T: Float[np.ndarray, "n 4 4"]


# --- trajectories ---------------------------------------------------------------------------------------


def read_tum(path: Path | str, *, first_of_repeated: bool = False) -> Trajectory:
    """Read a TUM trajectory: lines of `t tx ty tz qx qy qz qw`, `#` comments; quaternions are normalised.

    DataError naming file and line for a wrong number of columns, text or NaN where a number belongs, a zero
    quaternion, or timestamps that repeat or go backwards; FileNotFoundError as usual. With
    `first_of_repeated` the first of poses with the same timestamp, which real ground truth has, is kept.
    """
    lines, values = read_numbers(Path(path), _TUM_COLUMNS, counts=(8,))
    return _stamped(Path(path), lines, values[:, 0], values[:, 1:4], values[:, 4:], first_of_repeated)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM trajectory that reads back to the last bit (rotations to rounding).

    Poses with NaN, such as ground truth that is missing, are left out: the format has no word for them.
    """
    finite = np.isfinite(trajectory.T).all((1, 2))
    T = np.asarray(trajectory.T[finite], np.float64)
    quaternion_xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([trajectory.t[finite], T[:, :3, 3], quaternion_xyzw])
    write_text(path, "# timestamp tx ty tz qx qy qz qw\n" + format_rows(rows))


def read_kitti(path: Path | str, *, rate_hz: float = 10.0) -> Trajectory:
    """Read a KITTI trajectory: per line the 12 numbers of a 3x4 pose, row by row.

    The format has no timestamps: frame i is at i / rate_hz seconds. Rotations are made orthonormal; DataError
    as `read_tum`, and for a matrix that is more than rounding off a rotation.
    """
    path = Path(path)
    lines, values = read_numbers(path, _KITTI_COLUMNS, counts=(12,))
    rows = values.reshape(-1, 3, 4)
    T = rigid.make(rows[..., :3], rows[..., 3])
    return Trajectory(np.arange(len(T)) / rate_hz, orthonormal(T, lambda i: f"{path}:{lines[i]}"))


def write_kitti(path: Path | str, T_world_cam: Float[np.ndarray, "n 4 4"]) -> None:
    """Write poses as KITTI does; DataError for NaN, which cannot be left out as lines count the frames."""
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.all():
        raise DataError(f"{path}: expected finite poses, got NaN or infinity in frame {finite.argmin()}")
    write_text(path, format_rows(T_world_cam[:, :3].reshape(-1, 12)))


def read_euroc(path: Path | str, *, first_of_repeated: bool = False) -> Trajectory:
    """Read EuRoC or TUM-VI ground truth (csv: timestamp [ns], position, quaternion wxyz, ...): T_world_body.

    Timestamps become float64 seconds since 1970, which resolves 0.24 microseconds. DataError as `read_tum`.
    """
    lines, values = read_numbers(Path(path), _EUROC_COLUMNS, counts=(17, 8), separator=",")
    quaternion_xyzw = values[:, [5, 6, 7, 4]]
    return _stamped(Path(path), lines, values[:, 0] / 1e9, values[:, 1:4], quaternion_xyzw, first_of_repeated)


def write_euroc(path: Path | str, trajectory: Trajectory) -> None:
    """Write the first 8 columns of EuRoC's ground truth, which are all that TUM-VI's has.

    Timestamps in whole ns.

    DataError for poses with NaN, and for timestamps less than a nanosecond apart.
    """
    finite = np.isfinite(trajectory.T).all((1, 2))
    if not finite.all():
        raise DataError(f"{path}: expected finite poses, got NaN or infinity in row {finite.argmin()}")
    ns = [round(t * 1e9) for t in trajectory.t.tolist()]
    if (np.diff(ns) <= 0).any():
        raise DataError(f"{path}: expected timestamps at least 1 ns apart, got closer ones")
    quaternion_wxyz = Rotation.from_matrix(trajectory.T[:, :3, :3]).as_quat(canonical=True, scalar_first=True)
    rows = np.column_stack([trajectory.T[:, :3, 3], quaternion_wxyz]).tolist()
    lines = [",".join(map(repr, [timestamp, *row])) + "\n" for timestamp, row in zip(ns, rows, strict=True)]
    write_text(path, f"#timestamp [ns],{','.join(_EUROC_NAMES)}\n" + "".join(lines))


def orthonormal(T: Float[np.ndarray, "n 4 4"], where: Callable[[int], str]) -> Float[np.ndarray, "n 4 4"]:
    """The poses with rotations orthonormal to the last digit.

    DataError with `where(i)` for the worst, pose i, if it is more than rounding off a rotation.
    """
    rotation = rigid.nearest_rotation(T[:, :3, :3])
    off = np.abs(T[:, :3, :3] - rotation).max(axis=(1, 2))
    if off.max() > _MOST_OFF_ROTATION:
        raise DataError(
            f"{where(int(off.argmax()))}: expected a rotation, got a matrix {off.max():.2g} off one"
        )
    return rigid.make(rotation, T[:, :3, 3])


def associate(
    t_a: Float[np.ndarray, " a"], t_b: Float[np.ndarray, " b"], max_difference: float = 0.01
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Indices into both lists of increasing timestamps that lie at most `max_difference` seconds apart.

    Every timestamp of the shorter list (of `t_b` if equally long) takes the nearest of the longer, the
    earlier of two equally near; one timestamp of the longer may serve two. DataError if none matches.
    """
    if len(t_b) <= len(t_a):
        near_a, near_b = nearest(t_b, t_a), np.arange(len(t_b))
    else:
        near_a, near_b = np.arange(len(t_a)), nearest(t_a, t_b)
    close = np.abs(t_a[near_a] - t_b[near_b]) <= max_difference
    if not close.any():
        spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" if len(t) else "no timestamps" for t in (t_a, t_b)]
        raise DataError(
            f"trajectories: expected timestamps within {max_difference} s, got {' and '.join(spans)}"
        )
    return near_a[close], near_b[close]


def nearest(t: Float[np.ndarray, " n"], among: Float[np.ndarray, " m"]) -> Int[np.ndarray, " n"]:
    """Index of the nearest of the increasing timestamps `among`, the earlier of two equally near."""
    after = np.minimum(np.searchsorted(among, t, side="right"), len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(among[after] - t) < np.abs(t - among[before]), after, before)


def _stamped(
    path: Path,
    lines: list[int],
    t: Float[np.ndarray, " n"],
    translation: Float[np.ndarray, "n 3"],
    quaternion_xyzw: Float[np.ndarray, "n 4"],
    first_of_repeated: bool,
) -> Trajectory:
    """A trajectory from columns, their values checked."""
    for row in np.flatnonzero(np.linalg.norm(quaternion_xyzw, axis=1) < 1e-6):
        raise DataError(f"{path}:{lines[row]}: expected a unit quaternion, got zero")
    if first_of_repeated:
        kept = np.append(True, np.diff(t) != 0)
        lines = [line for line, keep in zip(lines, kept, strict=True) if keep]
        t, translation, quaternion_xyzw = t[kept], translation[kept], quaternion_xyzw[kept]
    for row in np.flatnonzero(np.diff(t) <= 0) + 1:
        raise DataError(f"{path}:{lines[row]}: expected a timestamp after {t[row - 1]!s} s, got {t[row]!s} s")
    return Trajectory(t, rigid.make(Rotation.from_quat(quaternion_xyzw).as_matrix(), translation))


# --- writing --------------------------------------------------------------------------------------------


# --- the run --------------------------------------------------------------------------------------------
