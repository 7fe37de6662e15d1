"""Files of trajectories: TUM, KITTI, EuRoC (and TUM-VI), tables with a header, lists of 4x4 matrices."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_increasing, check_shapes
from jaxpose.errors import DataError
from jaxpose.files.atomic import write_text
from jaxpose.files.columns import joined_clock
from jaxpose.files.layouts import (
    EUROC,
    KNOWN,
    TUM,
    Format,
    Layout,
    first_behind_comment,
    pose_layout,
    unit_quaternions,
)
from jaxpose.files.matrices import read_matrices, where_finite
from jaxpose.files.tables import (
    StampedRows,
    find_separator,
    format_rows,
    left_out_notes,
    read_numbers,
    read_table,
    stamped_rows,
)
from jaxpose.files.timestamps import Unit, format_seconds, origin, whole_ns
from jaxpose.geometry import rigid

_KITTI_COLUMNS = "12 numbers (the rows of a 3x4 pose)"
_EUROC_NAMES = [f"p_RS_R_{axis} [m]" for axis in "xyz"] + [f"q_RS_{axis} []" for axis in "wxyz"]
_CSV_NAMES = "t,tx,ty,tz,qx,qy,qz,qw"


class Trajectory(NamedTuple):
    """Poses with timestamps.

    Attributes:
        t: Timestamps (n,) [s] since `t0_ns`, increasing, float64.
        T: Poses (n, 4, 4), `T_world_cam` or of the body, float64 [m].
        t0_ns: Where `t` is 0 on the file's own clock [ns]; 0 unless `t` would lose digits.
    """

    t: Float[np.ndarray, " n"]
    T: Float[np.ndarray, "n 4 4"]
    t0_ns: int = 0


class TrajectoryFile(NamedTuple):
    """What `read_trajectory` found.

    Attributes:
        trajectory: The poses; without timestamps the pose of line i, from 0, is at i seconds.
        format: The file's format.
        has_timestamps: Whether it has timestamps.
        notes: What was left out, with counts, and what is unusual about the file.
        repeated: How many poses were left out, as their timestamp is that of the pose before.
        missing: How many were left out, as they have NaN, infinity or a zero quaternion.
        count: Lines of poses in the file, those left out among them.
        unit: In which it has timestamps.
        quaternion_xyzw: As the file has them, to the last digit; None for matrices.
        order: Of its quaternions; None for matrices.
    """

    trajectory: Trajectory
    format: Format
    has_timestamps: bool
    notes: tuple[str, ...]
    repeated: int
    missing: int
    count: int
    unit: Unit | None = None
    quaternion_xyzw: Float[np.ndarray, "n 4"] | None = None
    order: Literal["xyzw", "wxyz"] | None = None


def read_trajectory(path: Path | str, columns: str | None = None) -> TrajectoryFile:
    """Read a trajectory file, its format found by its header, its columns, and its timestamps.

    TUM: `t tx ty tz qx qy qz qw`, decimal seconds; EuRoC, TUM-VI, VINS: csv of timestamp [ns], position,
    quaternion wxyz, and more; csv of decimal seconds, position, quaternion xyzw; any table whose header
    names the eight; KITTI: 12 numbers, the rows of a 3x4 pose; 4x4 lists: 16 numbers a line or 4 lines of 4.
    Timestamps of another unit than the format's are found by their size and steps. Of poses with the same
    timestamp the first is kept; poses with NaN, infinity or a quaternion of zeros are left out; both are
    counted.

    Args:
        path: The file.
        columns: What its columns are called, such as `t[ns] tx ty tz qw qx qy qz`, any order, `-` for what
            is not used; by default as its header or its layout says.

    Returns:
        The poses, and what the file is.

    Raises:
        DataError: Naming file and line for what is none of the formats or is damaged, for quaternions that
            are not of unit length, and, with the readings that are possible, for what may be more than one.
    """
    path = Path(path)
    table = joined_clock(read_table(path))
    if not table.lines:
        raise DataError(f"{path}: expected a trajectory, {KNOWN}, got no line of numbers")
    table, notes = first_behind_comment(table)
    layout = pose_layout(path, table, columns)
    if layout.columns is None:
        return _matrices(path, layout.format)
    rows = stamped_rows(
        path, table, layout.words, layout.columns, unit=layout.unit, exact=layout.unit_is_stated
    )
    if rows.unit == layout.refused_unit:
        raise DataError(
            f"{path}: expected timestamps in {layout.unit}, as csv of {len(table.words(0))} columns "
            f"without a header is EuRoC's or VINS', got {rows.unit}: say what they hold, --columns"
        )
    trajectory, quaternion_xyzw, rows = _poses(path, rows, layout)
    notes += left_out_notes(path, rows)
    if rows.unit != layout.unit:
        notes += (f"{path.name}: timestamps are in {rows.unit}, by their size and steps",)
    if layout.metres != 1:
        notes += (f"{path.name}: positions are in units of {layout.metres:g} m, by the header",)
    return TrajectoryFile(
        trajectory,
        layout.format,
        True,
        notes,
        len(rows.repeated),
        len(rows.missing),
        len(table.lines),
        rows.unit,
        quaternion_xyzw,
        layout.order,
    )


def read_tum(path: Path | str) -> Trajectory:
    """Read a whole TUM trajectory: lines of `t tx ty tz qx qy qz qw`, decimal seconds, `#` comments.

    Args:
        path: The file; `read_trajectory` reads what has gaps or other units.

    Returns:
        Timestamps and poses.

    Raises:
        DataError: Naming file and line for a wrong number of columns, text or NaN where a number belongs, a
            quaternion that is not of unit length, or timestamps that repeat or go backwards.
    """
    return _whole(Path(path), TUM, (8,), None)


def read_euroc(path: Path | str) -> Trajectory:
    """Read EuRoC's or TUM-VI's whole ground truth: csv of timestamp [ns], position, quaternion wxyz, and
    more.

    Args:
        path: The file; `read_trajectory` reads what has gaps or other units.

    Returns:
        Timestamps, and poses `T_world_body`.

    Raises:
        DataError: As `read_tum`.
    """
    return _whole(Path(path), EUROC, (17, 8), ",")


def since(trajectory: Trajectory, t0_ns: int) -> Float[np.ndarray, " n"]:
    """The timestamps of a trajectory as seconds since another time on its clock.

    Args:
        trajectory: Poses with timestamps.
        t0_ns: Where time is to be 0 [ns].

    Returns:
        Timestamps (n,) [s], which hold whole ns where they are below 1e6.
    """
    if t0_ns == trajectory.t0_ns:
        return trajectory.t
    return np.array([ns / 10**9 for ns in whole_ns(trajectory.t, trajectory.t0_ns - t0_ns)])


def write_tum(
    path: Path | str, trajectory: Trajectory, quaternion_xyzw: Float[np.ndarray, "n 4"] | None = None
) -> None:
    """Write a TUM trajectory that reads back to the last bit (rotations to rounding).

    Args:
        path: The file, written whole or not at all.
        trajectory: Poses; those with NaN, such as ground truth that is missing, are left out.
        quaternion_xyzw: Of the same rotations, as another file had them; by default made from them.

    Raises:
        ValueError: For arrays of other shapes, and for timestamps that do not increase.
    """
    _write_seconds(Path(path), trajectory, quaternion_xyzw, " ", "# timestamp tx ty tz qx qy qz qw\n")


def write_csv(
    path: Path | str, trajectory: Trajectory, quaternion_xyzw: Float[np.ndarray, "n 4"] | None = None
) -> None:
    """Write csv of decimal seconds, position and quaternion xyzw under a header, as `t,tx,ty,tz,qx,qy,qz,qw`.

    Args:
        path: As `write_tum`.
        trajectory: As `write_tum`.
        quaternion_xyzw: As `write_tum`.

    Raises:
        ValueError: As `write_tum`.
    """
    _write_seconds(Path(path), trajectory, quaternion_xyzw, ",", f"#{_CSV_NAMES}\n")


def read_kitti(path: Path | str, *, rate_hz: float = 10.0) -> Trajectory:
    """Read a KITTI trajectory: per line the 12 numbers of a 3x4 pose, row by row.

    Args:
        path: The file.
        rate_hz: Frames a second, as the format has no timestamps: frame i is at i / rate_hz seconds.

    Returns:
        Timestamps from 0, and poses with rotations made orthonormal; NaN where the file has NaN or infinity.

    Raises:
        DataError: As `read_tum`, and for a matrix that is more than rounding off a rotation.
        ValueError: For a rate that is not positive.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
    path = Path(path)
    separator = find_separator(path)
    lines, values = read_numbers(path, _KITTI_COLUMNS, counts=(12,), separator=separator, finite=False)
    rows = values.reshape(-1, 3, 4)
    T = where_finite(rigid.make(rows[..., :3], rows[..., 3]), lambda i: f"{path}:{lines[i]}")
    return Trajectory(np.arange(len(T)) / rate_hz, T)


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


def write_euroc(
    path: Path | str, trajectory: Trajectory, quaternion_xyzw: Float[np.ndarray, "n 4"] | None = None
) -> None:
    """Write the first 8 columns of EuRoC's ground truth, which are all that TUM-VI's has.

    Args:
        path: The file, written whole or not at all.
        trajectory: Poses; timestamps are written in whole ns.
        quaternion_xyzw: Of the same rotations, as another file had them; by default made from them.

    Raises:
        DataError: For poses with NaN, and for timestamps less than a nanosecond apart.
        ValueError: For arrays of other shapes, and for timestamps that do not increase.
    """
    _check(trajectory)
    finite = np.isfinite(trajectory.T).all((1, 2))
    if not finite.all():
        raise DataError(f"{path}: expected finite poses, got NaN or infinity in row {finite.argmin()}")
    ns = whole_ns(trajectory.t, trajectory.t0_ns)
    if (np.diff(ns) <= 0).any():
        raise DataError(f"{path}: expected timestamps at least 1 ns apart, got closer ones")
    quaternion_wxyz = _quaternions(trajectory, quaternion_xyzw)[:, [3, 0, 1, 2]]
    rows = np.column_stack([trajectory.T[:, :3, 3], quaternion_wxyz]).tolist()
    lines = [",".join(map(repr, [timestamp, *row])) + "\n" for timestamp, row in zip(ns, rows, strict=True)]
    write_text(path, f"#timestamp [ns],{','.join(_EUROC_NAMES)}\n" + "".join(lines))


def read_timestamps(path: Path | str) -> list[int]:
    """Read the timestamps that begin the lines of a file: a trajectory, an IMU, a list of images.

    Args:
        path: The file; its columns are separated by commas or blanks.

    Returns:
        Timestamps [ns], increasing; the unit in which the file has them is found by their size and steps.

    Raises:
        DataError: Naming file and line for text, and for timestamps that repeat or go backwards.
    """
    path = Path(path)
    table, wanted = read_table(path), "a line that begins with a timestamp"
    rows = stamped_rows(path, table._replace(rows=table.column(0)), wanted, (0,), unit="s")
    if rows.repeated or rows.missing:
        line = min(rows.repeated or rows.missing)
        got = "a repeated one" if rows.repeated else "NaN"
        raise DataError(f"{path}:{line}: expected a timestamp after that before, got {got}")
    return rows.ns


def _whole(path: Path, layout: Layout, counts: tuple[int, ...], separator: str | None) -> Trajectory:
    """A trajectory in a stated format, without gaps."""
    assert layout.columns is not None
    table = read_table(path)
    if table.lines and (len(table.words(0)) not in counts or table.separator != separator):
        got = len(table.words(0)) if table.separator == separator else repr(" ".join(table.words(0))[:60])
        raise DataError(f"{path}:{table.lines[0]}: expected {layout.words}, got {got}")
    rows = stamped_rows(path, table, layout.words, layout.columns, unit=layout.unit, exact=True)
    trajectory, _, rows = _poses(path, rows, layout)
    for line in sorted((*rows.missing, *rows.repeated))[:1]:
        got = "a repeated one" if line in rows.repeated else "NaN, infinity or a zero quaternion"
        wanted = "a timestamp after that before" if line in rows.repeated else "finite numbers"
        raise DataError(f"{path}:{line}: expected {wanted}, got {got}")
    return trajectory


def _poses(
    path: Path, rows: StampedRows, layout: Layout
) -> tuple[Trajectory, Float[np.ndarray, "n 4"], StampedRows]:
    """The poses, the quaternions xyzw as written, and the rows without those whose quaternion is zero."""
    norm = unit_quaternions(path, rows.lines, rows.values, layout.order)
    there = norm > 0.5
    if not there.any():
        raise DataError(f"{path}:{rows.lines[0]}: expected a unit quaternion, got zero")
    if not there.all():
        kept = np.flatnonzero(there)
        zero = tuple(rows.lines[i] for i in np.flatnonzero(~there))
        rows = rows._replace(
            lines=[rows.lines[i] for i in kept],
            ns=[rows.ns[i] for i in kept],
            values=rows.values[kept],
            missing=tuple(sorted((*rows.missing, *zero))),
            stamps=rows.stamps.rows(kept),
        )
    t0_ns, xyzw = origin(rows.ns), rows.values[:, 3:]
    t = rows.stamps.since(t0_ns, rows.unit)
    T = rigid.make(Rotation.from_quat(xyzw).as_matrix(), layout.metres * rows.values[:, :3])
    return Trajectory(t, T, t0_ns), xyzw, rows


def _matrices(path: Path, form: Format) -> TrajectoryFile:
    """A list of poses without timestamps; those with NaN are left out, and the others keep their numbers."""
    T = read_kitti(path).T if form == "KITTI" else read_matrices(path)
    there = np.isfinite(T).all((1, 2))
    if not there.any():
        raise DataError(f"{path}: expected finite poses, got NaN or infinity in all {len(T)}")
    missing = len(T) - int(there.sum())
    notes = (f"{path.name}: poses left out: {missing} with NaN or infinity",) if missing else ()
    t = np.flatnonzero(there).astype(np.float64)
    return TrajectoryFile(Trajectory(t, T[there]), form, False, notes, 0, missing, len(T))


def _write_seconds(
    path: Path,
    trajectory: Trajectory,
    quaternion_xyzw: Float[np.ndarray, "n 4"] | None,
    separator: str,
    header: str,
) -> None:
    _check(trajectory)
    xyzw = _quaternions(trajectory, quaternion_xyzw)
    finite = np.flatnonzero(np.isfinite(trajectory.T).all((1, 2)))
    times = format_seconds(trajectory.t[finite], trajectory.t0_ns)
    rows = format_rows(np.hstack([trajectory.T[finite, :3, 3], xyzw[finite]])).splitlines()
    lines = [separator.join([t, *row.split()]) + "\n" for t, row in zip(times, rows, strict=True)]
    write_text(path, header + "".join(lines))


def _quaternions(
    trajectory: Trajectory, quaternion_xyzw: Float[np.ndarray, "n 4"] | None
) -> Float[np.ndarray, "n 4"]:
    """Those given, else those of the rotations, NaN where there is none."""
    if quaternion_xyzw is not None:
        check_shapes(t=(trajectory.t, "n"), quaternion_xyzw=(quaternion_xyzw, "n 4"))
        return quaternion_xyzw
    finite = np.flatnonzero(np.isfinite(trajectory.T).all((1, 2)))
    xyzw = np.full((len(trajectory.T), 4), np.nan)
    if len(finite):
        R = np.asarray(trajectory.T[finite, :3, :3], np.float64)
        xyzw[finite] = Rotation.from_matrix(R).as_quat(canonical=True)
    return xyzw


def _check(trajectory: Trajectory) -> None:
    check_shapes(t=(trajectory.t, "n"), T=(trajectory.T, "n 4 4"))
    check_increasing(t=trajectory.t)
