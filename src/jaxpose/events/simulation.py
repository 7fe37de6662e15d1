"""Event cameras: every pixel reports by itself, and at once, that its brightness has changed.

An event says that the log intensity of its pixel has changed by a threshold since the pixel's last event. So
between any two of a pixel's events the change is known, whatever happened in other pixels: `index_by_pixel`
puts events in that order, `cumulative_polarity` reads it.
"""

from collections.abc import Iterable, Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.errors import DataError
from jaxpose.events.types import GAMMA, Events, FloatArray, Mosaic


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

    `images` gives timestamps [s], which increase, and the log intensity that each pixel sees. Every pixel
    begins at the first image's level and reports each `threshold` of change, at the time of the crossing.
    `spread` is the standard deviation of thresholds over pixels, for either polarity. For `refractory_s` [s]
    after an event a pixel sees nothing, and then counts from the level it finds. `noise_hz` is the rate of a
    pixel's false events. DataError for timestamps that do not increase.
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
            raise DataError(f"simulate: expected timestamps that increase, got {t:g} s after {t_before:g} s")
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
