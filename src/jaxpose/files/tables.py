"""Text tables: the one parser of lines of numbers, timestamps and file names.

Empty lines and those that begin with # are left out. Timestamps become whole nanoseconds, their unit tested
by their size and steps (`timestamps.units`). Rows that hold NaN, infinity or nothing where a number belongs,
and those that repeat a timestamp, are gaps of a recording: they are left out and counted. What is no number
is refused.
"""

import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files.schema import FARTHEST_M
from jaxpose.files.timestamps import PER_SECOND, POSES, Steps, Unit, format_ns, to_decimal, to_ns, units

_NO_NUMBER = {"", "nan", "-nan", "null", "none", "na", "n/a"}  # how writers say that there is none


class StampedRows(NamedTuple):
    """Rows that begin with a timestamp."""

    lines: list[int]  # number of each row's line, from 1
    ns: list[int]  # increasing, on the file's own clock
    values: Float[np.ndarray, "n c"]  # the columns behind the timestamp
    unit: Unit = "s"  # in which the file has its timestamps
    repeated: tuple[int, ...] = ()  # lines left out as their timestamp is that of the row before
    missing: tuple[int, ...] = ()  # lines left out for NaN, infinity or nothing in place of a number
    written_s: tuple[Decimal, ...] = ()  # the timestamps [s] with all of their digits


class Table(NamedTuple):
    """A text table as words."""

    lines: list[int]  # number of each row's line, from 1
    words: list[list[str]]
    separator: str | None  # comma, semicolon, or None: blanks
    headers: tuple[str, ...]  # lines above the first row, without # or %, the nearest first
    comments: tuple[tuple[int, str], ...] = ()  # all lines behind # or %, with their numbers


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file with something on them, and their numbers from 1; OSError as usual."""
    return [(k, line) for k, line in _all_lines(path) if not line.lstrip().startswith("#")]


def read_table(path: Path) -> Table:
    """Read the rows of a table whose separator and header are found by what is in it.

    Args:
        path: The file.

    Returns:
        Its rows, words split at commas or semicolons where the first row has any, else at blanks; a
        separator at the end of a line begins no column.
    """
    headers: list[str] = []
    comments: list[tuple[int, str]] = []
    lines, words = [], []
    separator = None
    for number, line in _all_lines(path):
        text = line.strip()
        comment = text[0] in "#%"
        bare = text.lstrip("#%").strip()
        if comment:
            comments.append((number, bare))
        named = not lines and not _is_row(text)
        if not lines and (comment or named):
            headers.insert(0, bare)
        if comment or named:
            continue
        if not lines:
            separator = next((mark for mark in ",;" if mark in text), None)
        row = [word.strip() for word in text.split(separator)]
        lines.append(number)
        words.append(row[:-1] if separator and not row[-1] else row)
    return Table(lines, words, separator, tuple(headers), tuple(comments))


def stamped_rows(
    path: Path,
    table: Table,
    columns: str,
    at: Sequence[int],
    *,
    unit: Unit,
    exact: bool = False,
    steps: Steps = POSES,
) -> StampedRows:
    """The timestamps and numbers of some columns of a table.

    Args:
        path: The file, for errors.
        table: Its words.
        columns: What its lines hold, in words, for errors.
        at: The columns, that of the timestamps first.
        unit: Of the timestamps by the file's format, or as the file or the user says.
        exact: Whether the unit is stated, so that timestamps do not have to make sense in it.
        steps: As `timestamps.units` has them.

    Returns:
        Rows with increasing timestamps in whole ns; what is left out is counted.

    Raises:
        DataError: Naming file and line for what is no number and for timestamps that go backwards, and the
            file where more than one unit makes sense of the timestamps, where none does, and where no row is
            left.
    """
    rows, missing = _numbers(path, table, columns, at)
    if not rows:
        got = f"NaN or infinity in all {len(missing)}" if missing else "none"
        raise DataError(f"{path}: expected lines of {columns}, got {got}")
    if not exact:
        unit = _unit_of(path, [row[1] for row in rows], unit, steps)
    found, repeated = StampedRows([], [], np.zeros((0, 0)), unit), []
    kept, written = [], []
    for number, timestamp, values in rows:
        ns = to_ns(timestamp, unit)
        if found.ns and ns == found.ns[-1]:
            repeated.append(number)
            continue
        _check_after(path, number, found.ns, ns)
        found.lines.append(number)
        found.ns.append(ns)
        kept.append(values)
        written.append(timestamp / PER_SECOND[unit])
    return found._replace(
        values=np.array(kept).reshape(len(found.ns), -1),
        repeated=tuple(repeated),
        missing=missing,
        written_s=tuple(written),
    )


def _numbers(
    path: Path, table: Table, columns: str, at: Sequence[int]
) -> tuple[list[tuple[int, Decimal, list[float]]], tuple[int, ...]]:
    """Line, timestamp and numbers of the rows that have them, and the lines of those that do not."""
    rows, missing, width = [], [], len(table.words[0]) if table.words else 0
    for number, words in zip(table.lines, table.words, strict=True):
        if len(words) != width:
            raise DataError(f"{path}:{number}: expected {columns}, got {len(words)}")
        values, timestamp = [_number(words[k]) for k in at[1:]], to_decimal(words[at[0]])
        if None in values or (timestamp is None and _number(words[at[0]]) is None):
            raise DataError(f"{path}:{number}: expected {columns}, got {' '.join(words)[:60]!r}")
        kept = [value for value in values if value is not None and math.isfinite(value)]
        if any(abs(value) > FARTHEST_M for value in kept):
            got = max(kept, key=abs)
            raise DataError(f"{path}:{number}: expected {columns}, none above {FARTHEST_M:g}, got {got:g}")
        if timestamp is None or len(kept) < len(values):
            missing.append(number)
        else:
            rows.append((number, timestamp, kept))
    return rows, tuple(missing)


def left_out_notes(path: Path, rows: StampedRows) -> tuple[str, ...]:
    """A note on the lines that were left out, with their counts."""
    reasons = {"hold NaN, infinity or nothing": rows.missing, "repeat the timestamp before": rows.repeated}
    said = [f"{len(lines)} {why} (line {lines[0]})" for why, lines in reasons.items() if lines]
    return (f"{path.name}: lines left out: {', '.join(said)}",) if said else ()


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
        unit: Of the timestamps by the file's format; another is found by their size and steps.
        separator: Between columns; by default blanks.
        rows: Read no more than so many.

    Returns:
        Timestamps in whole ns, and the other columns; rows with NaN and repeated timestamps are left out.

    Raises:
        DataError: As `read_numbers`, for timestamps that go backwards, and for such as make sense in no unit
            or in more than one.
    """
    table = Table([], [], separator, ())
    for number, line in numbered_lines(path)[:rows]:
        words = [word.strip() for word in line.split(separator)]
        if len(words) != count:
            raise DataError(f"{path}:{number}: expected {columns}, got {len(words)}")
        table.lines.append(number)
        table.words.append(words)
    return stamped_rows(path, table, columns, range(count), unit=unit)


def read_stamped_names(
    path: Path, *, unit: Unit, separator: str | None = None
) -> tuple[list[int], list[str]]:
    """Read a list of files: lines of a timestamp, increasing, and a name.

    Args:
        path: The file.
        unit: Of the timestamps by the file's format; another is found by their size and steps.
        separator: Between the two; by default blanks.

    Returns:
        Timestamps in whole ns, and the names, which may hold blanks.

    Raises:
        DataError: Naming file and line for anything else, and for timestamps that do not increase.
    """
    wanted = f"a timestamp in {'seconds' if unit == 's' else 'ns'} and a file name"
    rows: list[tuple[int, Decimal, str]] = []
    for number, line in numbered_lines(path):
        first, *rest = line.split(separator, maxsplit=1)
        timestamp, name = to_decimal(first.strip()), rest[0].strip() if rest else ""
        if timestamp is None or not name:
            raise DataError(f"{path}:{number}: expected {wanted}, got {line[:60]!r}")
        rows.append((number, timestamp, name))
    if not rows:
        raise DataError(f"{path}: expected lines of a timestamp and a file name, got none")
    unit = _unit_of(path, [timestamp for _, timestamp, _ in rows], unit)
    stamps: list[int] = []
    for number, timestamp, _ in rows:
        _check_after(path, number, stamps, to_ns(timestamp, unit))
        stamps.append(to_ns(timestamp, unit))
    return stamps, [name for *_, name in rows]


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


def seconds(ns: list[int], t0_ns: int) -> Float[np.ndarray, " n"]:
    """Nanoseconds as float64 seconds since `t0_ns`.

    >>> seconds([1403715523912140001, 1403715523917140001], 1403715523912140001).tolist()
    [0.0, 0.005]
    """
    return np.array([timestamp - t0_ns for timestamp in ns], np.float64) * 1e-9


def format_rows(rows: Float[np.ndarray, "n c"]) -> str:
    """Rows as text, every number in the fewest digits that give it back exactly."""
    return "".join(" ".join(map(repr, row)) + "\n" for row in np.asarray(rows, np.float64).tolist())


def _all_lines(path: Path) -> list[tuple[int, str]]:
    text = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return [(k, line) for k, line in enumerate(text, 1) if line.strip()]


def _is_row(line: str) -> bool:
    """Whether a line is numbers, for the most part, and not the names of columns."""
    words = line.replace(",", " ").replace(";", " ").split()
    return 2 * sum(_number(word) is not None for word in words) >= len(words)


def _number(word: str) -> float | None:
    """A number, NaN where a writer had none; None for text."""
    try:
        return float(word)
    except ValueError:
        return math.nan if word.lower() in _NO_NUMBER else None


def _unit_of(path: Path, numbers: list[Decimal], expected: Unit, steps: Steps = POSES) -> Unit:
    """The one unit that makes sense of timestamps; DataError where there are more, or none."""
    found = units(numbers, expected, steps)
    if len(found) == 1:
        return found[0]
    span = f"{numbers[0]} to {numbers[-1]} in {len(numbers)} lines"
    if not found:
        raise DataError(f"{path}: expected timestamps that make sense in s, ms, us or ns, got {span}")
    raise DataError(
        f"{path}: expected timestamps of one meaning, got {span}, which may be {' or '.join(found)}"
    )


def _check_after(path: Path, number: int, stamps: list[int], timestamp: int) -> None:
    if stamps and timestamp <= stamps[-1]:
        last, got = (f"{format_ns(x)} s" for x in (stamps[-1], timestamp))
        raise DataError(f"{path}:{number}: expected a timestamp after {last}, got {got}")
