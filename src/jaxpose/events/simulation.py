"""Event cameras: every pixel reports on its own, at once, that its log intensity has changed by a threshold.

Between any two events of a pixel the change is known, whatever happened in other pixels: `index_by_pixel`
puts events in that order, `cumulative_polarity` reads it.
"""

from collections.abc import Iterable, Iterator
from typing import get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.events.types import GAMMA, Events, FloatArray, Mosaic


def log_intensity(rgb: FloatArray, offset: float = 0.1) -> FloatArray:
    """Logarithm of the intensity that a displayed colour stands for (EventNeRF, Rudnev et al., CVPR 2023).

    Args:
        rgb: Colours of any shape, in [0, 1], numpy or jax.
        offset: Added to the intensity: the light below which a sensor no longer tells dark from black.

    Returns:
        log(rgb^2.2 + offset), of the same shape and kind.

    >>> log_intensity(np.ones(1), offset=0.0).tolist()
    [0.0]
    """
    if isinstance(rgb, Array):
        return jnp.log(rgb**GAMMA + offset)
    return np.log(rgb**GAMMA + offset)


def mosaic_mask(mosaic: Mosaic, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """The colours that each pixel sees.

    Args:
        mosaic: "mono", or "rggb": (even row, even column) red, (odd, odd) blue.
        height: Rows.
        width: Columns.

    Returns:
        (height, width, 3), 1 for a colour that the pixel sees; a monochrome pixel sees all three.

    Raises:
        ValueError: For another name.

    >>> mosaic_mask("rggb", 2, 2).argmax(-1).tolist()
    [[0, 1], [1, 2]]
    """
    if mosaic not in get_args(Mosaic):
        raise ValueError(f"mosaic: expected {' or '.join(get_args(Mosaic))}, got {mosaic!r}")
    if mosaic == "mono":
        return np.ones((height, width, 3), np.float32)
    row, column = np.mgrid[:height, :width] % 2
    return np.eye(3, dtype=np.float32)[row + column]


def simulate(
    images: Iterable[tuple[float, Float[np.ndarray, "h w"]]],
    threshold: float,
    *,
    threshold_sigma: float = 0.0,
    refractory_s: float = 0.0,
    noise_hz: float = 0.0,
    seed: int = 0,
) -> Events:
    """Events of a sensor whose log intensity changes linearly between images.

    As ESIM (Rebecq, Gehrig, Scaramuzza, CoRL 2018). Every pixel begins at the first image's level and reports
    each `threshold` of change, at the time of the crossing.

    Args:
        images: Timestamps [s], increasing, and the log intensity (h, w) that each pixel sees.
        threshold: Change of log intensity per event.
        threshold_sigma: Standard deviation of thresholds over pixels, for either polarity.
        refractory_s: [s] after an event for which a pixel sees nothing; it then counts from the level it
            finds.
        noise_hz: Rate of a pixel's false events.
        seed: Makes thresholds and false events.

    Returns:
        Events in the order of time.

    Raises:
        DataError: For timestamps that do not increase, images of another size, and none at all.
        ValueError: For a threshold that is not positive, and for other numbers below 0.

    >>> brighter = [(0.0, np.zeros((1, 1))), (1.0, np.ones((1, 1)))]
    >>> simulate(brighter, threshold=0.5).t.tolist()
    [0.5, 1.0]
    """
    _check_settings(threshold, threshold_sigma, refractory_s, noise_hz)
    generator = np.random.default_rng(seed)
    images = _checked(images)
    t_first, first = next(images)
    pixels, before, t_before = first.size, first.ravel(), t_first
    # No pixel fires at nothing, however far its threshold is from the others'.
    thresholds = np.maximum(
        threshold + threshold_sigma * generator.standard_normal((2, pixels)), 0.1 * threshold
    )
    level = before.copy()
    blind_until = np.full(pixels, -np.inf)
    parts = [(np.zeros(0), np.zeros(0, int), np.zeros(0, np.int8))]
    for t, image in images:
        now = image.ravel()
        parts += _crossings(before, now, t_before, t, thresholds, level, blind_until, refractory_s)
        t_before, before = t, now
    parts += _false_events(generator, noise_hz, t_first, t_before, pixels)
    when, where, polarity = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(when, kind="stable")
    y, x = np.divmod(where[order], first.shape[1])
    return Events(when[order], x.astype(np.uint16), y.astype(np.uint16), polarity[order])


def _check_settings(threshold: float, threshold_sigma: float, refractory_s: float, noise_hz: float) -> None:
    if threshold <= 0 or min(threshold_sigma, refractory_s, noise_hz) < 0:
        raise ValueError(
            "simulate: expected threshold > 0 and threshold_sigma, refractory_s, noise_hz >= 0, got "
            f"{threshold}, {threshold_sigma}, {refractory_s}, {noise_hz}"
        )


def _checked(
    images: Iterable[tuple[float, Float[np.ndarray, "h w"]]],
) -> Iterator[tuple[float, Float[np.ndarray, "h w"]]]:
    """Images in float64, of one size and in the order of time."""
    before, shape = -np.inf, None
    for t, image in images:
        if shape is None:
            check_shapes(**{"images: log intensity": (image, "h w")})
            shape = np.shape(image)
        if not t > before:
            raise DataError(f"simulate: expected timestamps that increase, got {t:g} s after {before:g} s")
        if np.shape(image) != shape:
            raise DataError(f"simulate: expected images of shape {shape}, got {np.shape(image)} at {t:g} s")
        yield t, np.asarray(image, np.float64)
        before = t
    if shape is None:
        raise DataError("simulate: expected at least 1 image, got none")


def _false_events(
    generator: np.random.Generator, noise_hz: float, first: float, last: float, pixels: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Times, pixels and polarities of the events that nothing made."""
    if noise_hz > 0:
        count = generator.poisson(noise_hz * (last - first) * pixels)
        signs = generator.choice(np.array([-1, 1], np.int8), count)
        yield generator.uniform(first, last, count), generator.integers(0, pixels, count), signs


def _crossings(
    before: Float[np.ndarray, " n"],
    now: Float[np.ndarray, " n"],
    t_before: float,
    t: float,
    thresholds: Float[np.ndarray, "2 n"],
    level: Float[np.ndarray, " n"],
    blind_until: Float[np.ndarray, " n"],
    refractory_s: float,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Times, pixels and polarities of the events between two images, at most one a pixel at a time.

    `thresholds` are those upwards and downwards. The levels that pixels count from, and the times until
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
        target = level[active] + np.where(brighter, thresholds[0, active], -thresholds[1, active])
        crossed = np.where(brighter, target <= now[active], target >= now[active])
        active, target, brighter = active[crossed], target[crossed], brighter[crossed]
        when = np.maximum(t_before + (target - before[active]) / slope[active], t_before)
        level[active] = target
        if refractory_s > 0:
            blind_until[active] = when + refractory_s
        yield when, active, np.where(brighter, 1, -1).astype(np.int8)
