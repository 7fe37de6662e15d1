"""Events and the colour mosaic of an event camera."""

from typing import Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Array, Float, Int8, UInt16

from jaxpose._checks import check_shapes

Mosaic = Literal["mono", "rggb"]  # the colour of pixels; "rggb": (even row, even column) red, (odd, odd) blue

AnyArray = Array | np.ndarray

FloatArray = TypeVar("FloatArray", Array, np.ndarray)

GAMMA = 2.2  # of a display: intensity is colour to this power


class Events(NamedTuple):
    """Changes of log intensity, in the order of time.

    Attributes:
        t: Timestamps (n,) [s], float64, never decreasing.
        x: Columns (n,) [px].
        y: Rows (n,) [px].
        polarity: (n,), 1 brighter, -1 darker.
    """

    t: Float[np.ndarray, " n"]
    x: UInt16[np.ndarray, " n"]
    y: UInt16[np.ndarray, " n"]
    polarity: Int8[np.ndarray, " n"]


def check_events(events: Events) -> None:
    """ValueError naming the column of events that has another shape or type, or times that fall."""
    check_shapes(**{f"events.{name}": (column, "n") for name, column in events._asdict().items()})
    for name, kinds in {"t": "f", "x": "iu", "y": "iu", "polarity": "i"}.items():
        column = getattr(events, name)
        if column.dtype.kind not in kinds:
            wanted = "floating-point seconds" if name == "t" else "whole numbers"
            raise ValueError(f"events.{name}: expected {wanted}, got {column.dtype}")
    for row in np.flatnonzero(~(np.diff(events.t) >= 0)) + 1:
        got = f"{events.t[row]} after {events.t[row - 1]} s"
        raise ValueError(f"events.t: expected times that never decrease, got {got}")
