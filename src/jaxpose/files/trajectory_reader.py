"""Trajectory files of any kind, their format found by what is in them; timestamps alone; 4x4 lists."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files import tables, trajectories
from jaxpose.files.trajectories import Trajectory

Format = Literal["TUM", "KITTI", "EuRoC", "4x4 list"]
_KNOWN = (
    "TUM (8 numbers a line), KITTI (12), EuRoC or TUM-VI (commas, 8 or 17), or 4x4 matrices (16, or 4 x 4)"
)
_NANOSECONDS = 1e14  # a timestamp beyond it is in ns: as seconds it would be three million years off


class Found(NamedTuple):
    """A trajectory and the format it was in; without timestamps pose i is at i seconds."""

    trajectory: Trajectory
    format: Format
    stamped: bool
    repeated: int  # poses left out, as their timestamp is that of the pose before


def read_trajectory(path: Path | str) -> Found:
    """Read a trajectory file, its format found by the separator and the number of columns of its first line.

    TUM: `t tx ty tz qx qy qz qw`; EuRoC and TUM-VI: csv of timestamp [ns], position, quaternion wxyz; KITTI:
    12 numbers, the rows of a 3x4 pose; 4x4 lists: 16 numbers a line or 4 lines of 4. Of poses with the same
    timestamp the first is kept. DataError naming file and line for what is none of them or is damaged.
    """
    path = Path(path)
    content = _lines(path)
    if not content:
        raise DataError(f"{path}: expected a trajectory, {_KNOWN}, got no line of numbers")
    number, line = content[0]
    if "," in line:
        trajectory = trajectories.read_euroc(path, first_of_repeated=True)
        return Found(trajectory, "EuRoC", True, len(content) - len(trajectory.t))
    columns = len(line.split())
    if columns == 8:
        trajectory = trajectories.read_tum(path, first_of_repeated=True)
        return Found(trajectory, "TUM", True, len(content) - len(trajectory.t))
    if columns == 12:
        return Found(trajectories.read_kitti(path, rate_hz=1.0), "KITTI", False, 0)
    if columns in (4, 16):
        return Found(_read_matrices(path, columns), "4x4 list", False, 0)
    raise DataError(f"{path}:{number}: expected a trajectory, {_KNOWN}, got {line[:60]!r}")


def read_stamps(path: Path | str) -> Float[np.ndarray, " n"]:
    """The timestamps [s] of a file with one at the start of each line: a trajectory, an IMU.

    A list of images.

    Columns are separated by commas or blanks; timestamps above 1e14 are nanoseconds. DataError naming file
    and line for text, and for timestamps that repeat or go backwards.
    """
    path, lines, timestamps = Path(path), [], []
    for number, line in _lines(path):
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
    for row in np.flatnonzero(np.diff(t) <= 0) + 1:
        raise DataError(f"{path}:{lines[row]}: expected a timestamp after {t[row - 1]!s} s, got {t[row]!s} s")
    return t


def _read_matrices(path: Path, columns: int) -> Trajectory:
    """Poses as whole 4x4 matrices, one in each line or in each four."""
    lines, values = tables.read_numbers(path, f"{columns} numbers of 4x4 poses", counts=(columns,))
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
    return Trajectory(
        np.arange(float(len(T))), trajectories.orthonormal(T, lambda i: f"{path}:{first_lines[i]}")
    )


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines with something on them, and their numbers."""
    text = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return [(k, line) for k, line in enumerate(text, 1) if line.strip() and not line.lstrip().startswith("#")]
