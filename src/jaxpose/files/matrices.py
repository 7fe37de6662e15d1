"""Poses as matrices: lists of them, and rotations made orthonormal."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files.schema import FARTHEST_M
from jaxpose.files.tables import read_numbers, read_table
from jaxpose.geometry import rigid

_MOST_OFF_ROTATION = 1e-2  # entries of a rotation matrix; more is not rounding


def orthonormal(T: Float[np.ndarray, "n 4 4"], where: Callable[[int], str]) -> Float[np.ndarray, "n 4 4"]:
    """Poses with rotations orthonormal to the last digit.

    Args:
        T: Poses (n, 4, 4) of which the rotations may be off by rounding, up to 0.01.
        where: Names the source of pose i in an error.

    Returns:
        Poses (n, 4, 4).

    Raises:
        DataError: With `where(i)` for the worst, pose i, if it is more than rounding off a rotation or
            farther than 1e9 m away.
    """
    away = np.abs(T[:, :3, 3]).max(axis=1)
    if away.max() > FARTHEST_M:
        i = int(away.argmax())
        raise DataError(f"{where(i)}: expected a position up to {FARTHEST_M:g} m, got {T[i, :3, 3]}")
    rotation = rigid.nearest_rotation(T[:, :3, :3])
    off = np.abs(T[:, :3, :3] - rotation).max(axis=(1, 2))
    if off.max() > _MOST_OFF_ROTATION:
        raise DataError(
            f"{where(int(off.argmax()))}: expected a rotation, got a matrix {off.max():.2g} off one"
        )
    return rigid.make(rotation, T[:, :3, 3])


def read_matrices(path: Path) -> Float[np.ndarray, "n 4 4"]:
    """Read poses as whole 4x4 matrices, one in each line or in each four.

    Args:
        path: The file.

    Returns:
        Poses, NaN where any number is not finite.

    Raises:
        DataError: Naming file and line for what is no such list.
    """
    table = read_table(path)
    columns = len(table.words(0))
    wanted = f"{columns} numbers of 4x4 poses"
    lines, values = read_numbers(path, wanted, counts=(columns,), separator=table.separator, finite=False)
    if values.size % 16:
        raise DataError(f"{path}: expected four lines for each pose, got {len(values)} lines")
    T = values.reshape(-1, 4, 4)
    first_lines = lines[:: len(lines) // len(T)]
    off = np.nan_to_num(np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1), nan=0.0, posinf=0.0)
    if off.max() > 1e-6:
        found = " ".join(f"{number:g}" for number in T[off.argmax(), 3])
        raise DataError(
            f"{path}:{first_lines[off.argmax()]}: expected a last row 0 0 0 1 of the pose, got {found}"
        )
    return where_finite(T, lambda i: f"{path}:{first_lines[i]}")


def where_finite(T: Float[np.ndarray, "n 4 4"], where: Callable[[int], str]) -> Float[np.ndarray, "n 4 4"]:
    """Poses made orthonormal, as by `orthonormal`, where they are finite.

    Args:
        T: Poses (n, 4, 4).
        where: Names the source of pose i in an error.

    Returns:
        Poses (n, 4, 4), all NaN where any number is not finite.
    """
    finite = np.flatnonzero(np.isfinite(T).all((1, 2)))
    poses = np.full(T.shape, np.nan)
    if len(finite):
        poses[finite] = orthonormal(T[finite], lambda i: where(int(finite[i])))
    return poses
