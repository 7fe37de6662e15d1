"""Event Stream files (`.es`, version 2) of events of a DVS, by their specification.

Rows count from below in them; here they count from above.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxpose.datasets.events.stream import Block, Stream
from jaxpose.errors import DataError
from jaxpose.files.opening import open_file

MAGIC = b"Event Stream"
_DVS, _HEADER = 1, 20
_OVERFLOW, _RESET = 0xFF, 0xFE  # in place of a first byte: 127 us more, and nothing
_EVENT = 5  # bytes: time since the last event and polarity, column, row
_BYTES = 1 << 20


def es_stream(file: Path) -> Stream:
    """The events of an Event Stream file; timestamps are microseconds since the beginning of the file."""
    with open_file(file) as stream:
        head = stream.read(_HEADER)
    if len(head) < _HEADER or not head.startswith(MAGIC) or head[12] != 2 or head[15] != _DVS:
        got = f"version {head[12]} of type {head[15]}" if len(head) > 15 else "its end"
        raise DataError(f"{file}: expected an Event Stream file, version 2 of type 1 (DVS), got {got}")
    width, height = np.frombuffer(head[16:], "<u2").tolist()

    def blocks() -> Iterator[Block]:
        elapsed, rest = 0, b""
        with open_file(file) as stream:
            stream.seek(_HEADER)
            while data := stream.read(_BYTES):
                raw = np.frombuffer(rest + data, np.uint8)
                at, late, end = _places(raw)
                byte = raw[at].astype(np.int64)
                t = elapsed + np.cumsum((byte >> 1) + late[:-1])
                elapsed = (int(t[-1]) if len(t) else elapsed) + int(late[-1])
                rest = raw[end:].tobytes()
                x = raw[at + 1] + (raw[at + 2].astype(np.uint16) << 8)
                y = raw[at + 3] + (raw[at + 4].astype(np.uint16) << 8)
                yield Block(t, x, height - 1 - y.astype(np.int64), (byte & 1).astype(np.int8))

    return Stream(file, blocks, lambda row: f"{file}: event {row}", "us", (width, height), unit_is_sure=True)


def _places(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Where events begin, the time [us] of the overflows before each and behind the last, and the end.

    From an event on every fifth byte begins another, up to the next overflow: found by where in each of the
    five phases the next byte of its kind is.
    """
    special = [phase + _EVENT * np.flatnonzero(raw[phase::_EVENT] >= _RESET) for phase in range(_EVENT)]
    plain = np.flatnonzero(raw < _RESET)
    runs: list[np.ndarray] = []
    late: list[tuple[int, int]] = []  # number of the event, and time before it
    at, events, size = 0, 0, len(raw)
    while at < size:
        if raw[at] >= _RESET:
            row = int(np.searchsorted(plain, at))
            end = int(plain[row]) if row < len(plain) else size
            overflows = int((raw[at:end] == _OVERFLOW).sum())
            late.append((events, 127 * overflows))
            at = end
            continue
        ahead = special[at % _EVENT]
        row = int(np.searchsorted(ahead, at))
        end = int(ahead[row]) if row < len(ahead) else size
        count = -(-(end - at) // _EVENT)
        count = min(count, (size - at) // _EVENT)  # the last event may be cut off
        if count == 0:
            break
        runs.append(at + _EVENT * np.arange(count))
        events, at = events + count, at + _EVENT * count
    places = np.concatenate(runs) if runs else np.zeros(0, np.int64)
    before = np.zeros(len(places) + 1, np.int64)
    for event, us in late:
        before[event] += us
    return places, before, at
