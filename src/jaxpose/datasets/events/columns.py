"""What files call the time, column, row and polarity of events, and which column is what without names."""

from collections.abc import Iterable

import numpy as np

NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps", "t_us", "timestamp_us"),
    "x": ("x", "xs", "col", "column"),
    "y": ("y", "ys", "row"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on", "is_increase"),
}
ORDERS = ([0, 1, 2, 3], [2, 0, 1, 3], [3, 0, 1, 2])  # of t, x, y and p in tables without names


def named(names: Iterable[str]) -> tuple[str, str, str, str] | None:
    """Which of some names are those of t, x, y and p.

    Args:
        names: Of arrays, fields or columns, in upper or lower case.

    Returns:
        Four of them; None unless all four are there.

    >>> named(["x", "Y", "polarity", "ts"])
    ('ts', 'x', 'Y', 'polarity')
    """
    there = {name.lower(): name for name in names}
    found = [next((there[name] for name in known if name in there), None) for known in NAMES.values()]
    return None if None in found else tuple(found)  # pyright: ignore[reportReturnType]


def order_of(what: str, rows: np.ndarray) -> list[int]:
    """Columns of t, x, y and p in a table without names: the time rises, polarities are two.

    Args:
        what: The table, for errors.
        rows: Its first rows (n, 4), float64.

    Returns:
        The columns in this order.

    Raises:
        ValueError: Where not one order fits.
    """
    rises = (np.diff(rows, axis=0) >= 0).all(0) & (np.ptp(rows, axis=0) > 0)
    fits = [order for order in ORDERS if rises[order[0]] and (np.abs(rows[:, order[3]]) <= 1).all()]
    if len(fits) != 1:
        got = "several of them" if fits else "none of them"
        raise ValueError(f"a table {what} whose columns are t x y p, x y t p or x y p t by {got}")
    return fits[0]
