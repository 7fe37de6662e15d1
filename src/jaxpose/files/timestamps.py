"""Timestamps: whole nanoseconds on a file's own clock, and the unit in which a file writes them.

Seconds since 1970 in ns need 61 bits, of which a float has 53: an origin is taken off, as integers, before
they become floats.
"""

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

Unit = Literal["s", "ms", "us", "ns"]
PER_SECOND: dict[Unit, int] = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
_LARGEST = Decimal(10) ** 19  # ns since 1970 until the year 2286
_SINCE_1970_S = (1e8, 4e9)  # from 1973 to 2096
_WHOLE_PERIOD_S = 2.0  # numbers that are all whole and so far apart are no seconds
FLOAT_S = 1e6  # below it float64 seconds hold whole ns


class Steps(NamedTuple):
    """How far apart [s] things of a kind are timestamped."""

    shortest: float
    longest: float  # by which a unit is found
    extreme: float  # at which the unit of a format is believed where no other makes sense


POSES = Steps(5e-4, 2.0, 3600.0)
READINGS = Steps(1.2e-4, 0.2, 1.0)  # of an IMU
_DIGITS_NS = 1e3  # steps of ns below it have no decimals
_LEAST_S = 1e-5  # steps below it make no sense


def to_decimal(word: str) -> Decimal | None:
    """A number as it is written, to its last digit; None for what is none, NaN and what no clock shows."""
    try:
        number = Decimal(word)
    except InvalidOperation:
        return None
    return number if number.is_finite() and -_LARGEST < number < _LARGEST else None


def to_ns(number: Decimal, unit: Unit) -> int:
    """A timestamp in whole ns."""
    return round(number * (10**9 // PER_SECOND[unit]))


def units(numbers: Sequence[Decimal], expected: Unit, steps: Steps = POSES) -> list[Unit]:
    """The units that timestamps may be written in, by their size, their steps and their decimals.

    Args:
        numbers: Timestamps as a file has them.
        expected: The unit of its format, which is believed wherever it makes sense: a date from 1973 to 2096,
            or steps of up to five times the longest (of 2 s where all numbers are whole, which seconds of
            so few frames are not).
        steps: Of what is timestamped.

    Returns:
        One unit where there is no doubt, else every one that makes sense; none at all if none does.

    >>> units([Decimal(1403636580863555584), Decimal(1403636580913555584)], "s")
    ['ns']
    >>> units([Decimal(0), Decimal(60), Decimal(120)], "s")
    ['s', 'ms']
    """
    latest = float(max(abs(number) for number in numbers))
    size = {unit: latest / PER_SECOND[unit] for unit in get_args(Unit)}
    dated = [unit for unit, s in size.items() if _SINCE_1970_S[0] <= s <= _SINCE_1970_S[1]]
    whole = all(number == number.to_integral_value() for number in numbers)
    step = _median_step(numbers)
    if not whole and (step is None or step < _DIGITS_NS):
        size.pop("ns")
    if expected in dated and expected in size:
        return [expected]
    if size.get(expected, np.inf) > _SINCE_1970_S[1] and dated:
        return dated
    if step is None:
        return [expected] if expected in size else list(size)
    period = {unit: step / PER_SECOND[unit] for unit in size}
    longest = _WHOLE_PERIOD_S if whole and expected == "s" else 5 * steps.longest
    if expected in period and steps.shortest <= period[expected] <= longest:
        return [expected]
    if dated:
        return dated
    usual = [u for u, s in period.items() if u != expected and steps.shortest <= s <= steps.longest]
    possible = _LEAST_S <= period.get(expected, 0.0) <= steps.extreme
    return [expected, *usual] if possible else usual


def origin(ns: Sequence[int]) -> int:
    """Where time is 0, so that float64 seconds hold whole ns: the first timestamp, or 0 where it is as good.

    >>> origin([1403715523912140001, 1403715523917140001]), origin([5_000_000, 10_000_000])
    (1403715523912140001, 0)
    """
    return ns[0] if len(ns) and max(abs(ns[0]), abs(ns[-1])) > FLOAT_S * 1e9 else 0


def format_seconds(t: Float[np.ndarray, " n"], t0_ns: int) -> list[str]:
    """Seconds since `t0_ns` as decimal seconds of the clock that it is on, to the last digit.

    >>> format_seconds(np.array([0.0, 0.005]), 1403715523912140001)
    ['1403715523.912140001', '1403715523.917140001']
    """
    if t0_ns == 0:
        return [repr(s) for s in t.tolist()]
    return [format_ns(timestamp) for timestamp in whole_ns(t, t0_ns)]


def format_ns(ns: int) -> str:
    """Whole ns as decimal seconds, without zeros at the end.

    >>> format_ns(1403715523912140000), format_ns(-5)
    ('1403715523.91214', '-0.000000005')
    """
    whole, rest = divmod(abs(ns), 10**9)
    sign = "-" if ns < 0 else ""
    return f"{sign}{whole}.{rest:09d}".rstrip("0") + ("0" if rest == 0 else "")


def whole_ns(t: Float[np.ndarray, " n"], t0_ns: int) -> list[int]:
    """Seconds since `t0_ns` in whole ns on the clock that it is on."""
    return [t0_ns + round(s * 1e9) for s in t.tolist()]


def _median_step(numbers: Sequence[Decimal]) -> float | None:
    steps = [float(b - a) for a, b in zip(numbers, numbers[1:], strict=False) if b > a]
    return float(np.median(steps)) if steps else None
