"""Text tables: the one parser of lines of numbers, timestamps and file names.

Empty lines and those that begin with # are left out. Timestamps become whole nanoseconds, their unit tested
by their size and steps (`timestamps.units`). Rows that hold NaN, infinity or nothing where a number belongs,
and those that repeat a timestamp, are gaps of a recording: they are left out and counted. What is no number
is refused.
"""

import math
import re
from collections.abc import Sequence
from decimal import Decimal
from operator import lt
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files import timestamps
from jaxpose.files.schema import FARTHEST_M
from jaxpose.files.texts import lines_of
from jaxpose.files.timestamps import POSES, Stamps, Steps, Unit, format_ns, to_decimal, to_stamps, units

_SEPARATORS = re.compile(r"[,;\s]+")
_FEW = 50  # rows, of which each is sooner read by itself
_NO_NUMBER = {"", "nan", "-nan", "null", "none", "na", "n/a"}  # how writers say that there is none


class StampedRows(NamedTuple):
    """Rows that begin with a timestamp."""

    lines: list[int]  # number of each row's line, from 1
    ns: list[int]  # increasing, on the file's own clock
    values: Float[np.ndarray, "n c"]  # the columns behind the timestamp
    unit: Unit = "s"  # in which the file has its timestamps
    repeated: tuple[int, ...] = ()  # lines left out as their timestamp is that of the row before
    missing: tuple[int, ...] = ()  # lines left out for NaN, infinity or nothing in place of a number
    stamps: Stamps = Stamps([], 0)  # the timestamps with all of their digits, in `unit`


class Table(NamedTuple):
    """A text table."""

    lines: list[int]  # number of each row's line, from 1
    rows: list[str]  # as they are, less blanks around them and a separator at their end
    separator: str | None  # comma, semicolon, or None: blanks
    headers: tuple[str, ...] = ()  # lines above the first row, without # or %, the nearest first
    comments: tuple[tuple[int, str], ...] = ()  # all lines behind # or %, with their numbers

    def words(self, row: int) -> list[str]:
        """The words of a row, without blanks around them."""
        return [word.strip() for word in self.rows[row].split(self.separator)]

    def column(self, k: int) -> list[str]:
        """Word `k` of every row; IndexError where one has fewer."""
        return [row.split(self.separator, k + 1)[k].strip() for row in self.rows]


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file with something on them, and their numbers from 1; OSError as usual.

    They come without blanks around them, and without those that begin with #.
    """
    return [(k, line) for k, line in lines_of(path) if line[0] != "#"]


def read_table(path: Path) -> Table:
    """Read the rows of a table whose separator and header are found by what is in it.

    Args:
        path: The file.

    Returns:
        Its rows, separated by semicolons or commas where the first has any, else by blanks; a separator at
        the end of a line begins no column, unless one is lacking.
    """
    headers: list[str] = []
    comments: list[tuple[int, str]] = []
    lines, rows = [], []
    separator, width = None, 0  # of the first row
    for number, quoted in lines_of(path):
        line = quoted.replace('"', "") or "#"
        if line[0] in "#%":
            comments.append((number, line.lstrip("#%").strip()))
        if not lines:
            if line[0] in "#%" or not _is_row(line):
                headers.insert(0, line.lstrip("#%").strip())
                continue
            separator = _separator(line)
        if line[0] in "#%":
            continue
        if "#" in line:
            line = re.sub(r"\s+#.*", "", line)
        if separator == ";":  # between decimal commas, where there are any
            line = line.replace(",", ".")
        if separator and line[-1] == separator and line.count(separator) >= width:
            line = line[:-1].rstrip()
        width = width or len(line.split(separator))
        lines.append(number)
        rows.append(line)
    return Table(lines, rows, separator, tuple(headers), tuple(comments))


def find_separator(path: Path) -> str | None:
    """The separator of a table's first row, as `read_table` finds it."""
    rows = (line for _, line in lines_of(path) if line[0] not in "#%" and _is_row(line))
    return _separator(next(rows, ""))


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
    lines, stamps, values, missing = _columns(table, at) or _numbers(path, table, columns, at)
    if not lines:
        got = f"NaN or infinity in all {len(missing)}" if missing else "none"
        raise DataError(f"{path}: expected lines of {columns}, got {got}")
    if not exact:
        unit = _unit_of(path, stamps, unit, steps)
    ns, repeated = stamps.ns(unit), []
    if not all(map(lt, ns, ns[1:])):
        kept = [0]
        for row in range(1, len(ns)):
            if ns[row] == ns[kept[-1]]:
                repeated.append(lines[row])
                continue
            _check_after(path, lines[row], ns[kept[-1]], ns[row])
            kept.append(row)
        lines, ns = [lines[k] for k in kept], [ns[k] for k in kept]
        values, stamps = values[kept], stamps.rows(kept)
    timestamps.check_seconds(path, np.array([ns[0] / 10**9, ns[-1] / 10**9]))
    return StampedRows(lines, ns, values, unit, tuple(repeated), missing, stamps)


_Columns = tuple[list[int], Stamps, np.ndarray, tuple[int, ...]]  # lines, what they hold, and lines left out


def _columns(table: Table, at: Sequence[int]) -> _Columns | None:
    """Timestamps and numbers of a table of nothing else; None where a row needs a look of its own."""
    try:
        stamps = to_stamps(table.column(at[0]))
        values = np.zeros((len(table.rows), 0))
        if len(at) > 1:
            values = _numeric(table.rows, table.separator)[:, at[1:]]
    except (ValueError, IndexError):
        return None
    finite = np.isfinite(values).all(1)
    if (np.abs(values[finite]) > FARTHEST_M).any():
        return None
    if finite.all():
        return table.lines, stamps, values, ()
    lines, kept = np.array(table.lines), np.flatnonzero(finite)
    return lines[kept].tolist(), stamps.rows(kept), values[kept], tuple(lines[~finite].tolist())


def _numeric(rows: Sequence[str], separator: str | None) -> Float[np.ndarray, "n c"]:
    """Rows of as many numbers each; ValueError for others, and for what only Python takes for a number."""
    if not rows or not all(rows):
        raise ValueError("rows with nothing in them")
    return np.loadtxt(rows, np.float64, comments=None, delimiter=separator, ndmin=2)


def _numbers(path: Path, table: Table, columns: str, at: Sequence[int]) -> _Columns:
    """As `_columns`, row by row: what is no number is named, and rows without numbers are left out."""
    lines, stamps, rows, missing = [], [], [], []
    width = len(table.words(0)) if table.rows else 0
    for row, number in enumerate(table.lines):
        words = table.words(row)
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
            continue
        lines.append(number)
        stamps.append(words[at[0]])
        rows.append(kept)
    return lines, to_stamps(stamps), np.array(rows).reshape(len(rows), len(at) - 1), tuple(missing)


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
    numbered = numbered_lines(path)
    table = Table([number for number, _ in numbered], [line for _, line in numbered], separator)
    try:
        if len(table.rows) > _FEW:
            found = _numeric(table.rows, separator)
            if found.shape[1] in counts and (np.isfinite(found).all() or not finite):
                return table.lines, found[:, : min(counts)]
    except ValueError:
        pass
    return _read_lines(path, table, columns, counts, finite)


def _read_lines(
    path: Path, table: Table, columns: str, counts: tuple[int, ...], finite: bool
) -> tuple[list[int], Float[np.ndarray, "n c"]]:
    """`read_numbers` line by line: names what is none, and takes lines of different counts."""
    rows = []
    for number, line in zip(table.lines, table.rows, strict=True):
        fields = line.split(table.separator)
        if len(fields) not in counts:
            raise DataError(f"{path}:{number}: expected {columns}, got {len(fields)}")
        try:
            row = [float(field) for field in fields][: min(counts)]
        except ValueError:
            raise DataError(f"{path}:{number}: expected {columns}, got {line[:60]!r}") from None
        if finite and not all(map(math.isfinite, row)):
            raise DataError(f"{path}:{number}: expected finite numbers, got {line[:60]!r}")
        rows.append(row)
    if not rows:
        raise DataError(f"{path}: expected lines of {columns}, got none")
    return table.lines, np.array(rows)


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
    numbered = numbered_lines(path)[:rows]
    table = Table([number for number, _ in numbered], [line for _, line in numbered], separator)
    for row, (number, line) in enumerate(numbered):
        found = line.count(separator) + 1 if separator else len(line.split())
        if found != count:
            raise DataError(f"{path}:{number}: expected {columns}, got {len(table.words(row))}")
    return stamped_rows(path, table, columns, range(count), unit=unit)


def read_stamped_names(
    path: Path, *, unit: Unit, separator: str | None = None
) -> tuple[list[int], list[str]]:
    """Read a list of files: lines of a timestamp, increasing, and a name.

    Args:
        path: The file.
        unit: Of the timestamps by the file's format; another is found by their size and steps.
        separator: Between the two; by default blanks, a comma or both.

    Returns:
        Timestamps in whole ns, and the names, which may hold blanks.

    Raises:
        DataError: Naming file and line for anything else, and for timestamps that do not increase.
    """
    wanted = f"a timestamp in {'seconds' if unit == 's' else 'ns'} and a file name"
    lines, words, names = [], [], []
    for number, line in numbered_lines(path):
        blanks = separator is None and "," not in line and ";" not in line
        word, *rest = line.split(separator, 1) if separator or blanks else _SEPARATORS.split(line, maxsplit=1)
        if not rest or not rest[0].strip():
            raise DataError(f"{path}:{number}: expected {wanted}, got {line[:60]!r}")
        lines.append(number)
        words.append(word.strip())
        names.append(rest[0].strip())
    if not lines:
        raise DataError(f"{path}: expected lines of a timestamp and a file name, got none")
    try:
        stamps = to_stamps(words)
    except ValueError:
        bad = next(line for line, word in zip(lines, words, strict=True) if to_decimal(word) is None)
        line = dict(numbered_lines(path))[bad]
        raise DataError(f"{path}:{bad}: expected {wanted}, got {line[:60]!r}") from None
    ns = stamps.ns(_unit_of(path, stamps, unit))
    if not all(map(lt, ns, ns[1:])):
        for row in range(1, len(ns)):
            _check_after(path, lines[row], ns[row - 1], ns[row])
    return ns, names


def read_all_numbers(path: Path, counts: tuple[int, ...], wanted: str) -> Float[np.ndarray, " n"]:
    """The numbers of a file whatever its lines; DataError with `wanted` unless finite, one of `counts`."""
    words = " ".join(line.partition("#")[0] for _, line in numbered_lines(path)).replace(",", " ").split()
    numbers = [_number(word) for word in words]
    if len(numbers) not in counts or not all(x is not None and math.isfinite(x) for x in numbers):
        raise DataError(f"{path}: expected {wanted}, got {' '.join(words)[:60]!r}")
    return np.array(numbers, np.float64)


def seconds(ns: list[int], t0_ns: int) -> Float[np.ndarray, " n"]:
    """Nanoseconds as float64 seconds since `t0_ns`.

    >>> seconds([1403715523912140001, 1403715523917140001], 1403715523912140001).tolist()
    [0.0, 0.005]
    """
    return np.array([timestamp - t0_ns for timestamp in ns], np.float64) * 1e-9


def format_rows(rows: Float[np.ndarray, "n c"]) -> str:
    """Rows as text, every number in the fewest digits that give it back exactly."""
    return "".join(" ".join(map(repr, row)) + "\n" for row in np.asarray(rows, np.float64).tolist())


def _separator(row: str) -> str | None:
    return next((mark for mark in ";," if mark in row), None)


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


def _unit_of(path: Path, stamps: Stamps, expected: Unit, steps: Steps = POSES) -> Unit:
    """The one unit that makes sense of timestamps; DataError where there are more, or none."""
    found = units(stamps, expected, steps)
    if len(found) == 1:
        return found[0]
    first, last = (Decimal(stamps.whole[k]).scaleb(-stamps.digits) for k in (0, -1))
    span = f"{first} to {last} in {len(stamps.whole)} lines"
    if not found:
        raise DataError(f"{path}: expected timestamps that make sense in s, ms, us or ns, got {span}")
    raise DataError(
        f"{path}: expected timestamps of one meaning, got {span}, which may be {' or '.join(found)}"
    )


def _check_after(path: Path, number: int, before: int, timestamp: int) -> None:
    if timestamp <= before:
        last, got = (f"{format_ns(x)} s" for x in (before, timestamp))
        raise DataError(f"{path}:{number}: expected a timestamp after {last}, got {got}")
