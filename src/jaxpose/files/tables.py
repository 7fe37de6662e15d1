"""Text tables of numbers: the one parser of all text formats."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError


def read_numbers(
    path: Path, columns: str, counts: tuple[int, ...], separator: str | None = None, finite: bool = True
) -> tuple[list[int], Float[np.ndarray, "n c"]]:
    """Line numbers and the first min(counts) columns of a table; each line has one of `counts` columns.

    Empty lines and those that begin with # are left out. DataError naming file and line, with `columns` for
    what was expected, for another number of columns, for text, and for NaN or infinity unless `finite` is
    False.
    """
    lines, rows = [], []
    for number, line in enumerate(
        path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1
    ):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
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


def format_rows(rows: Float[np.ndarray, "n c"]) -> str:
    """Rows as text, every number in the fewest digits that give it back exactly."""
    return "".join(" ".join(map(repr, row)) + "\n" for row in np.asarray(rows, np.float64).tolist())
