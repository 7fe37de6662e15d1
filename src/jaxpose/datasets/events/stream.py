"""A file of events as a stream of blocks, brought to seconds and counted."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxpose.errors import DataError
from jaxpose.files.schema import LATEST_S

Unit = Literal["s", "us", "ns", "frames"]  # of timestamps; "frames": indices, of which one is taken for 1 s

BLOCK = 1 << 17  # events that are held in the file's own types at a time
_PER_SECOND: dict[Unit, float] = {"s": 1.0, "us": 1e6, "ns": 1e9, "frames": 1.0}
_RATES_HZ = (1e2, 1e10)  # of events, that a stated unit has to give
_FEWEST = 100  # events that tell a rate, or that are whole thousands by no chance
_SIDE_DIGITS = 5  # of the width of a sensor, at most


class Block(NamedTuple):
    """Consecutive events; from a reader in the file's own number types, (n,) each."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    polarity: np.ndarray


class Stream(NamedTuple):
    """A file of events that is read a block at a time."""

    file: Path
    blocks: Callable[[], Iterator[Block]]
    where: Callable[[int], str]  # the place of an event in the file, for messages
    unit: Unit | None = None  # that the format states
    size: tuple[int, int] | None = None  # width and height of the sensor, where the file states it
    notes: Callable[[], tuple[str, ...]] = tuple  # what was left out, once the blocks are read
    unit_is_sure: bool = False  # whether no rate of events speaks against the unit


class StreamStats(NamedTuple):
    """What a stream holds, counted before anything is left out or refused."""

    unit: Unit  # of the timestamps
    zero: float | int  # the timestamp that is time 0
    count: int = 0
    earliest: float = np.inf  # [s]
    latest: float = -np.inf
    low: tuple[int, int] = (0, 0)  # the least column and row, if below 0
    high: tuple[int, int] = (0, 0)  # the largest
    outside: int = 0  # events beyond the sensor
    polarities: frozenset[float] = frozenset()
    odd: int | None = None  # the first event whose polarity is none of -1, 0 and 1
    back: int = 0  # events that are earlier than one before
    most_back: float = 0.0  # [s]
    first_back: int | None = None


def stream_stats(
    stream: Stream, size: tuple[int, int], unit: Unit | None, zero: int | None
) -> Iterator[tuple[StreamStats, Block]]:
    """Blocks with t in seconds (float64), and what was counted up to and with each."""
    stats, seen = None, 0
    for block in stream.blocks():
        if not len(block.t):
            continue
        check_numbers(stream, block, seen)
        _check_times(stream, block.t, seen, _PER_SECOND["ns" if stats is None else stats.unit])
        block = block._replace(t=block.t.astype(np.float64 if block.t.dtype.kind == "f" else np.int64))
        if stats is None:
            first = zero if zero is not None else block.t[0].item()
            stats = StreamStats(unit or _possible(block.t, stream) or find_unit(block.t), first)
            _check_times(stream, block.t, seen, _PER_SECOND[stats.unit])
        # Integers as integers: float64 has not the digits for nanoseconds since 1970.
        t = (block.t - block.t.dtype.type(stats.zero)).astype(np.float64) / _PER_SECOND[stats.unit]
        block = block._replace(t=t)
        stats = _add(stats, block, size, seen)
        seen += len(t)
        yield stats, block


def count(stream: Stream, size: tuple[int, int], *, most: int) -> StreamStats:
    """What the first events of a stream hold, `most` or a little more, faults included.

    DataError as `clean` for what is no number, NaN, or no event at all; nothing else is refused.
    """
    stats = None
    for stats, _ in stream_stats(stream, size, None, None):
        if stats.count >= most:
            break
    if stats is None:
        raise DataError(f"{stream.file}: expected events, got none")
    return stats


def stated_size(file: Path, width: str, height: str) -> tuple[int, int]:
    """Width and height of the sensor, of which a file of events has the digits."""
    if len(width) > _SIDE_DIGITS or len(height) > _SIDE_DIGITS or not int(width) or not int(height):
        raise DataError(f"{file}: expected width and height of a sensor, got {width[:20]} x {height[:20]}")
    return int(width), int(height)


def inside(block: Block, size: tuple[int, int]) -> Bool[np.ndarray, " n"]:
    """Which events are on a sensor of `size` (width, height)."""
    return (block.x >= 0) & (block.x < size[0]) & (block.y >= 0) & (block.y < size[1])


def reach(stats: StreamStats) -> str:
    """The pixels that events fall on, in words."""
    low = f"from {stats.low[0]}, {stats.low[1]} " if min(stats.low) < 0 else "up "
    return f"{low}to {stats.high[0]}, {stats.high[1]}"


def in_words(polarities: frozenset[float]) -> str:
    """Polarities in words."""
    return " and ".join(f"{value:g}" for value in sorted(polarities))


def find_unit(t: np.ndarray) -> Unit:
    """The unit of the timestamps of consecutive events, by their size and by how many of them fall on a unit.

    From 1e17 on they are nanoseconds, from 1e14 microseconds since 1970. Timestamps with fractions are
    seconds from 1 event per unit on. Whole ones are frame indices from 30 events per unit on within a span of
    up to 1e5 units; nanoseconds if a hundred or more are all whole thousands, as sensors count microseconds.
    What is left is microseconds from 1e-3 events per unit on (1 kHz), and nanoseconds below.
    """
    span, latest = float(t.max()) - float(t.min()), float(np.abs(t).max())
    rate = len(t) / span if span else np.inf
    whole = t.dtype.kind != "f" or bool((t == np.round(t)).all())
    if latest >= 1e14:
        return "ns" if latest >= 1e17 else "us"
    if not whole and rate >= 1:
        return "s"
    if whole and rate >= 30 and span <= 1e5:
        return "frames"
    if whole and len(t) >= _FEWEST and not (t % 1000).any():
        return "ns"
    return "us" if rate >= 1e-3 else "ns"


def seconds(stats: StreamStats) -> float:
    """Time 0 on the clock of the file [s]."""
    return float(stats.zero) / _PER_SECOND[stats.unit]


def _add(stats: StreamStats, block: Block, size: tuple[int, int], seen: int) -> StreamStats:
    """The stats with one more block, which begins with event `seen`."""
    t, x, y, polarity = block
    # How far each event lies behind the latest of those before it.
    behind = np.maximum.accumulate(np.concatenate([[stats.latest], t[:-1]])) - t
    back = np.flatnonzero(behind > 0)
    known = (polarity == 1) | (polarity == 0) | (polarity == -1)
    values = {float(value) for value in (-1, 0, 1) if (polarity == value).any()}
    odd = stats.odd
    if odd is None and not known.all():
        odd = seen + int(known.argmin())
    values |= {float(value) for value in polarity[~known][:1]}
    return stats._replace(
        count=stats.count + len(t),
        earliest=min(stats.earliest, float(t.min())),
        latest=max(stats.latest, float(t.max())),
        low=(min(stats.low[0], int(x.min())), min(stats.low[1], int(y.min()))),
        high=(max(stats.high[0], int(x.max())), max(stats.high[1], int(y.max()))),
        outside=stats.outside + int((~inside(block, size)).sum()),
        polarities=stats.polarities | values,
        odd=odd,
        back=stats.back + len(back),
        most_back=max(stats.most_back, float(behind.max())),
        first_back=seen + int(back[0]) if stats.first_back is None and len(back) else stats.first_back,
    )


def check_numbers(stream: Stream, block: Block, seen: int) -> None:
    """Refuse other things than numbers, NaN and infinity, and pixels between pixels."""
    for name, values in block._asdict().items():
        if values.dtype.kind not in ("iuf" if name == "t" else "biuf"):
            raise DataError(f"{stream.file}: expected numbers for {name}, got {values.dtype}")
        if values.dtype.kind == "f":
            usable = np.isfinite(values) if name == "t" else values == np.round(values)
            usable &= np.isfinite(values)
            if not usable.all():
                row = int(usable.argmin())
                wanted = "a finite timestamp" if name == "t" else f"a whole number for {name}"
                raise DataError(f"{stream.where(seen + row)}: expected {wanted}, got {values[row]:g}")


def _check_times(stream: Stream, t: np.ndarray, seen: int, per_second: float) -> None:
    """Refuse timestamps that are not of this time: differences of them would overflow."""
    latest = max(float(t.max()), -float(t.min()))
    if not latest <= LATEST_S * per_second:
        row = int(np.argmax(np.abs(t.astype(np.float64))))
        raise DataError(
            f"{stream.where(seen + row)}: expected a timestamp before the year 2200, got {t[row]:g}"
        )


def _possible(t: np.ndarray, stream: Stream) -> Unit | None:
    """The stated unit if the events then come at a rate that a sensor has, or if they are too few to tell."""
    span, stated = float(t.max()) - float(t.min()), stream.unit
    if stated is None or stream.unit_is_sure or not span or len(t) < _FEWEST:
        return stated
    return stated if _RATES_HZ[0] <= len(t) / span * _PER_SECOND[stated] <= _RATES_HZ[1] else None
