"""Events in text: a line each, of four numbers, whose order a header says or, without one, `t x y p`."""

import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from jaxpose.datasets.events.columns import NAMES
from jaxpose.datasets.events.stream import BLOCK, Block, Stream, Unit, stated_size
from jaxpose.errors import DataError
from jaxpose.files.opening import open_text

_COLUMNS = "4 numbers (t x y p)"
_EXACT_DIGITS = 15  # of a whole number in float64
_LOOKED_AT = 50  # lines at the top
_LONGEST = 4000  # characters of them
_POLARITIES = {"true": 1.0, "on": 1.0, "false": 0.0, "off": 0.0}
_UNITS: dict[str, Unit] = {"us": "us", "µs": "us", "microseconds": "us", "ns": "ns", "s": "s", "seconds": "s"}


class _Form(NamedTuple):
    """How the lines of a file are read."""

    above: int  # lines before the first event
    separator: str | None  # None: blanks
    order: tuple[int, int, int, int]  # columns of t, x, y, p
    columns: int
    unit: Unit | None
    size: tuple[int, int] | None
    named: bool  # whether a header names the columns

    @property
    def alone(self) -> bool:
        """Whether lines hold the four columns and no others."""
        return self.columns == 4 and max(self.order) < 4


def text_stream(file: Path, unit: Unit | None) -> Stream:
    """The events of a text file, separated by blanks, commas or semicolons.

    Without a header the columns are `t x y p`, or, where only the last of them rises, Prophesee's `x y p t`.
    `unit` is that of timestamps unless a header says another.
    """
    form = _form(file)
    return Stream(
        file,
        lambda: _blocks(file, form),
        lambda row: f"{file}:{_line_of(file, form, row)}",
        form.unit or unit,
        form.size,
        unit_is_sure=form.unit is not None,
    )


def holds_events(file: Path) -> bool:
    """Whether the first line of numbers looks like an event, or a header names the four columns."""
    form = _form(file)
    if form.named:
        return True
    first = _first_row(file, form)
    if len(first) != 4 or not _numbers(first):
        return False
    x, y, p = (float(_number(first[k]) or 0) for k in form.order[1:])
    return x == round(x) and y == round(y) and p in (-1, 0, 1)


def _form(file: Path) -> _Form:
    size, unit, header, rows, separator, above = None, None, None, [], None, 0
    with open_text(file) as lines:
        for number, line in zip(range(_LOOKED_AT), lines, strict=False):
            text = line.strip()[:_LONGEST]
            comment = text[:1] in ("#", "%")
            if found := re.match(r"[#%] *geometry *[:=]? *(\d+) *[,x] *(\d+)", text, re.I):
                size = stated_size(file, found[1], found[2])
            mark = _separator(text)
            words = _split(text.lstrip("#% "), mark)
            if not comment and len(words) > 2 and _numbers(words):
                rows.append(words)
                separator = mark if len(rows) == 1 else separator
            elif len(words) == 2 and not rows and all(word.isdecimal() for word in words):
                size, above = stated_size(file, *words), number + 1
            elif words and not rows and (named := _header(words)):
                header, unit, above = named, _unit(words), number + 1
            elif comment and not rows:
                above = number + 1
            elif text and not comment:
                break  # what is no event is named when it is read
    order = header or _order(rows)
    return _Form(above, separator, order, len(rows[0]) if header and rows else 4, unit, size, bool(header))


def _order(rows: list[list[str]]) -> tuple[int, int, int, int]:
    """Columns of lines without a header."""
    usable = [row for row in rows if len(row) == 4 and _numbers(row)]
    values = np.array([[_number(word) for word in row] for row in usable], float).reshape(-1, 4)
    if len(values) < 2:
        return (0, 1, 2, 3)
    rises = (np.diff(values, axis=0) >= 0).all(0) & (np.ptp(values, axis=0) > 0)
    last_is_time = rises[3] and not rises[0] and (np.abs(values[:, 2]) <= 1).all()
    return (3, 0, 1, 2) if last_is_time else (0, 1, 2, 3)


def _header(words: list[str]) -> tuple[int, int, int, int] | None:
    """Columns of the four by the names in a header; None where it does not name them all."""
    plain = [re.sub(r"\W*\(.*|\W*\[.*|_(us|ns|s)$", "", word.strip().strip('"').lower()) for word in words]
    found = [next((k for k, word in enumerate(plain) if word in names), None) for names in NAMES.values()]
    return None if None in found else tuple(found)  # pyright: ignore[reportReturnType]


def _unit(words: list[str]) -> Unit | None:
    """The unit that a header states behind the name of the time, `timestamp (us)`, `t [ns]` or `t_us`."""
    for word in words:
        found = re.match(r'"?(?:t|ts|time|timestamps?)\W*[_(\[] *(\w+|µs)', word.strip().lower())
        if found and found[1] in _UNITS:
            return _UNITS[found[1]]
    return None


def _separator(line: str) -> str | None:
    return next((mark for mark in ",;" if mark in line), None)


def _split(line: str, separator: str | None) -> list[str]:
    return line.split("#")[0].strip().split(separator) if line.strip() else []


def _numbers(words: list[str]) -> bool:
    return bool(words) and all(_number(word) is not None for word in words)


def _number(word: str) -> float | None:
    """A number, and a polarity in words."""
    try:
        return float(word)
    except ValueError:
        return _POLARITIES.get(word.strip().lower())


def _blocks(file: Path, form: _Form) -> Iterator[Block]:
    with open_text(file) as lines:
        kind, polarity = _kind(file, form), _polarity(file, form)
        for _ in range(form.above):
            next(lines, None)
        while True:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)  # nothing left to read
                    table = np.loadtxt(
                        lines,
                        kind,
                        delimiter=form.separator,
                        max_rows=BLOCK,
                        ndmin=1,
                        usecols=None if form.alone else form.order,
                        converters=polarity,
                    )
            except ValueError as error:
                _name_line(file, form, error)
            yield Block(table["t"], table["x"], table["y"], table["p"])
            if len(table) < BLOCK:
                return


def _kind(file: Path, form: _Form) -> np.dtype:
    """Float64 for all but timestamps of so many digits that only integers hold them, as ns since 1970 are."""
    row = _first_row(file, form, form.order[0])
    first = row[form.order[0]].strip() if row else "0"
    whole = first.isdecimal() and len(first) > _EXACT_DIGITS
    names = ["t", "x", "y", "p"]
    if form.alone:  # loadtxt takes fields in the order of the columns
        names = [names[form.order.index(k)] for k in range(4)]
    return np.dtype([(name, np.int64 if whole and name == "t" else np.float64) for name in names])


def _polarity(file: Path, form: _Form) -> dict[int | str, Callable[[str], float]] | None:
    """How polarities in words are read; None where they are numbers, which numpy reads sooner by itself."""
    column = form.order[3]
    row = _first_row(file, form, column)
    if not row or row[column].strip().lower() not in _POLARITIES:
        return None
    return {column: lambda word: _POLARITIES[word.strip().lower()]}


def _first_row(file: Path, form: _Form, column: int = 0) -> list[str]:
    """The words of the first event that has such a column; none where none has."""
    with open_text(file) as lines:
        rows = (_split(line, form.separator) for k, line in enumerate(lines) if k >= form.above)
        return next((row for row in rows if len(row) > column), [])


def _line_of(file: Path, form: _Form, row: int) -> int:
    """The number of the line that has event `row`."""
    with open_text(file) as lines:
        for number, line in enumerate(lines, start=1):
            if number > form.above and _split(line, form.separator):
                if row == 0:
                    return number
                row -= 1
    raise IndexError(f"{file}: no event {row} more")


def _name_line(file: Path, form: _Form, error: ValueError) -> NoReturn:
    """DataError with the first line that is none of an event's."""
    with open_text(file) as lines:
        for number, line in enumerate(lines, start=1):
            fields = _split(line, form.separator) if number > form.above else []
            if fields and len(fields) != form.columns:
                wanted = _COLUMNS if form.columns == 4 else f"{form.columns} columns, as the header has"
                raise DataError(f"{file}:{number}: expected {wanted}, got {len(fields)}")
            if fields and (max(form.order) >= len(fields) or not _numbers([fields[k] for k in form.order])):
                raise DataError(f"{file}:{number}: expected {_COLUMNS}, got {line.strip()[:60]!r}")
    raise DataError(f"{file}: expected lines of {_COLUMNS}, got {error}")
