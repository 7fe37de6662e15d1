"""Event cameras: every pixel reports by itself, and at once, that its brightness has changed.

An event says that the log intensity of its pixel has changed by a threshold since the pixel's last event. So
between any two of a pixel's events the change is known, whatever happened in other pixels: `by_pixel` puts
events in that order, `level_at` reads it.
"""

from collections.abc import Iterable, Iterator
from typing import Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int8, UInt16

from jaxpose.errors import DataError

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


class Streams(NamedTuple):
    """The same events pixel after pixel, each pixel's in the order of time."""

    t: Float[AnyArray, " n"]  # [s]
    pixel: Int[AnyArray, " n"]  # row * width + column
    level: Int[AnyArray, " n"]  # sum of the polarities of the pixel's events up to and with this one
    first: Int[AnyArray, " pixels"]  # where each pixel's events begin
    count: Int[AnyArray, " pixels"]  # how many it has


def log_intensity(rgb: FloatArray, offset: float = 0.1) -> FloatArray:
    """Logarithm of the intensity that a displayed colour in [0, 1] stands for (EventNeRF, PEERS B4).

    `offset` is added to the intensity: the light below which a sensor no longer tells dark from black.
    """
    if isinstance(rgb, Array):
        return jnp.log(rgb**GAMMA + offset)
    return np.log(rgb**GAMMA + offset)


def mosaic_mask(mosaic: Mosaic, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """1 for the colours that a pixel sees; a monochrome pixel sees all three."""
    if mosaic == "mono":
        return np.ones((height, width, 3), np.float32)
    row, column = np.mgrid[:height, :width] % 2
    return np.eye(3, dtype=np.float32)[row + column]


def simulate(
    images: Iterable[tuple[float, Float[np.ndarray, "h w"]]],
    threshold: float,
    *,
    spread: float = 0.0,
    refractory_s: float = 0.0,
    noise_hz: float = 0.0,
    seed: int = 0,
) -> Events:
    """Events of a sensor whose log intensity changes linearly between images (as ESIM, Rebecq et al. 2018).

    `images` gives stamps [s], which increase, and the log intensity that each pixel sees. Every pixel begins
    at the first image's level and reports each `threshold` of change, at the time of the crossing. `spread`
    is the standard deviation of thresholds over pixels, for either polarity. For `refractory_s` [s] after an
    event a pixel sees nothing, and then counts from the level it finds. `noise_hz` is the rate of a pixel's
    false events. DataError for stamps that do not increase.
    """
    if threshold <= 0 or min(spread, refractory_s, noise_hz) < 0:
        raise ValueError(
            f"simulate: expected threshold > 0 and spread, refractory_s, noise_hz >= 0, got {threshold}, "
            f"{spread}, {refractory_s}, {noise_hz}"
        )
    generator = np.random.default_rng(seed)
    images = iter(images)
    t_before, before = next(images)
    t_first, shape = t_before, before.shape
    before = np.asarray(before, np.float64).ravel()
    pixels = before.size
    # No pixel fires at nothing, however far its threshold is from the others'.
    steps = np.maximum(threshold + spread * generator.standard_normal((2, pixels)), 0.1 * threshold)
    level = before.copy()
    blind_until = np.full(pixels, -np.inf)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for t, image in images:
        if not t > t_before:
            raise DataError(f"simulate: expected stamps that increase, got {t:g} s after {t_before:g} s")
        now = np.asarray(image, np.float64).ravel()
        parts += _crossings(before, now, t_before, t, steps, level, blind_until, refractory_s)
        t_before, before = t, now
    if noise_hz > 0:
        count = generator.poisson(noise_hz * (t_before - t_first) * pixels)
        signs = generator.choice(np.array([-1, 1], np.int8), count)
        parts.append(
            (generator.uniform(t_first, t_before, count), generator.integers(0, pixels, count), signs)
        )
    when, where, polarity = (np.concatenate(part) for part in zip(*parts, strict=True)) if parts else (
        np.zeros(0), np.zeros(0, int), np.zeros(0, np.int8)
    )  # fmt: skip
    order = np.argsort(when, kind="stable")
    y, x = np.divmod(where[order], shape[1])
    return Events(when[order], x.astype(np.uint16), y.astype(np.uint16), polarity[order])


def _crossings(
    before: Float[np.ndarray, " n"],
    now: Float[np.ndarray, " n"],
    t_before: float,
    t: float,
    steps: Float[np.ndarray, "2 n"],
    level: Float[np.ndarray, " n"],
    blind_until: Float[np.ndarray, " n"],
    refractory_s: float,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Times, pixels and polarities of the events between two images, at most one a pixel at a time.

    `steps` are the thresholds upwards and downwards. The levels that pixels count from, and the times until
    which they are blind (-inf: they see), are brought up to date.
    """
    slope = (now - before) / (t - t_before)
    rested = (blind_until > -np.inf) & (blind_until <= t_before)  # nothing moved when they woke
    level[rested], blind_until[rested] = before[rested], -np.inf
    active = np.flatnonzero(slope)
    while len(active):
        # Pixels that have become able to see again count from where they are.
        woken = active[blind_until[active] > t_before]
        woken = woken[blind_until[woken] <= t]
        level[woken] = before[woken] + slope[woken] * (blind_until[woken] - t_before)
        blind_until[woken] = -np.inf
        active = active[blind_until[active] <= t_before]
        brighter = slope[active] > 0
        target = level[active] + np.where(brighter, steps[0, active], -steps[1, active])
        crossed = np.where(brighter, target <= now[active], target >= now[active])
        active, target, brighter = active[crossed], target[crossed], brighter[crossed]
        when = np.maximum(t_before + (target - before[active]) / slope[active], t_before)
        level[active] = target
        if refractory_s > 0:
            blind_until[active] = when + refractory_s
        yield when, active, np.where(brighter, 1, -1).astype(np.int8)


def by_pixel(events: Events, height: int, width: int) -> Streams:
    """The events of each pixel; numpy, stamps in float64 as they are."""
    pixel = events.y.astype(np.int32) * width + events.x
    order = np.argsort(pixel, kind="stable")
    count = np.bincount(pixel, minlength=height * width).astype(np.int32)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int32)
    level = np.cumsum(events.polarity[order], dtype=np.int32)
    before = np.concatenate([[0], level])[first]
    return Streams(events.t[order], pixel[order], level - np.repeat(before, count), first, count)


def level_at(streams: Streams, pixel: Int[Array, ""], t: Float[Array, ""]) -> Int[Array, ""]:
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


def change_residual(
    rgb_now: Float[Array, "3"],
    rgb_before: Float[Array, "3"],
    change: Float[Array, ""],
    mask: Float[Array, "3"],
    *,
    offset: float = 0.1,
) -> Float[Array, "3"]:
    """Rendered minus reported change of log intensity, for the colours the pixel sees (EventNeRF's loss).

    `change` is the sum of polarities between the two instants times the threshold.
    """
    return mask * (log_intensity(rgb_now, offset) - log_intensity(rgb_before, offset) - change)
