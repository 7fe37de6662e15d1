"""What events tell of their sensor: pixels that never rest, dead times, unequal thresholds."""

import numpy as np
from jaxtyping import Bool, Float

from jaxpose.events.types import Events, check_events

_RING = 2  # pixels to each side that a pixel is compared with
_TIMES, _MORE = 3, 20  # so many times its neighbours' events, and so many more, make a pixel hot
_SHORT = 0.05  # share of the intervals, the shortest, among which a dead time shows
_FEW = 0.5  # of the density of intervals after a dead time, that may lie within it
_SURE = 15.0  # gain of log likelihood by the jump; chance has up to about 8
_LEAST = 100  # intervals or pixels that a number is said from
_OFTEN = 10  # events of each polarity of a pixel whose thresholds are compared


def hot_pixels(events: Events, height: int, width: int) -> Bool[np.ndarray, "h w"]:
    """Pixels that report far more than those around them do.

    Args:
        events: On the sensor.
        height: Rows of the sensor.
        width: Columns of the sensor.

    Returns:
        True where a pixel has more than 20 events beyond three times those of its neighbours, of the 24
        around it the one with the third most: edges pass several pixels, and hot ones may be neighbours.

    Raises:
        ValueError: For columns of another shape or type, and events beyond the sensor.
    """
    count = _count(events, height, width)
    side = 2 * _RING + 1
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(count, _RING), (side, side))
    around = np.delete(windows.reshape(height, width, -1), side**2 // 2, axis=-1)
    return count > _TIMES * np.sort(around, axis=-1)[..., -3] + _MORE


def dead_time_s(events: Events) -> float | None:
    """A time after an event for which a pixel stays silent, at most.

    The density of the intervals between events of a pixel jumps where the sensor wakes; false events put
    some before it. The time is the most likely place of the jump, of two constant densities. A pixel that
    wakes has to see a whole threshold of change first, so that what is found is an upper bound.

    Args:
        events: In the order of time.

    Returns:
        Seconds; None for few intervals, and where no jump is seen.

    Raises:
        ValueError: For columns of another shape or type.
    """
    check_events(events)
    pixel = events.y.astype(np.int64) * (int(events.x.max(initial=0)) + 1) + events.x
    order = np.argsort(pixel, kind="stable")
    pixel, t = pixel[order], events.t[order]
    interval = np.sort(np.diff(t)[pixel[1:] == pixel[:-1]])
    shortest = interval[: int(_SHORT * len(interval))]
    if len(shortest) < _LEAST or not shortest[-1] > 0:
        return None
    share, n = shortest[:-1] / shortest[-1], len(shortest) - 1
    below = np.arange(n)  # intervals before each candidate
    tried = (share > 0) & (share < 1)
    share, below = share[tried], below[tried]
    inside, after = np.maximum(below, 0.5) / share, (n - below) / (1 - share)  # densities
    gain = below * np.log(inside / n) + (n - below) * np.log(after / n)
    best = int(np.argmax(gain)) if len(gain) else 0
    if not len(gain) or gain[best] < _SURE or inside[best] > _FEW * after[best]:
        return None
    return float(share[best] * shortest[-1])


def threshold_spread(events: Events, height: int, width: int) -> float | None:
    """Relative standard deviation of pixels' thresholds, from a motion that returns to where it began.

    Each pixel then ends at the brightness that it began with, so that its events up and down are as
    many as its two thresholds are unequal. Median absolute deviation, from pixels with ten events of each.

    Args:
        events: Of a motion that ends where it began.
        height: Rows of the sensor.
        width: Columns of the sensor.

    Returns:
        Of a threshold, if those of the two polarities are independent; None where few pixels report enough.

    Raises:
        ValueError: For columns of another shape or type, and events beyond the sensor.
    """
    brighter = events.polarity > 0
    up, down = (
        _count(Events(*(column[which] for column in events)), height, width)
        for which in (brighter, ~brighter)
    )
    often = np.minimum(up, down) >= _OFTEN
    if often.sum() < _LEAST:
        return None
    ratio = np.log(up[often] / down[often])
    return float(1.4826 * np.median(np.abs(ratio - np.median(ratio))) / np.sqrt(2))


def _count(events: Events, height: int, width: int) -> Float[np.ndarray, "h w"]:
    """How many events each pixel has."""
    check_events(events)
    if len(events.t) and (events.x.max() >= width or events.y.max() >= height):
        raise ValueError(
            f"events: expected pixels of {width}x{height}, got column {events.x.max()}, row {events.y.max()}"
        )
    pixel = events.y.astype(np.int64) * width + events.x
    return np.bincount(pixel, minlength=height * width).reshape(height, width).astype(np.float64)
