"""Events sorted by pixel: the cumulative polarity of a pixel at any time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxpose.events.types import AnyArray, Events, check_events


class PixelIndex(NamedTuple):
    """The same events pixel after pixel, each pixel's in the order of time."""

    t: Float[AnyArray, " n"]  # [s]
    pixel: Int[AnyArray, " n"]  # row * width + column
    level: Int[AnyArray, " n"]  # sum of the polarities of the pixel's events up to and with this one
    first: Int[AnyArray, " pixels"]  # where each pixel's events begin
    count: Int[AnyArray, " pixels"]  # how many it has


def index_by_pixel(events: Events, height: int, width: int) -> PixelIndex:
    """Sort events by pixel.

    Args:
        events: In the order of time, on the sensor.
        height: Rows of the sensor.
        width: Columns of the sensor.

    Returns:
        The events of each pixel; numpy, timestamps in float64 as they are.

    Raises:
        ValueError: For events beyond the sensor, and for columns of another shape or type.

    >>> events = Events(np.array([0.0, 1.0]), np.uint16([1, 1]), np.uint16([0, 0]), np.int8([1, -1]))
    >>> index_by_pixel(events, height=1, width=2).level.tolist()
    [1, 0]
    """
    check_events(events)
    if len(events.t) and (events.x.max() >= width or events.y.max() >= height):
        raise ValueError(
            f"events: expected pixels of {width}x{height}, got column {events.x.max()}, row {events.y.max()}"
        )
    pixel = events.y.astype(np.int32) * width + events.x
    order = np.argsort(pixel, kind="stable")
    count = np.bincount(pixel, minlength=height * width).astype(np.int32)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int32)
    level = np.cumsum(events.polarity[order], dtype=np.int32)
    before = np.concatenate([[0], level])[first]
    return PixelIndex(events.t[order], pixel[order], level - np.repeat(before, count), first, count)


def cumulative_polarity(streams: PixelIndex, pixel: Int[Array, ""], t: Float[Array, ""]) -> Int[Array, ""]:
    """Sum of the polarities of a pixel's events up to a time, by bisection.

    Args:
        streams: Events by pixel.
        pixel: row * width + column.
        t: [s]; events at `t` itself are included.

    Returns:
        A whole number, 0 before the first event.
    """
    first, count = streams.first[pixel], streams.count[pixel]
    if len(streams.t) == 0:
        return jnp.zeros((), jnp.int32)

    def halve(_, bounds):
        low, high = bounds  # events before `low` are up to t, those from `high` on are later
        middle = (low + high) // 2
        past = (streams.t[middle] <= t) & (low < high)
        return jnp.where(past, middle + 1, low), jnp.where(past, high, middle)

    rounds = len(streams.t).bit_length()
    after, _ = jax.lax.fori_loop(0, rounds, halve, (first, first + count))
    return jnp.where(after > first, streams.level[after - 1], 0)
