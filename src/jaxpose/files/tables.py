"""Text tables: the one parser of lines of numbers, timestamps and file names.

Empty lines and those that begin with # are left out. Timestamps become whole nanoseconds: seconds since 1970
in ns need 61 bits, of which a float has 53; `seconds` takes the origin off before it makes them floats.
"""

import math
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError

Unit = Literal["s", "ns"]


class StampedRows(NamedTuple):
    """Rows that begin with a timestamp."""

    lines: list[int]  # number of each row's line, from 1
    ns: list[int]  # increasing, on the file's own clock
    values: Float[np.ndarray, "n c"]  # the columns behind the timestamp


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file with something on them, and their numbers from 1; OSError as usual."""
    text = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return [(k, line) for k, line in enumerate(text, 1) if line.strip() and not line.lstrip().startswith("#")]


def read_numbers(
    path: Path, columns: str, counts: tuple[int, ...], separator: str | None = None, finite: bool = True
) -> tuple[list[int], Float[np.ndarray, "n c"]]:
    """Read a table of numbers.

    Args:
        path: The file.
        columns: What its lines hold, in words, for errors.
        counts: How many columns a line may have.
        separator: Between columns; by default blanks.
        finite: Whether NaN and infinity are refused.

    Returns:
        The numbers of the lines, and the first min(counts) columns of each, float64.

    Raises:
        DataError: Naming file and line, for another number of columns, for text, and for an empty table.
    """
    lines, rows = [], []
    for number, line in numbered_lines(path):
        fields = line.split(separator)
        if len(fields) not in counts:
            raise DataError(f"{path}:{number}: expected {columns}, got {len(fields)}")
        try:
            row = [float(field) for field in fields][: min(counts)]
        except ValueError:
            raise DataError(f"{path}:{number}: expected {columns}, got {line[:60]!r}") from None
        if finite and not all(map(math.isfinite, row)):
            raise DataError(f"{path}:{number}: expected finite numbers, got {line[:60]!r}")
        lines.append(number)
        rows.append(row)
    if not rows:
        raise DataError(f"{path}: expected lines of {columns}, got none")
    return lines, np.array(rows)


def read_stamped(
    path: Path, columns: str, count: int, *, unit: Unit, separator: str | None = None, rows: int | None = None
) -> StampedRows:
    """Read a table whose lines begin with a timestamp, increasing.

    Args:
        path: The file.
        columns: What its lines hold, in words, for errors.
        count: How many columns a line has, the timestamp included.
        unit: Of the timestamps: decimal seconds, or whole nanoseconds.
        separator: Between columns; by default blanks.
        rows: Read no more than so many.

    Returns:
        Timestamps in whole ns, and the other columns.

    Raises:
        DataError: As `read_numbers`, and for timestamps that do not increase.
    """
    lines, stamps, values = [], [], []
    for number, line in numbered_lines(path)[:rows]:
        fields = line.split(separator)
        if len(fields) != count:
            raise DataError(f"{path}:{number}: expected {columns}, got {len(fields)}")
        timestamp = _nanoseconds(fields[0], unit)
        try:
            row = [float(field) for field in fields[1:]]
        except ValueError:
            row = None
        if timestamp is None or row is None:
            wanted = columns if unit == "s" else "a timestamp in ns and numbers"
            raise DataError(f"{path}:{number}: expected {wanted}, got {line[:60]!r}")
        if not all(map(math.isfinite, row)):
            raise DataError(f"{path}:{number}: expected finite numbers, got {line[:60]!r}")
        _check_after(path, number, stamps, timestamp, unit)
        lines.append(number)
        stamps.append(timestamp)
        values.append(row)
    if not stamps:
        raise DataError(f"{path}: expected lines of {columns}, got none")
    return StampedRows(lines, stamps, np.array(values))


def read_stamped_names(
    path: Path, *, unit: Unit, separator: str | None = None
) -> tuple[list[int], list[str]]:
    """Read a list of files: lines of a timestamp, increasing, and a name.

    Args:
        path: The file.
        unit: Of the timestamps: decimal seconds, or whole nanoseconds.
        separator: Between the two; by default blanks.

    Returns:
        Timestamps in whole ns, and the names, which may hold blanks.

    Raises:
        DataError: Naming file and line for anything else, and for timestamps that do not increase.
    """
    wanted = f"a timestamp in {'seconds' if unit == 's' else 'ns'} and a file name"
    stamps, names = [], []
    for number, line in numbered_lines(path):
        first, *rest = line.split(separator, maxsplit=1)
        timestamp, name = _nanoseconds(first, unit), rest[0].strip() if rest else ""
        if timestamp is None or not name:
            raise DataError(f"{path}:{number}: expected {wanted}, got {line[:60]!r}")
        _check_after(path, number, stamps, timestamp, unit)
        stamps.append(timestamp)
        names.append(name)
    if not stamps:
        raise DataError(f"{path}: expected lines of a timestamp and a file name, got none")
    return stamps, names


def read_all_numbers(path: Path, counts: tuple[int, ...], wanted: str) -> Float[np.ndarray, " n"]:
    """The numbers of a file whatever its lines; DataError with `wanted` unless finite, one of `counts`."""
    words = " ".join(line.partition("#")[0] for _, line in numbered_lines(path)).replace(",", " ").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        raise DataError(f"{path}: expected {wanted}, got {' '.join(words)[:60]!r}")
    return numbers


def read_unchecked(path: Path) -> Float[np.ndarray, "n c"]:
    """The numbers of those lines that have as many as the first, whatever is on others; empty if none."""
    rows = []
    for _, line in numbered_lines(path):
        numbers = []
        for word in line.replace(",", " ").split():
            try:
                numbers.append(float(word))
            except ValueError:
                break
        if not rows or len(numbers) == len(rows[0]):
            rows.append(numbers)
    return np.array(rows).reshape(len(rows), -1)


def seconds(ns: list[int], t0_ns: int) -> Float[np.ndarray, " n"]:
    """Nanoseconds as float64 seconds since `t0_ns`.

    >>> seconds([1403715523912140001, 1403715523917140001], 1403715523912140001).tolist()
    [0.0, 0.005]
    """
    return np.array([timestamp - t0_ns for timestamp in ns], np.float64) * 1e-9


def format_rows(rows: Float[np.ndarray, "n c"]) -> str:
    """Rows as text, every number in the fewest digits that give it back exactly."""
    return "".join(" ".join(map(repr, row)) + "\n" for row in np.asarray(rows, np.float64).tolist())


def _nanoseconds(word: str, unit: Unit) -> int | None:
    """A timestamp in whole ns; None for what is none."""
    try:
        return int(word) if unit == "ns" else round(Decimal(word) * 10**9)
    except (ValueError, InvalidOperation, OverflowError):
        return None


def _check_after(path: Path, number: int, stamps: list[int], timestamp: int, unit: Unit) -> None:
    if stamps and timestamp <= stamps[-1]:
        last, got = (f"{x}" if unit == "ns" else f"{x / 1e9} s" for x in (stamps[-1], timestamp))
        raise DataError(f"{path}:{number}: expected a timestamp after {last}, got {got}")
