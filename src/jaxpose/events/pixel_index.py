"""Events sorted by pixel: the cumulative polarity of a pixel at any time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxpose.events.types import AnyArray, Events


class PixelIndex(NamedTuple):
    """The same events pixel after pixel, each pixel's in the order of time."""

    t: Float[AnyArray, " n"]  # [s]
    pixel: Int[AnyArray, " n"]  # row * width + column
    level: Int[AnyArray, " n"]  # sum of the polarities of the pixel's events up to and with this one
    first: Int[AnyArray, " pixels"]  # where each pixel's events begin
    count: Int[AnyArray, " pixels"]  # how many it has


def index_by_pixel(events: Events, height: int, width: int) -> PixelIndex:
    """The events of each pixel; numpy, timestamps in float64 as they are."""
    pixel = events.y.astype(np.int32) * width + events.x
    order = np.argsort(pixel, kind="stable")
    count = np.bincount(pixel, minlength=height * width).astype(np.int32)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int32)
    level = np.cumsum(events.polarity[order], dtype=np.int32)
    before = np.concatenate([[0], level])[first]
    return PixelIndex(events.t[order], pixel[order], level - np.repeat(before, count), first, count)


def cumulative_polarity(streams: PixelIndex, pixel: Int[Array, ""], t: Float[Array, ""]) -> Int[Array, ""]:
    """Sum of the polarities of a pixel's events up to `t` [s], those at `t` included; by bisection."""
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
