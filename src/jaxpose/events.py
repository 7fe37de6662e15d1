"""Event cameras: every pixel reports by itself, and at once, that its brightness has changed."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int8, UInt16

Mosaic = Literal["mono", "rggb"]  # the colour of pixels; "rggb": (even row, even column) red, (odd, odd) blue


class Events(NamedTuple):
    """Changes of log intensity in the order of time: when [s], where [px], and whether brighter or darker."""

    t: Float[np.ndarray, " n"]  # float64, never decreasing
    x: UInt16[np.ndarray, " n"]  # column
    y: UInt16[np.ndarray, " n"]  # row
    polarity: Int8[np.ndarray, " n"]  # 1 brighter, -1 darker
