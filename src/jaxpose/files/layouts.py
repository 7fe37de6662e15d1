"""Which layout a file of poses has, and what is wrong where it has none, or may have two."""

import re
from decimal import Decimal
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files.columns import POSE, Named, column_names, match_names, named_columns, named_parts
from jaxpose.files.tables import Table
from jaxpose.files.timestamps import Unit, to_decimal, to_stamps, units

Format = Literal["TUM", "CSV", "KITTI", "EuRoC", "4x4 list"]
KNOWN = (
    "TUM (8 numbers a line), KITTI (12), EuRoC, TUM-VI or VINS (commas, 8, 11 or 17), 4x4 matrices (16, or "
    "4 x 4), or a table with a header"
)
_ORDER = ("t", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_XYZW, _WXYZ = tuple(range(8)), (0, 1, 2, 3, 5, 6, 7, 4)
_METRES = {"": 1.0, "m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
_OFF_UNIT = 1e-2  # of a quaternion's length; more is not rounding


class Layout(NamedTuple):
    """Where a table has what, and in which unit."""

    format: Format
    columns: tuple[int, ...] | None  # of t, position, quaternion xyzw; None for matrices
    words: str  # what a line holds
    unit: Unit = "s"  # of the timestamps
    unit_is_stated: bool = False  # by a header or by the user
    refused_unit: Unit | None = None  # timestamps in it would mean another layout
    order: Literal["xyzw", "wxyz"] | None = None
    metres: float = 1.0  # of a unit of the position


TUM = Layout("TUM", _XYZW, "8 numbers (t tx ty tz qx qy qz qw)", order="xyzw")
EUROC = Layout(
    "EuRoC",
    _WXYZ,
    "17 numbers (timestamp, position, quaternion wxyz, velocity, biases) or the first 8 of them",
    unit="ns",
    order="wxyz",
)
_CSV = TUM._replace(format="CSV", words="8 numbers (t,tx,ty,tz,qx,qy,qz,qw)")


def pose_layout(path: Path, table: Table, columns: str | None) -> Layout:
    """The layout of a table of poses.

    Args:
        path: The file, for errors.
        table: Its words.
        columns: Names of the columns as the user gives them; by default those of the header, or what the
            number of columns and the timestamps say.

    Returns:
        The layout.

    Raises:
        DataError: For what is no such table, or may be read in two ways.
    """
    width = len(table.words(0))
    if columns is not None:
        names = column_names(columns)
        named = match_names(names, POSE)
        if named is None or len(names) != width:
            raise DataError(
                f"{path}: expected --columns with {width} names, {' '.join(_ORDER)} among them, "
                f"got {columns!r}"
            )
    else:
        named = named_columns(table, POSE)
    if named is not None:
        at = tuple(named.at[name] for name in _ORDER)
        order = "wxyz" if named.at["qw"] < named.at["qx"] else "xyzw"
        mark = {TUM: None, EUROC: ","}
        known = next((k for k in mark if at == k.columns and table.separator == mark[k]), _CSV)
        known = known if named.unit in (None, known.unit) else _CSV
        words = f"{width} columns, {', '.join(_ORDER)} among them"
        unit = named.unit or ("ns" if known is EUROC else "s")
        metres = _metres(path, named)
        return Layout(known.format, at, words, unit, named.unit is not None, order=order, metres=metres)
    if width in (4, 12, 16):
        return Layout("KITTI" if width == 12 else "4x4 list", None, "")
    if table.separator is None and width == 8:
        return TUM
    if table.separator is not None and width in (8, 11, 17):
        return _unnamed_csv(path, table, width)
    line = (table.separator or " ").join(table.words(0))
    got = repr(line[:60])
    for header in table.headers:
        if len(there := named_parts(header, table, POSE)) > 2:
            got = f"a header without {' '.join(name for name in _ORDER if name not in there)}"
    raise DataError(f"{path}:{table.lines[0]}: expected a trajectory, {KNOWN}, got {got}")


def _metres(path: Path, named: Named) -> float:
    """What the unit of the position that a header states is in metres."""
    stated = sorted({named.stated[f"t{axis}"].lower() for axis in "xyz"} - {""})
    if len(stated) > 1 or not {*stated} <= _METRES.keys():
        raise DataError(
            f"{path}: expected a position in {', '.join(_METRES)[2:]}, got {' and '.join(stated)}"
        )
    return _METRES[stated[0]] if stated else 1.0


def _unnamed_csv(path: Path, table: Table, width: int) -> Layout:
    """Csv without a header: EuRoC's where timestamps are in ns, xyzw where they are in seconds."""
    if width > 8:
        return EUROC._replace(refused_unit="s")
    numbers = [number for word in table.column(0) if (number := to_decimal(word)) is not None]
    found = units(to_stamps([str(number) for number in numbers]), "s") if numbers else ["ns"]
    if len(numbers) == 1 and not Decimal(1e9) < numbers[0] < Decimal(4e9) and numbers[0] == int(numbers[0]):
        found = ["ns"] if numbers[0] > Decimal(10) ** 17 else ["s", "ns"]
    if found == ["s"]:
        return _CSV
    if found == ["ns"]:
        return EUROC
    raise DataError(
        f"{path}: expected csv of seconds, position, quaternion xyzw, or of ns, position, quaternion wxyz "
        f"(EuRoC), got timestamps in {' or '.join(found) or 'no unit that makes sense'}, {numbers[0]} to "
        f"{numbers[-1]}: say which, --columns 't[us] tx ty tz qx qy qz qw'"
    )


def first_behind_comment(table: Table) -> tuple[Table, tuple[str, ...]]:
    """Poses that stand behind #: the first, where Open3D's writer has put it, is taken in; others counted.

    Args:
        table: A table of poses.

    Returns:
        The table, with the first pose if it was behind #, and notes.
    """
    notes, hidden, width = [], 0, len(table.words(0))
    for number, text in table.comments:
        glued = re.fullmatch(r"TUM trajectory, format:.*<qw>([^<>]*)", text)
        words = (glued[1] if glued else text).split(table.separator)
        if len(words) != width or width == 1 or None in [to_decimal(word.strip()) for word in words]:
            continue
        if glued and number < table.lines[0]:
            row = (table.separator or " ").join(words)
            table = table._replace(lines=[number, *table.lines], rows=[row, *table.rows])
            notes.append(f"the first pose stands behind # in line {number}, as Open3D writes it: read")
        else:
            hidden += 1
    if hidden:
        notes.append(f"lines left out: {hidden} with the numbers of a pose behind #")
    return table, tuple(notes)


def unit_quaternions(
    path: Path, lines: list[int], values: Float[np.ndarray, "n 7"], order: str | None
) -> Float[np.ndarray, " n"]:
    """The length of each quaternion.

    Args:
        path: The file, for errors.
        lines: Where the values are in it.
        values: Position and quaternion (n, 7).
        order: In words, for errors.

    Returns:
        Lengths (n,), each about 1 or 0.

    Raises:
        DataError: For other lengths, with a hint where the position is of unit length instead.
    """
    norm = np.linalg.norm(values[:, 3:], axis=1)
    zero = norm < 1e-6
    off = np.where(zero, 0.0, np.abs(norm - 1))
    if off.max() > _OFF_UNIT:
        row = int(off.argmax())
        first = np.linalg.norm(values[:, :4], axis=1)
        hint = ""
        if (np.abs(first - 1) < _OFF_UNIT).all():
            hint = "; columns 2 to 5 are of unit length: is the quaternion first? say so by --columns"
        raise DataError(
            f"{path}:{lines[row]}: expected a unit quaternion {order} behind the position, got one of length "
            f"{norm[row]:.4g}{hint}"
        )
    return norm
