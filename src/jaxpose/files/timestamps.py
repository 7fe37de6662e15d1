"""Timestamps: whole nanoseconds on a file's own clock, and the unit in which a file writes them.

Seconds since 1970 in ns need 61 bits, of which a float has 53: an origin is taken off, as integers, before
they become floats.
"""

from collections.abc import Sequence
from decimal import Context, Decimal, InvalidOperation
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int

from jaxpose.errors import DataError
from jaxpose.files.schema import LATEST_S

Unit = Literal["s", "ms", "us", "ns"]
PER_SECOND: dict[Unit, int] = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
_LARGEST = 10**19  # ns since 1970 until the year 2286
_MOST_DIGITS = 400  # decimals of a number; float64 has none behind them
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
_FARTHEST_S = 1e6  # steps above it are no dates of one recording


class Stamps(NamedTuple):
    """Timestamps to their last digit."""

    whole: list[int]  # in units of 10^-digits
    digits: int

    def ns(self, unit: Unit) -> list[int]:
        """In whole ns, if `unit` is what they are written in."""
        per, scale = 10**9 // PER_SECOND[unit], 10**self.digits
        if per % scale:
            return [_rounded(number * per, scale) for number in self.whole]
        return self.whole if per == scale else [number * (per // scale) for number in self.whole]

    def since(self, t0_ns: int, unit: Unit) -> Float[np.ndarray, " n"]:
        """In seconds since `t0_ns`, rounded once, if `unit` is what they are written in."""
        per = 10**self.digits * PER_SECOND[unit]
        scale = max(per, 10**9)
        factor, zero = scale // per, t0_ns * (scale // 10**9)
        return np.array([(number * factor - zero) / scale for number in self.whole], np.float64)

    def rows(self, kept: Sequence[int] | Int[np.ndarray, " m"]) -> "Stamps":
        """Those at some places."""
        return self._replace(whole=[self.whole[k] for k in kept])


def to_stamps(words: Sequence[str]) -> Stamps:
    """Timestamps as a file has them, without blanks around them.

    Args:
        words: Numbers, which `to_decimal` takes.

    Returns:
        The numbers.

    Raises:
        ValueError: For others.

    >>> to_stamps(["1403715523.91214", "1403715524"])
    Stamps(whole=[140371552391214, 140371552400000], digits=5)
    """
    try:
        return _plain_stamps(words)
    except ValueError:  # exponents, or what is none at all
        return _decimal_stamps(words)


def _plain_stamps(words: Sequence[str]) -> Stamps:
    """Numbers of digits and a point."""
    text, most = "".join(words), 0
    if "." in text:
        digits = [len(word) - at - 1 if (at := word.find(".")) >= 0 else 0 for word in words]
        most = max(digits)
        whole = [int(word.replace(".", "", 1)) for word in words]
        if min(digits) < most:
            whole = [number * 10 ** (most - count) for number, count in zip(whole, digits, strict=True)]
    else:
        whole = list(map(int, words))
    largest = _LARGEST * 10**most
    if "_" in text or most > _MOST_DIGITS or any(not -largest < number < largest for number in whole):
        raise ValueError("digits that are not that plain")
    return Stamps(whole, most)


def _decimal_stamps(words: Sequence[str]) -> Stamps:
    """Numbers in any notation."""
    numbers = [to_decimal(word) for word in words]
    known = [number for number in numbers if number is not None]
    if len(known) < len(numbers):
        raise ValueError("a timestamp that is none")
    exponents = [int(number.as_tuple().exponent) for number in known]
    digits = min(max(0, -min(exponents, default=0)), _MOST_DIGITS)
    context = Context(prec=_MOST_DIGITS + 30)
    return Stamps([round(context.scaleb(number, digits)) for number in known], digits)


def to_decimal(word: str) -> Decimal | None:
    """A number as it is written, to its last digit; None for what is none, NaN and what no clock shows."""
    try:
        number = Decimal(word)
    except InvalidOperation:
        return None
    return number if number.is_finite() and -_LARGEST < number < _LARGEST else None


def units(stamps: Stamps, expected: Unit, steps: Steps = POSES) -> list[Unit]:
    """The units that timestamps may be written in, by their size, their steps and their decimals.

    Args:
        stamps: Timestamps as a file has them, one at least.
        expected: The unit of its format, which is believed wherever it makes sense: a date from 1973 to 2096,
            or steps of up to five times the longest (of 2 s where all numbers are whole, which seconds of
            so few frames are not).
        steps: Of what is timestamped.

    Returns:
        One unit where there is no doubt, else every one that makes sense; none at all if none does.

    >>> units(to_stamps(["1403636580863555584", "1403636580913555584"]), "s")
    ['ns']
    >>> units(to_stamps(["0", "60", "120"]), "s")
    ['s', 'ms']
    """
    scale = 10**stamps.digits
    latest = max(map(abs, stamps.whole)) / scale
    size = {unit: latest / PER_SECOND[unit] for unit in get_args(Unit)}
    whole = stamps.digits == 0 or not any(number % scale for number in stamps.whole)
    step = _median_step(stamps)
    near = {unit: step is None or step / PER_SECOND[unit] <= _FARTHEST_S for unit in size}
    dated = [u for u, s in size.items() if _SINCE_1970_S[0] <= s <= _SINCE_1970_S[1] and near[u]]
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


def check_seconds(path: Path | str, t: Float[np.ndarray, " n"]) -> None:
    """DataError naming a file for what is no time until the year 2200."""
    bad = ~(np.abs(t) <= LATEST_S)
    if bad.any():
        raise DataError(f"{path}: expected timestamps until the year 2200, got {t[bad][0]:g} s")


def nanoseconds(path: Path | str, t: Float[np.ndarray, " n"]) -> list[int]:
    """Seconds of a file in whole ns; DataError naming it for what is no time until the year 2200."""
    check_seconds(path, t)
    return [round(s * 1e9) for s in t.tolist()]


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


def _median_step(stamps: Stamps) -> float | None:
    scale = 10**stamps.digits
    steps = [(b - a) / scale for a, b in zip(stamps.whole, stamps.whole[1:], strict=False) if b > a]
    return float(np.median(steps)) if steps else None


def _rounded(number: int, scale: int) -> int:
    """number / scale, to the nearest, to the even of two."""
    whole, rest = divmod(number, scale)
    return whole + (2 * rest > scale or (2 * rest == scale and whole % 2))
