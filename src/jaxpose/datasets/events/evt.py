"""Prophesee's encodings of events, EVT 2.0, 2.1 and 3.0, by its documentation, decoded a piece at a time.

A decoder takes words and gives events with timestamps in microseconds; what it carries from one piece to the
next is its state. Their clocks have 34 or 24 bits, in a file of any length: a high part that falls by half a
turn or more has begun the next turn, as in the vendor's decoder. A file that says nothing for longer than a
turn of EVT 3.0's, 16.8 s, has lost the turn; cameras write the high part all the time.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxpose.datasets.events.stream import Block

_TIME_HIGH, _TIME_LOW = 8, 6


class _Clock:
    """The high part of timestamps, which turns over."""

    def __init__(self, bits: int):
        self.turn = 1 << bits
        self.high = self.turns = 0
        self.begun = False

    def advance(self, high: np.ndarray) -> np.ndarray:
        """The high part with its turns: before any of those that words state, then after each."""
        fell = np.diff(high, prepend=self.high if self.begun else high[:1]) <= -(self.turn // 2)
        whole = high + self.turn * (self.turns + np.cumsum(fell))
        before = self.high + self.turn * self.turns
        if len(high):
            self.high, self.turns, self.begun = int(high[-1]), self.turns + int(fell.sum()), True
        return np.concatenate([[before], whole])


class Evt2:
    """EVT 2.0: words of 32 bits, an event each, or the upper 28 bits of the clock."""

    kind = np.dtype("<u4")

    def __init__(self) -> None:
        self.clock, self.dropped = _Clock(28), 0

    def decode(self, words: np.ndarray) -> Block:
        """Events of the words; those before the first time are counted in `dropped`."""
        events, high = self._dated((words >> 28).astype(np.uint8), words)
        word = words[events]
        t = (high << 6) | ((word >> 22) & 0x3F)
        return Block(t, (word >> 11) & 0x7FF, word & 0x7FF, (word >> 28).astype(np.int8))

    def _dated(self, kind: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of events that have a time, and its high part."""
        says, begun = np.flatnonzero(kind == _TIME_HIGH), self.clock.begun
        table = self.clock.advance((upper[says] & 0xFFFFFFF).astype(np.int64))
        events = np.flatnonzero(kind <= 1)
        if not begun:
            dated = events >= (says[0] if len(says) else len(kind))
            self.dropped += int((~dated).sum())
            events = events[dated]
        return events, _held(table, says, len(kind))[events]


class Evt21(Evt2):
    """EVT 2.1: words of 64 bits, 32 pixels of a row and a polarity each."""

    kind = np.dtype("<u8")

    def decode(self, words: np.ndarray) -> Block:
        """Events of the words, as `Evt2` does."""
        kind = (words >> np.uint64(60)).astype(np.uint8)
        upper = (words >> np.uint64(32)).astype(np.uint32)
        vectors, high = self._dated(kind, upper)
        row, bit = _set_bits(words[vectors].astype(np.uint32), 32)
        vectors = vectors[row]
        word = upper[vectors]
        t = (high[row] << 6) | ((word >> 22) & 0x3F)
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
        kind, begun = (words >> 12).astype(np.uint8), self.clock.begun
        says, rows = np.flatnonzero((kind == _TIME_LOW) | (kind == _TIME_HIGH)), np.flatnonzero(kind == 0)
        is_high = kind[says] == _TIME_HIGH
        times, ys = self._times(words[says], is_high), np.append(np.int32(self.state.y), words[rows] & 0x7FF)
        self.state = self.state._replace(y=int(ys[-1]))
        at, x, polarity = self._pixels(kind, words)
        t, y = _held(times, says, len(words))[at], _held(ys, rows, len(words))[at]
        if not begun or ys[0] < 0:
            first = 0 if begun else int(says[is_high.argmax()]) if is_high.any() else len(words)
            dated = (at >= first) & (y >= 0)
            self.dropped += int((~dated).sum())
            t, x, y, polarity = t[dated], x[dated], y[dated], polarity[dated]
        return Block(t, x, y, polarity.astype(np.int8))

    def _times(self, stated: np.ndarray, is_high: np.ndarray) -> np.ndarray:
        """The clock before any of the words that state a part of it, and after each."""
        value, rows = (stated & 0xFFF).astype(np.int64), np.flatnonzero(is_high)
        highs = self.clock.advance(value[rows])
        high = _held(highs, rows, len(value))
        # A high part that changes makes the low one 0, until the next of those; else it leaves it as it was.
        behind_low = (rows > 0) & ~is_high[rows - 1]
        changes = np.diff(highs) != 0
        renews, low = changes | behind_low, np.where(changes, 0, value[rows - 1])
        last = np.maximum.accumulate(np.where(renews, np.arange(len(rows)), -1))
        value[rows] = np.where(last < 0, self.state.low, low[last])
        before = (int(highs[0]) << 12) | self.state.low
        if len(value):
            self.state = self.state._replace(low=int(value[-1]))
        return np.append(before, (high << 12) | value)

    def _pixels(self, kind: np.ndarray, words: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of the events' words, columns and polarities: single ones, and those of vectors."""
        has_vectors = ((kind >= 3) & (kind <= 5)).any()
        if not has_vectors:
            at = np.flatnonzero(kind == 2)
            value = words[at]
            return at, value & 0x7FF, (value >> 11) & 1
        rows = np.flatnonzero((kind >= 2) & (kind <= 5))
        kind, value = kind[rows], (words[rows] & 0xFFF).astype(np.int64)
        last, base = _latest(kind == 3, value, self.state.base | (self.state.polarity << 11))
        # Every vector moves the column on by its own width.
        width = np.where(kind == 4, 12, np.where(kind == 5, 8, 0))
        moved = np.cumsum(width)
        start = (base & 0x7FF) + moved - width - np.where(last < 0, 0, moved[np.maximum(last, 0)])
        self.state = self.state._replace(base=int(start[-1] + width[-1]), polarity=int(base[-1] >> 11))
        bits = np.where(kind == 2, 1, np.where(kind == 4, value, np.where(kind == 5, value & 0xFF, 0)))
        holders = np.flatnonzero(bits)
        row, bit = _set_bits(bits[holders].astype(np.uint32), 12)
        row = holders[row]
        single = kind[row] == 2
        x = np.where(single, value[row] & 0x7FF, start[row] + bit)
        return rows[row], x, np.where(single, value[row] >> 11, base[row] >> 11)


def _held(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """For each of `count` words the value that holds: the first before `rows`, then each from its row on."""
    return np.repeat(values, np.diff(rows, prepend=0, append=count))


def _latest(states: np.ndarray, value: np.ndarray, before: int) -> tuple[np.ndarray, np.ndarray]:
    """For each word the row of the latest one that states something, -1: none here, and what it states."""
    row = np.maximum.accumulate(np.where(states, np.arange(len(states)), -1))
    return row, np.where(row < 0, before, value[np.maximum(row, 0)])


def _set_bits(masks: np.ndarray, width: int) -> tuple[np.ndarray, Any]:
    """Rows and places of the bits that are set, from the lowest, row by row."""
    octets = masks.astype("<u4").view(np.uint8).reshape(-1, 4)[:, : -(-width // 8)]
    row, place = np.nonzero(np.unpackbits(octets, axis=1, bitorder="little"))
    return row, place
