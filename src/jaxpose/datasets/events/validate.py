"""Events made fit for use: in order, on the sensor, with polarities 1 and -1; or refused in one line."""

from typing import NamedTuple

import numpy as np

from jaxpose.datasets.events.stream import Stream, StreamStats, Unit, in_words, inside, reach, stream_stats
from jaxpose.errors import DataError
from jaxpose.events import Events

_WORDS: dict[Unit, str] = {
    "s": "seconds",
    "us": "microseconds",
    "ns": "nanoseconds",
    "frames": "frame indices",
}
_MOST_OUTSIDE = 0.1  # share of the events; more is another sensor
_MOST_BACK = 0.01  # share of the events that are earlier than one before; more is no order
_MOST_BACK_S = 0.01  # by which one may be (of indices: 1); more is a clock that jumped, or two recordings


class Read(NamedTuple):
    """Events in order, what was counted while reading, and notes for the user."""

    events: Events
    stats: StreamStats
    notes: tuple[str, ...]


def clean(
    stream: Stream,
    size: tuple[int, int],
    *,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
    zero: int | None = None,
) -> Read:
    """The events of a stream, or those from span[0] to before span[1] [s], in 13 bytes each.

    Time 0 is the timestamp `zero`, else the first in the file. Timestamps are in `unit`; without it in the
    unit that the format states or, if that gives no possible rate, that `find_unit` finds, which a note then
    says. Polarities are 0 and 1, or -1 and 1. Events outside the sensor of `size` (width, height) are left
    out and counted in a note; more than 10% of them are refused. Up to 1% may be earlier than one before, by
    up to 10 ms (of indices: 1), as readout mixes them: they are sorted, equal timestamps in the order of the
    file, and counted in a note; more is refused. Events that repeat others are kept.

    DataError naming file and line (or event) for what is refused, for NaN and infinity, for pixels that are
    no whole numbers, and for no event at all; ValueError for a span that does not rise.
    """
    check_span(span)
    stats, columns = None, ([], [], [], [])
    for stats, block in stream_stats(stream, size, unit, zero):
        if stats.odd is not None:
            break
        kept = inside(block, size)
        if span is not None:
            kept &= (span[0] <= block.t) & (block.t < span[1])
        for column, values, kind in zip(
            columns, block, (np.float64, np.uint16, np.uint16, np.int8), strict=True
        ):
            column.append(values[kept].astype(kind))
        if span is not None and stats.latest >= span[1] + _most_back(stats.unit):
            break
    _refuse(stream, size, stats)
    if stats is None or not any(map(len, columns[0])):
        raise DataError(f"{stream.file}: expected events, got none" + (_span_in_words(span) if span else ""))
    t, x, y, polarity = (_joined(column) for column in columns)
    if 0.0 in stats.polarities:
        polarity = np.where(polarity == 0, np.int8(-1), polarity)
    if stats.back:
        order = np.argsort(t, kind="stable")
        t, x, y, polarity = t[order], x[order], y[order], polarity[order]
    return Read(Events(t, x, y, polarity), stats, _notes(stream, size, unit, stats))


def check_span(span: tuple[float, float] | None) -> None:
    """ValueError for a span that does not rise."""
    if span is not None and not span[0] < span[1]:
        raise ValueError(f"span: expected two rising times [s], got {span[0]:g} and {span[1]:g}")


def _most_back(unit: Unit) -> float:
    return 1.0 if unit == "frames" else _MOST_BACK_S


def _joined(column: list[np.ndarray]) -> np.ndarray:
    """One array of many, which are let go at once."""
    whole = np.concatenate(column)
    column.clear()
    return whole


def _refuse(stream: Stream, size: tuple[int, int], stats: StreamStats | None) -> None:
    """DataError for polarities, pixels and an order that cannot be meant."""
    if stats is None:
        return
    polarities = "polarities 0 and 1, or -1 and 1"
    if stats.odd is not None:
        value = max(stats.polarities - {-1.0, 0.0, 1.0})
        raise DataError(f"{stream.where(stats.odd)}: expected {polarities}, got {value:g}")
    if {-1.0, 0.0} <= stats.polarities:
        raise DataError(f"{stream.file}: expected {polarities}, got {in_words(stats.polarities)}")
    if stats.outside > _MOST_OUTSIDE * stats.count:
        raise DataError(
            f"{stream.file}: expected pixels of {size[0]}x{size[1]}, got {stats.outside} of {stats.count} "
            f"events outside, {reach(stats)}"
        )
    if stats.back > _MOST_BACK * stats.count or stats.most_back > _most_back(stats.unit):
        raise DataError(
            f"{stream.where(stats.first_back or 0)}: expected events in the order of time, got "
            f"{stats.back} of {stats.count} earlier than one before, by up to {stats.most_back:.3g} s"
        )


def _notes(stream: Stream, size: tuple[int, int], unit: Unit | None, stats: StreamStats) -> tuple[str, ...]:
    """What was guessed, left out and sorted."""
    notes = list(stream.notes())
    if unit is None and stats.unit != stream.unit:
        span = stats.latest - stats.earliest
        note = f"timestamps read as {_WORDS[stats.unit]}"
        if stream.unit is not None:
            note += f", as in the format's {_WORDS[stream.unit]} their rate would be impossible"
        if stats.unit == "frames":
            note += f", 1 s each: {stats.count} events in {span:.4g} frames"
        elif span:
            note += f": {stats.count} events in {span:.4g} s, {stats.count / span:.3g} Hz"
        notes.append(note)
    if stats.outside:
        notes.append(
            f"{stats.outside} of {stats.count} events left out, outside the sensor of {size[0]}x{size[1]}: "
            f"{reach(stats)}"
        )
    if stats.back:
        notes.append(
            f"{stats.back} of {stats.count} events were earlier than one before, by up to "
            f"{stats.most_back:.3g} s: sorted"
        )
    return tuple(notes)


def _span_in_words(span: tuple[float, float]) -> str:
    return f" from {span[0]:g} to {span[1]:g} s"
