"""Prophesee's encodings of events, EVT 2.0, 2.1 and 3.0, by its documentation, decoded a piece at a time.

A decoder takes words and gives events with timestamps in microseconds; what it carries from one piece to the
next is its state. Their clocks have 34 or 24 bits, in a file of any length: a high part that falls by half a
turn or more has begun the next turn, as in the vendor's decoder. A file that says nothing for longer than a
turn of EVT 3.0's, 16.8 s, has lost the turn; cameras write the high part all the time.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxpose.datasets.events.stream import Block

_TIME_HIGH = 8


class _Clock:
    """The high part of timestamps, which turns over."""

    def __init__(self, bits: int):
        self.turn = 1 << bits
        self.high = self.turns = 0
        self.begun = False

    def at(self, rows: np.ndarray, high: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """For each of `count` words the high part with its turns, and the row where it last changed.

        `rows` are the words that state a high part; -1 is before them.
        """
        fell = np.diff(high, prepend=self.high if self.begun else high[:1]) <= -(self.turn // 2)
        whole = high + self.turn * (self.turns + np.cumsum(fell))
        before = self.high + self.turn * self.turns
        if len(high):
            self.high, self.turns, self.begun = int(high[-1]), self.turns + int(fell.sum()), True
        table = np.concatenate([[before], whole])
        changed = np.concatenate([[-1], np.where(np.diff(table) != 0, rows, -1)])
        index = np.searchsorted(rows, np.arange(count), side="right")
        return table[index], np.maximum.accumulate(changed)[index]


class Evt2:
    """EVT 2.0: words of 32 bits, an event each, or the upper 28 bits of the clock."""

    kind = np.dtype("<u4")

    def __init__(self) -> None:
        self.clock, self.dropped = _Clock(28), 0

    def decode(self, words: np.ndarray) -> Block:
        """Events of the words; those before the first time are counted in `dropped`."""
        kind = words >> 28
        rows = np.flatnonzero(kind == _TIME_HIGH)
        begun = self.clock.begun
        high, _ = self.clock.at(rows, (words[rows] & 0xFFFFFFF).astype(np.int64), len(words))
        events = np.flatnonzero(kind <= 1)
        events = self._dated(events, begun, rows)
        word = words[events]
        t = (high[events] << 6) | ((word >> 22) & 0x3F).astype(np.int64)
        return Block(t, (word >> 11) & 0x7FF, word & 0x7FF, (word >> 28).astype(np.int8))

    def _dated(self, events: np.ndarray, begun: bool, rows: np.ndarray) -> np.ndarray:
        """Rows of events that have a time."""
        first = 0 if begun else (int(rows[0]) if len(rows) else len(events) and int(events[-1]) + 1)
        dated = events[events >= first]
        self.dropped += len(events) - len(dated)
        return dated


class Evt21(Evt2):
    """EVT 2.1: words of 64 bits, 32 pixels of a row and a polarity each."""

    kind = np.dtype("<u8")

    def decode(self, words: np.ndarray) -> Block:
        """Events of the words, as `Evt2` does."""
        kind = (words >> np.uint64(60)).astype(np.int8)
        upper = (words >> np.uint64(32)).astype(np.uint32)
        rows = np.flatnonzero(kind == _TIME_HIGH)
        begun = self.clock.begun
        high, _ = self.clock.at(rows, (upper[rows] & 0xFFFFFFF).astype(np.int64), len(words))
        vectors = np.flatnonzero((kind == 0) | (kind == 1))
        vectors = self._dated(vectors, begun, rows)
        row, bit = _set_bits(words[vectors].astype(np.uint32), 32)
        vectors = vectors[row]
        word = upper[vectors]
        t = (high[vectors] << 6) | ((word >> 22) & 0x3F).astype(np.int64)
        return Block(t, ((word >> 11) & 0x7FF) + bit, word & 0x7FF, kind[vectors])


class Evt21Swapped(Evt21):
    """EVT 2.1 as the IMX636 sends it, the upper half of each word first ("legacy")."""

    def decode(self, words: np.ndarray) -> Block:
        """Events of the words, as `Evt2` does."""
        return super().decode((words << np.uint64(32)) | (words >> np.uint64(32)))


class _Evt3State(NamedTuple):
    low: int = 0  # of the clock
    y: int = -1
    base: int = 0  # column of the next vector
    polarity: int = 0


class Evt3:
    """EVT 3.0: words of 16 bits, each of which states what has changed."""

    kind = np.dtype("<u2")

    def __init__(self) -> None:
        self.clock, self.dropped, self.state = _Clock(12), 0, _Evt3State()

    def decode(self, words: np.ndarray) -> Block:
        """Events of the words; those before the first time or row are counted in `dropped`."""
        kind, value, count = words >> 12, (words & 0xFFF).astype(np.int64), len(words)
        rows = np.flatnonzero(kind == _TIME_HIGH)
        first = 0 if self.clock.begun else (int(rows[0]) if len(rows) else count)
        high, changed = self.clock.at(rows, value[rows], count)
        last_low, low = _latest(kind == 6, value, self.state.low)
        low = np.where(changed > last_low, 0, low)  # until the next low part, after a new high one
        last_y, y = _latest(kind == 0, value & 0x7FF, self.state.y)
        last_base, base = _latest(kind == 3, value, self.state.base | (self.state.polarity << 11))
        # Every vector moves the column on by its own width.
        width = np.where(kind == 4, 12, np.where(kind == 5, 8, 0))
        moved = np.cumsum(width)
        before = moved - width
        start = (base & 0x7FF) + before - np.where(last_base < 0, 0, moved[np.maximum(last_base, 0)])
        if count:
            self.state = _Evt3State(int(low[-1]), int(y[-1]), int(start[-1] + width[-1]), int(base[-1] >> 11))
        # Single events and vectors, in the order of their words.
        bits = np.where(kind == 2, 1, np.where(kind == 4, value, np.where(kind == 5, value & 0xFF, 0)))
        holders = np.flatnonzero(bits)
        row, bit = _set_bits(bits[holders].astype(np.uint32), 12)
        at = holders[row]
        dated = (at >= first) & (y[at] >= 0)
        self.dropped += int((~dated).sum())
        at, bit = at[dated], bit[dated]
        single = kind[at] == 2
        x = np.where(single, value[at] & 0x7FF, start[at] + bit)
        polarity = np.where(single, value[at] >> 11, base[at] >> 11)
        return Block((high[at] << 12) | low[at], x, y[at], polarity.astype(np.int8))


def _latest(states: np.ndarray, value: np.ndarray, before: int) -> tuple[np.ndarray, np.ndarray]:
    """For each word the row of the latest one that states something, -1: none here, and what it states."""
    row = np.maximum.accumulate(np.where(states, np.arange(len(states)), -1))
    return row, np.where(row < 0, before, value[np.maximum(row, 0)])


def _set_bits(masks: np.ndarray, width: int) -> tuple[np.ndarray, Any]:
    """Rows and places of the bits that are set, from the lowest, row by row."""
    octets = masks.astype("<u4").view(np.uint8).reshape(-1, 4)[:, : -(-width // 8)]
    row, place = np.nonzero(np.unpackbits(octets, axis=1, bitorder="little"))
    return row, place
