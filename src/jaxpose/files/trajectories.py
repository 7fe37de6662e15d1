"""Files of trajectories: TUM, KITTI, EuRoC (and TUM-VI), lists of 4x4 matrices; and pairs of timestamps."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_increasing, check_shapes
from jaxpose.errors import DataError
from jaxpose.files.atomic import write_text
from jaxpose.files.tables import format_rows, numbered_lines, read_numbers
from jaxpose.geometry import rigid

Format = Literal["TUM", "KITTI", "EuRoC", "4x4 list"]
_KNOWN = (
    "TUM (8 numbers a line), KITTI (12), EuRoC or TUM-VI (commas, 8 or 17), or 4x4 matrices (16, or 4 x 4)"
)
_TUM_COLUMNS = "8 numbers (t tx ty tz qx qy qz qw)"
_KITTI_COLUMNS = "12 numbers (the rows of a 3x4 pose)"
_EUROC_COLUMNS = "17 numbers (timestamp, position, quaternion wxyz, velocity, biases) or the first 8 of them"
_EUROC_NAMES = [f"p_RS_R_{axis} [m]" for axis in "xyz"] + [f"q_RS_{axis} []" for axis in "wxyz"]
_MOST_OFF_ROTATION = 1e-2  # entries of a rotation matrix; more is not rounding
_NANOSECONDS = 1e14  # a timestamp beyond it is in ns: as seconds it would be three million years off


class Trajectory(NamedTuple):
    """Poses with timestamps.

    Attributes:
        t: Timestamps (n,) [s], increasing, float64.
        T: Poses (n, 4, 4), `T_world_cam` or of the body, float64 [m].
    """

    t: Float[np.ndarray, " n"]
    T: Float[np.ndarray, "n 4 4"]


class TrajectoryFile(NamedTuple):
    """What `read_trajectory` found.

    Attributes:
        trajectory: The poses; without timestamps pose i is at i seconds.
        format: The file's format.
        has_timestamps: Whether it has timestamps.
        repeated: How many poses were left out, as their timestamp is that of the pose before.
    """

    trajectory: Trajectory
    format: Format
    has_timestamps: bool
    repeated: int


def read_trajectory(path: Path | str) -> TrajectoryFile:
    """Read a trajectory file, its format found by the separator and the number of columns of its first line.

    TUM: `t tx ty tz qx qy qz qw`; EuRoC and TUM-VI: csv of timestamp [ns], position, quaternion wxyz; KITTI:
    12 numbers, the rows of a 3x4 pose; 4x4 lists: 16 numbers a line or 4 lines of 4. Of poses with the same
    timestamp the first is kept.

    Args:
        path: The file.

    Returns:
        The poses, and what the file is.

    Raises:
        DataError: Naming file and line for what is none of the formats or is damaged.
    """
    path = Path(path)
    content = numbered_lines(path)
    if not content:
        raise DataError(f"{path}: expected a trajectory, {_KNOWN}, got no line of numbers")
    number, line = content[0]
    if "," in line:
        trajectory = read_euroc(path, first_of_repeated=True)
        return TrajectoryFile(trajectory, "EuRoC", True, len(content) - len(trajectory.t))
    columns = len(line.split())
    if columns == 8:
        trajectory = read_tum(path, first_of_repeated=True)
        return TrajectoryFile(trajectory, "TUM", True, len(content) - len(trajectory.t))
    if columns == 12:
        return TrajectoryFile(read_kitti(path, rate_hz=1.0), "KITTI", False, 0)
    if columns in (4, 16):
        return TrajectoryFile(_read_matrices(path, columns), "4x4 list", False, 0)
    raise DataError(f"{path}:{number}: expected a trajectory, {_KNOWN}, got {line[:60]!r}")


def read_tum(path: Path | str, *, first_of_repeated: bool = False) -> Trajectory:
    """Read a TUM trajectory: lines of `t tx ty tz qx qy qz qw`, `#` comments; quaternions are normalised.

    Args:
        path: The file.
        first_of_repeated: Keep the first of poses with the same timestamp, which real ground truth has.

    Returns:
        Timestamps on the file's own clock, and poses.

    Raises:
        DataError: Naming file and line for a wrong number of columns, text or NaN where a number belongs, a
            zero quaternion, or timestamps that repeat or go backwards.
    """
    lines, values = read_numbers(Path(path), _TUM_COLUMNS, counts=(8,))
    return _with_timestamps(Path(path), lines, values[:, 0], values[:, 1:4], values[:, 4:], first_of_repeated)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM trajectory that reads back to the last bit (rotations to rounding).

    Args:
        path: The file, written whole or not at all.
        trajectory: Poses; those with NaN, such as ground truth that is missing, are left out.

    Raises:
        ValueError: For arrays of other shapes, and for timestamps that do not increase.
    """
    _check(trajectory)
    finite = np.isfinite(trajectory.T).all((1, 2))
    T = np.asarray(trajectory.T[finite], np.float64)
    quaternion_xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([trajectory.t[finite], T[:, :3, 3], quaternion_xyzw])
    write_text(path, "# timestamp tx ty tz qx qy qz qw\n" + format_rows(rows))


def read_kitti(path: Path | str, *, rate_hz: float = 10.0) -> Trajectory:
    """Read a KITTI trajectory: per line the 12 numbers of a 3x4 pose, row by row.

    Args:
        path: The file.
        rate_hz: Frames a second, as the format has no timestamps: frame i is at i / rate_hz seconds.

    Returns:
        Timestamps from 0, and poses with rotations made orthonormal.

    Raises:
        DataError: As `read_tum`, and for a matrix that is more than rounding off a rotation.
        ValueError: For a rate that is not positive.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
    path = Path(path)
    lines, values = read_numbers(path, _KITTI_COLUMNS, counts=(12,))
    rows = values.reshape(-1, 3, 4)
    T = rigid.make(rows[..., :3], rows[..., 3])
    return Trajectory(np.arange(len(T)) / rate_hz, orthonormal(T, lambda i: f"{path}:{lines[i]}"))


def write_kitti(path: Path | str, T_world_cam: Float[np.ndarray, "n 4 4"]) -> None:
    """Write poses as KITTI does.

    Args:
        path: The file, written whole or not at all.
        T_world_cam: Poses (n, 4, 4).

    Raises:
        DataError: For NaN, which cannot be left out as lines count the frames.
        ValueError: For an array of another shape.
    """
    check_shapes(T_world_cam=(T_world_cam, "n 4 4"))
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.all():
        raise DataError(f"{path}: expected finite poses, got NaN or infinity in frame {finite.argmin()}")
    write_text(path, format_rows(T_world_cam[:, :3].reshape(-1, 12)))


def read_euroc(path: Path | str, *, first_of_repeated: bool = False) -> Trajectory:
    """Read EuRoC's or TUM-VI's ground truth: csv of timestamp [ns], position, quaternion wxyz, and more.

    Args:
        path: The file.
        first_of_repeated: Keep the first of poses with the same timestamp.

    Returns:
        `T_world_body` at seconds since 1970, which float64 resolves to 0.24 microseconds.

    Raises:
        DataError: As `read_tum`.
    """
    lines, values = read_numbers(Path(path), _EUROC_COLUMNS, counts=(17, 8), separator=",")
    t, quaternion_xyzw = values[:, 0] / 1e9, values[:, [5, 6, 7, 4]]
    return _with_timestamps(Path(path), lines, t, values[:, 1:4], quaternion_xyzw, first_of_repeated)


def write_euroc(path: Path | str, trajectory: Trajectory) -> None:
    """Write the first 8 columns of EuRoC's ground truth, which are all that TUM-VI's has.

    Args:
        path: The file, written whole or not at all.
        trajectory: Poses; timestamps are written in whole ns.

    Raises:
        DataError: For poses with NaN, and for timestamps less than a nanosecond apart.
        ValueError: For arrays of other shapes, and for timestamps that do not increase.
    """
    _check(trajectory)
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


def read_timestamps(path: Path | str) -> Float[np.ndarray, " n"]:
    """Read the timestamps that begin the lines of a file: a trajectory, an IMU, a list of images.

    Args:
        path: The file; its columns are separated by commas or blanks.

    Returns:
        Timestamps [s], increasing; those above 1e14 in the file are taken as nanoseconds.

    Raises:
        DataError: Naming file and line for text, and for timestamps that repeat or go backwards.
    """
    path, lines, timestamps = Path(path), [], []
    for number, line in numbered_lines(path):
        try:
            timestamp = float(line.replace(",", " ").split()[0])
        except (ValueError, IndexError):
            timestamp = np.nan
        if not np.isfinite(timestamp):
            raise DataError(
                f"{path}:{number}: expected a line that begins with a timestamp, got {line[:60]!r}"
            )
        lines.append(number)
        timestamps.append(timestamp)
    if not timestamps:
        raise DataError(f"{path}: expected lines that begin with a timestamp, got none")
    t = np.array(timestamps)
    t = t / 1e9 if np.abs(t).max() > _NANOSECONDS else t
    _check_after(path, lines, t)
    return t


def orthonormal(T: Float[np.ndarray, "n 4 4"], where: Callable[[int], str]) -> Float[np.ndarray, "n 4 4"]:
    """Poses with rotations orthonormal to the last digit.

    Args:
        T: Poses (n, 4, 4) of which the rotations may be off by rounding, up to 0.01.
        where: Names the source of pose i in an error.

    Returns:
        Poses (n, 4, 4).

    Raises:
        DataError: With `where(i)` for the worst, pose i, if it is more than rounding off a rotation.
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
    """Pair timestamps of two lists by nearness.

    Every timestamp of the shorter list (of `t_b` if equally long) takes the nearest of the longer, the
    earlier of two equally near; one timestamp of the longer may serve two.

    Args:
        t_a: Timestamps (a,) [s], increasing.
        t_b: Timestamps (b,) [s], increasing.
        max_difference: Pairs farther apart [s] are left out.

    Returns:
        Indices into both lists, (m,) each.

    Raises:
        DataError: If no pair is near enough.
        ValueError: For timestamps that do not increase.

    >>> [rows.tolist() for rows in associate(np.array([0.0, 1.0, 2.0]), np.array([1.004, 5.0]))]
    [[1], [0]]
    """
    check_increasing(t_a=t_a, t_b=t_b)
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
    """Find the nearest timestamp.

    Args:
        t: Times (n,) [s].
        among: Timestamps (m,) [s], increasing.

    Returns:
        Indices (n,) into `among`, of the earlier of two equally near.

    >>> nearest(np.array([0.4, 0.6, 9.0]), np.array([0.0, 1.0, 2.0])).tolist()
    [0, 1, 2]
    """
    after = np.minimum(np.searchsorted(among, t, side="right"), len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(among[after] - t) < np.abs(t - among[before]), after, before)


def _check_after(path: Path, lines: list[int], t: Float[np.ndarray, " n"]) -> None:
    """DataError naming file and line for the first timestamp [s] that is not after the one before."""
    for row in np.flatnonzero(np.diff(t) <= 0) + 1:
        raise DataError(f"{path}:{lines[row]}: expected a timestamp after {t[row - 1]!s} s, got {t[row]!s} s")


def _read_matrices(path: Path, columns: int) -> Trajectory:
    """Poses as whole 4x4 matrices, one in each line or in each four."""
    lines, values = read_numbers(path, f"{columns} numbers of 4x4 poses", counts=(columns,))
    if values.size % 16:
        raise DataError(f"{path}: expected four lines for each pose, got {len(values)} lines")
    T = values.reshape(-1, 4, 4)
    first_lines = lines[:: len(lines) // len(T)]
    off = np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1)
    if off.max() > 1e-6:
        found = " ".join(f"{number:g}" for number in T[off.argmax(), 3])
        raise DataError(
            f"{path}:{first_lines[off.argmax()]}: expected a last row 0 0 0 1 of the pose, got {found}"
        )
    return Trajectory(np.arange(float(len(T))), orthonormal(T, lambda i: f"{path}:{first_lines[i]}"))


def _with_timestamps(
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
    _check_after(path, lines, t)
    return Trajectory(t, rigid.make(Rotation.from_quat(quaternion_xyzw).as_matrix(), translation))


def _check(trajectory: Trajectory) -> None:
    check_shapes(t=(trajectory.t, "n"), T=(trajectory.T, "n 4 4"))
    check_increasing(t=trajectory.t)
