"""Events and the colour mosaic of an event camera."""

from typing import Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Array, Float, Int8, UInt16

Mosaic = Literal["mono", "rggb"]  # the colour of pixels; "rggb": (even row, even column) red, (odd, odd) blue


AnyArray = Array | np.ndarray


FloatArray = TypeVar("FloatArray", Array, np.ndarray)


GAMMA = 2.2


class Events(NamedTuple):
    """Changes of log intensity in the order of time: when [s], where [px], and whether brighter or darker."""

    t: Float[np.ndarray, " n"]  # float64, never decreasing
    x: UInt16[np.ndarray, " n"]  # column
    y: UInt16[np.ndarray, " n"]  # row
    polarity: Int8[np.ndarray, " n"]  # 1 brighter, -1 darker
