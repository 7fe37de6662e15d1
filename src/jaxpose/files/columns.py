"""What the columns of a table hold, by the names in its header or by those that the user gives."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxpose.files.tables import Table
from jaxpose.files.timestamps import Unit

# A name is matched with everything before its last dot cut off, as rostopic and others write whole paths.
POSE = {
    "t": r"t|time|times|timestamps?|time_?stamp|stamp|%?time|secs?_since_\w+|seconds(_elapsed)?",
    **{f"t{axis}": rf"(t|p|pos|position|trans|translation|location|p_rs_r)?_?{axis}" for axis in "xyz"},
    **{f"q{axis}": rf"(q|quat|quaternion|orientation|rotation|rot|ori|q_rs)_?{axis}" for axis in "wxyz"},
}
_UNITS: dict[Unit, str] = {
    "s": r"s|secs?|seconds?",
    "ms": r"ms|msecs?|millis(ec)?s?|milliseconds?",
    "us": r"us|usecs?|micros(ec)?s?|microseconds?",
    "ns": r"ns|nsecs?|nanos(ec)?s?|nanoseconds?",
}
_LONGEST_HEADER = 4000  # characters; what is longer is no list of names
_PATHS = ("position", "orientation", "translation", "rotation", "linear_acceleration", "angular_velocity")


class Named(NamedTuple):
    """Where a header says that quantities are."""

    at: dict[str, int]  # column by the name of the quantity
    unit: Unit | None  # of `t`, where the header states one
    stated: dict[str, str]  # what stands in brackets behind a quantity's name: its unit


def named_columns(table: Table, wanted: Mapping[str, str]) -> Named | None:
    """Find columns by the nearest line above the numbers that has a name for each of them.

    Args:
        table: A table.
        wanted: Regular expressions of the names, by quantity; `t` is the timestamp.

    Returns:
        The columns; None unless a header names all that are wanted.
    """
    for header in table.headers:
        if len(header) > _LONGEST_HEADER:
            continue
        text = re.sub(r"^(fields|columns|format)\s*:?\s+", "", header, flags=re.IGNORECASE)
        named = match_names(_split(text, table.separator), wanted)
        if named is not None and len(_split(text, table.separator)) == len(table.words(0)):
            return named
    return None


def named_parts(header: str, table: Table, wanted: Mapping[str, str]) -> set[str]:
    """The quantities that a header has names for.

    Args:
        header: A line above the numbers.
        table: It is of.
        wanted: As in `named_columns`.

    Returns:
        Their names; none for a header of another number of columns.
    """
    names = _split(header, table.separator) if len(header) <= _LONGEST_HEADER else []
    if not table.rows or len(names) != len(table.words(0)):
        return set()
    plain = [re.sub(r"^(t|time|timestamps?|stamp)_\w+$", r"\1", _plain(name)[0]) for name in names]
    return {quantity for quantity, form in wanted.items() if any(re.fullmatch(form, name) for name in plain)}


def match_names(names: Sequence[str], wanted: Mapping[str, str]) -> Named | None:
    """The places of names, with the unit that the timestamp's name states.

    Args:
        names: Of all columns; brackets behind a name hold its unit.
        wanted: As in `named_columns`.

    Returns:
        None unless all are there.

    >>> match_names(["t_ns", "px", "py", "pz", "qw", "qx", "qy", "qz"], POSE).at["qx"]
    5
    """
    at: dict[str, int] = {}
    stated: dict[str, str] = {}
    unit = None
    for k, name in enumerate(names):
        plain, bracket = _plain(name)
        told = bracket
        if (suffix := re.fullmatch(r"(t|time|timestamps?|stamp)_(\w+)", plain)) and _unit(suffix[2]):
            plain, told = suffix[1], suffix[2]
        for quantity, pattern in wanted.items():
            if quantity not in at and re.fullmatch(pattern, plain):
                at[quantity] = k
                stated[quantity] = bracket
                unit = _unit(told) if quantity == "t" else unit
                break
    return Named(at, unit, stated) if len(at) == len(wanted) else None


def column_names(text: str) -> list[str]:
    """The names of columns as a user lists them, between commas or blanks."""
    return _split(text, "," if "," in text else None)


def _split(header: str, separator: str | None) -> list[str]:
    """The names of a header; brackets with a unit belong to the name before them."""
    if separator:
        return [name.strip() for name in header.rstrip(separator + " ").split(separator)]
    return re.sub(r"\s+([\[(])", r"\1", re.sub(r"\[[^\]]*\]|\([^)]*\)", _no_blanks, header)).split()


def _no_blanks(match: re.Match[str]) -> str:
    return match[0].replace(" ", "")


def _plain(name: str) -> tuple[str, str]:
    """A name in lower case, with the last part of a path only, and what is in brackets behind it."""
    bracket = re.search(r"[\[(]([^\])]*)[\])]", name)
    bare = re.sub(r"[\[(].*", "", name).strip().strip("\"'").lower()
    parts = re.split(r"[./]", bare)
    tail = parts[-1]
    if len(parts) > 1 and parts[-2] in _PATHS:
        tail = f"{parts[-2]}_{tail}"
    return tail.strip("#%<> "), bracket[1].strip() if bracket else ""


def _unit(text: str) -> Unit | None:
    """The unit of time that a text is the name of."""
    return next((unit for unit, pattern in _UNITS.items() if re.fullmatch(pattern, text.lower())), None)


def joined_clock(table: Table) -> Table:
    """A table whose timestamps are in two columns, `sec` and `nsec`, with one of decimal seconds instead."""
    for k, header in enumerate(table.headers):
        if len(header) > _LONGEST_HEADER:
            continue
        names = [_plain(name)[0] for name in _split(header, table.separator)]
        first = next((i for i in range(len(names) - 1) if _is_clock(names[i], names[i + 1])), None)
        if first is None or len(names) != len(table.words(0)):
            continue
        mark = table.separator or " "
        rows = [mark.join(_join(table.words(row), first, len(names))) for row in range(len(table.rows))]
        joined = mark.join([*names[:first], "t[s]", *names[first + 2 :]])
        return table._replace(rows=rows, headers=(joined, *table.headers[k + 1 :]))
    return table


def _join(words: list[str], first: int, count: int) -> list[str]:
    """A row of `count` words with its seconds and nanoseconds in one; others as they are."""
    if len(words) != count:
        return words
    return [*words[:first], f"{words[first]}.{words[first + 1].zfill(9)}", *words[first + 2 :]]


def _is_clock(first: str, second: str) -> bool:
    return re.fullmatch(r"(.*_)?secs?", first) is not None and _unit(second.split("_")[-1]) == "ns"
