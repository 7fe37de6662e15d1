"""Pairs of timestamps."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxpose._checks import check_increasing
from jaxpose.errors import DataError

_SUFFIX = re.compile(r"\.(png|jpe?g|tiff?|bmp|webp)$", re.IGNORECASE)  # others are parts of names: 1.25
_SAME_S = 5e-10  # distances that differ by less are equal: timestamps are whole ns, their floats are not


def associate(
    t_a: Float[np.ndarray, " a"], t_b: Float[np.ndarray, " b"], max_difference: float = 0.01
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Pair timestamps of two lists by nearness.

    Every timestamp of the shorter list (of `t_b` if equally long) takes the nearest of the longer, the
    earlier of two equally near; one timestamp of the longer may serve two.

    Args:
        t_a: Timestamps (a,) [s], increasing.
        t_b: Timestamps (b,) [s], increasing.
        max_difference: Pairs farther apart [s] are left out.

    Returns:
        Indices into both lists, (m,) each.

    Raises:
        DataError: If no pair is near enough.
        ValueError: For timestamps that do not increase.

    >>> [rows.tolist() for rows in associate(np.array([0.0, 1.0, 2.0]), np.array([1.004, 5.0]))]
    [[1], [0]]
    """
    check_increasing(t_a=t_a, t_b=t_b)
    if len(t_b) <= len(t_a):
        near_a, near_b = nearest(t_b, t_a), np.arange(len(t_b))
    else:
        near_a, near_b = np.arange(len(t_a)), nearest(t_a, t_b)
    difference = np.abs(t_a[near_a] - t_b[near_b]) if len(t_a) and len(t_b) else np.zeros(0)
    close = difference <= max_difference
    if not close.any():
        spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" if len(t) else "no timestamps" for t in (t_a, t_b)]
        nearest_two = f", the nearest two {difference.min():.3g} s apart" if len(difference) else ""
        raise DataError(
            f"trajectories: expected timestamps within {max_difference:g} s, got {' and '.join(spans)}"
            f"{nearest_two}"
        )
    return near_a[close], near_b[close]


def associate_names(where: Path | str, a: Sequence[str], b: Sequence[str]) -> tuple[list[int], list[int]]:
    """Pair images of two lists by name: the parts of their paths from the end that are their own in both.

    Args:
        where: What the first list is of, for errors.
        a: Names (a,), with or without suffix.
        b: Names (b,).

    Returns:
        Indices into both lists, (m,) each, in the order of the second.

    Raises:
        DataError: If no name is in both, or one stands for several images.

    >>> associate_names("a", ["left/1.png", "left/2.png"], ["2", "1", "0"])
    ([1, 0], [0, 1])
    """
    parts = [[_SUFFIX.sub("", name).replace("\\", "/").split("/") for name in names] for names in (a, b)]
    for count in range(max(map(len, parts[0] + parts[1]), default=0), 0, -1):
        rows_a, rows_b = ({tuple(name[-count:]): row for row, name in enumerate(names)} for names in parts)
        both = [name for name in rows_b if name in rows_a]
        if both and len(rows_a) == len(a) and len(rows_b) == len(b):
            return [rows_a[name] for name in both], [rows_b[name] for name in both]
    raise DataError(f"{where}: expected names of images as {', '.join(b[:3])}, got {', '.join(a[:3])}")


def nearest(t: Float[np.ndarray, " n"], among: Float[np.ndarray, " m"]) -> Int[np.ndarray, " n"]:
    """Find the nearest timestamp.

    Args:
        t: Times (n,) [s].
        among: Timestamps (m,) [s], increasing.

    Returns:
        Indices (n,) into `among`, of the earlier of two equally near.

    >>> nearest(np.array([0.4, 0.6, 9.0]), np.array([0.0, 1.0, 2.0])).tolist()
    [0, 1, 2]
    """
    after = np.minimum(np.searchsorted(among, t, side="right"), len(among) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(among[after] - t) < np.abs(t - among[before]) - _SAME_S
    return np.where(nearer, after, before)
