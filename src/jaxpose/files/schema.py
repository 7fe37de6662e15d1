"""What was read from files of others: whether it is what it should be, entry by entry.

Each check raises a `DataError` of one line, `path: entry: expected ..., got ...`.
"""

import math
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError

FARTHEST_M = 1e9  # [m] of a position; a float64 has less than a micrometre there
LATEST_S = 7_258_118_400.0  # [s] since 1970: the year 2200, of timestamps
_MOST_OFF_ROTATION = 1e-3  # entries of a rotation matrix


def numbers(
    path: Path | str,
    content: Any,
    key: str,
    shape: Sequence[int | None] = (),
    *,
    least: int | float = -math.inf,
    most: int | float = math.inf,
    above: int | float = -math.inf,
    whole: bool = False,
) -> np.ndarray:
    """The numbers of an entry, finite and in their range.

    Args:
        path: the file it is of.
        content: what was read, a mapping of lists, numbers or arrays.
        key: of the entry.
        shape: sizes of its axes, None for any; () for a single number.
        least: they are at least this,
        most: and at most this,
        above: and above this.
        whole: whether they are whole numbers.

    Returns:
        An array of float64, or int64 if whole.

    Raises:
        DataError: `path: key: expected ..., got ...`.
    """
    where, wanted = f"{path}: {key}", _wanted(shape, least, most, above, whole)
    if not isinstance(content, Mapping) or key not in content:
        raise DataError(f"{where}: expected {wanted}, got no such entry")
    value = content[key]
    if not isinstance(value, np.ndarray):
        value = _from_lists(value, len(shape))
    if value is None or value.dtype.kind not in "iuf" or value.ndim != len(shape):
        got = value.dtype if value is not None else reprlib.repr(content[key])
        raise DataError(f"{where}: expected {wanted}, got {got}")
    if any(size not in (None, found) for size, found in zip(shape, value.shape, strict=True)):
        raise DataError(f"{where}: expected {wanted}, got shape {value.shape}")
    good = np.isfinite(value) & (value >= least) & (value <= most) & (value > above)
    if whole:
        good &= (np.abs(value) < 2**53) & (value == np.floor(value))
    if not good.all():
        raise DataError(f"{where}: expected {wanted}, got {value[~good].flat[0]:g}")
    return value.astype(np.int64 if whole else np.float64)


def choice(path: Path | str, content: Any, key: str, among: Sequence[str] | None = None) -> str:
    """The text of an entry.

    Args:
        path: the file it is of.
        content: what was read, a mapping.
        key: of the entry.
        among: the texts it may be; None: any.

    Returns:
        The text.

    Raises:
        DataError: `path: key: expected ..., got ...`.
    """
    value = content.get(key) if isinstance(content, Mapping) else None
    if isinstance(value, np.ndarray) and value.dtype.kind == "U" and value.ndim == 0:
        value = str(value)
    if not isinstance(value, str) or not (among is None or value in among):
        wanted = "a text" if among is None else f"one of {', '.join(among)}"
        got = "no such entry" if value is None else reprlib.repr(value)
        raise DataError(f"{path}: {key}: expected {wanted}, got {got}")
    return value


def check_version(path: Path | str, content: Mapping[str, Any], version: int, what: str) -> None:
    """Refuse a file that another version wrote.

    Args:
        path: the file.
        content: what was read, with its `version`; none: what has no version.
        version: that which is read.
        what: the file is, "a map".

    Raises:
        DataError: `path: expected ... of version ..., got ...`.
    """
    found = np.asarray(content.get("version", "none"))
    if not np.array_equal(found, version):
        got = str(found) if found.ndim == 0 else f"an array of shape {found.shape}"
        raise DataError(f"{path}: expected {what} of version {version}, got {got:.40}")


def increasing(path: Path | str, key: str, t: Float[np.ndarray, " n"]) -> None:
    """Refuse times that do not increase.

    Args:
        path: the file they are of.
        key: of the entry.
        t: (n,) [s].

    Raises:
        DataError: naming the first that does not.
    """
    for row in np.flatnonzero(np.diff(t) <= 0) + 1:
        raise DataError(f"{path}: {key}: expected a time after {t[row - 1]!s}, got {t[row]!s}")


def rigid_transforms(path: Path | str, key: str, T: Float[np.ndarray, "n 4 4"]) -> None:
    """Refuse what are no rigid transforms, or lead too far.

    Args:
        path: the file they are of.
        key: of the entry.
        T: (n, 4, 4), finite.

    Raises:
        DataError: naming the first that is none.
    """
    R = T[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max((1, 2))
        off = np.maximum(off, np.abs(T[:, 3] - [0, 0, 0, 1]).max(1))
        good = (off <= _MOST_OFF_ROTATION) & (np.linalg.det(np.where(off[:, None, None] < 1, R, 0)) > 0)
    for row in np.flatnonzero(~good):
        raise DataError(
            f"{path}: {key}: expected rigid transforms, got {T[row].round(4).tolist()} in row {row}"
        )
    for row in np.flatnonzero(np.abs(T[:, :3, 3]).max(1, initial=0) > FARTHEST_M):
        raise DataError(
            f"{path}: {key}: expected positions up to {FARTHEST_M:g} m, got {T[row, :3, 3]} in row {row}"
        )


_LONGEST_NAME = 255  # bytes, in any file system


def may_exist(name: str) -> bool:
    """Whether a file system can hold a path of this name; of a longer one it says so as of a fault."""
    return len(name) <= _LONGEST_NAME // 4 or _longest(name) <= _LONGEST_NAME


def _longest(name: str) -> int:
    """Bytes of the longest part of a path."""
    return max(len(part.encode("utf-8", "surrogatepass")) for part in name.split("/"))


def name_inside(path: Path | str, name: str) -> str:
    """A file name that leads nowhere but into the folder it is of.

    Args:
        path: the file that says it, for errors.
        name: relative to a folder.

    Returns:
        The name.

    Raises:
        DataError: for an absolute one, one with `..` in it, and one that no file system holds.
    """
    leads_up = ".." in name and ".." in name.replace("\\", "/").split("/")
    if not name or "\0" in name or name.startswith(("/", "\\")) or leads_up:
        raise DataError(f"{path}: expected a file name that stays in its folder, got {name!r:.60}")
    if not may_exist(name):
        raise DataError(f"{path}: expected file names of up to {_LONGEST_NAME} bytes, got {_longest(name)}")
    return name


def _from_lists(value: Any, axes: int) -> np.ndarray | None:
    """An array of so many axes from nested lists of numbers; None for anything else."""
    rows = [value]
    for _ in range(axes):
        if not all(isinstance(row, list | tuple) for row in rows):
            return None
        rows = [entry for row in rows for entry in row]
    if not all(type(entry) in (int, float) for entry in rows):
        return None
    try:
        return np.array(value, np.float64)
    except (ValueError, OverflowError):
        return None


def _wanted(
    shape: Sequence[int | None], least: int | float, most: int | float, above: int | float, whole: bool
) -> str:
    words = ["a" if not shape else "x".join("n" if size is None else str(size) for size in shape)]
    words.append(("whole" if whole else "finite") + (" number" if not shape else " numbers"))
    if above > -math.inf:
        words.append(f"above {above:g}")
    if least > -math.inf:
        words.append(f"from {least:g}" if most < math.inf else f"of at least {least:g}")
    if most < math.inf:
        words.append(f"to {most:g}" if least > -math.inf else f"up to {most:g}")
    return " ".join(words)
