"""Files of Prophesee's cameras: RAW (EVT 2.0, 2.1 and 3.0) and DAT, by the vendor's documentation."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jaxpose.datasets.events.evt import Evt2, Evt3, Evt21, Evt21Swapped
from jaxpose.datasets.events.stream import BLOCK, Block, Stream, stated_size
from jaxpose.errors import DataError
from jaxpose.files.opening import open_file

_Decoder = Evt2 | Evt3
_BYTES = 1 << 18  # read at a time
_LONGEST_HEADER = 1 << 16
_LAYOUT_WORDS = 4096  # that tell in which order the halves of EVT 2.1's words are
_CD = (0x00, 0x0C)  # types of events in DAT that are changes of contrast
_LATEST_US = 1_000_000  # behind the one before, that an event is rather than of the next turn
_DAT_EVENT = np.dtype([("t", "<u4"), ("address", "<u4")])


def raw_stream(file: Path) -> Stream:
    """The events of a RAW file; timestamps are microseconds since the camera was started."""
    with open_file(file) as stream:
        header = _header(file, stream)
        decoder = _decoder(file, header, stream)
    dropped: list[_Decoder] = []
    cut: list[int] = []  # bytes of a last word that is not whole

    def blocks() -> Iterator[Block]:
        current = decoder()
        dropped[:], cut[:] = [current], []
        with open_file(file) as stream:
            _header(file, stream)
            while data := stream.read(_BYTES):
                words, rest = divmod(len(data), current.kind.itemsize)
                cut.extend([rest] if rest else [])
                yield current.decode(np.frombuffer(data, current.kind, words))

    def notes() -> tuple[str, ...]:
        count = sum(current.dropped for current in dropped)
        told = [f"{count} events left out, before the first time or row of the file"] if count else []
        told += [f"the file ends within an event: its last {rest} bytes are left out" for rest in cut]
        return tuple(told)

    return Stream(
        file, blocks, lambda row: f"{file}: event {row}", "us", _size(file, header), notes, unit_is_sure=True
    )


def dat_stream(file: Path) -> Stream:
    """The events of a DAT file; its timestamps of 32 bits turn over every 72 minutes, which is undone."""
    with open_file(file) as stream:
        size = _size(file, _header(file, stream))
        _dat_type(file, stream)

    def blocks() -> Iterator[Block]:
        last, turns = 0, 0
        with open_file(file) as stream:
            _header(file, stream)
            _dat_type(file, stream)
            while data := stream.read(BLOCK * _DAT_EVENT.itemsize):
                events = np.frombuffer(data, _DAT_EVENT, len(data) // _DAT_EVENT.itemsize)
                t = events["t"].astype(np.int64)
                turned = turns + np.cumsum(np.diff(t, prepend=last) < -_LATEST_US)
                last, turns = (int(t[-1]), int(turned[-1])) if len(t) else (last, turns)
                address = events["address"]
                polarity = ((address >> 28) & 1).astype(np.int8)
                yield Block(t + (turned << 32), address & 0x3FFF, (address >> 14) & 0x3FFF, polarity)

    return Stream(file, blocks, lambda row: f"{file}: event {row}", "us", size, unit_is_sure=True)


def _header(file: Path, stream: BinaryIO) -> str:
    """The lines that begin with %, and the place behind them."""
    lines = []
    while True:
        place = stream.tell()
        if place > _LONGEST_HEADER:
            raise DataError(f"{file}: expected a header of lines that begin with %, got no end of it")
        if stream.read(1) != b"%":
            stream.seek(place)
            return "\n".join(lines)
        lines.append(stream.readline(_LONGEST_HEADER).decode("ascii", "replace").strip())
        if lines[-1] == "end":
            return "\n".join(lines)


def _size(file: Path, header: str) -> tuple[int, int] | None:
    """Width and height where a header states them."""
    found = re.search(r"^geometry:? *(\d+) *x *(\d+)", header, re.M | re.I)
    if found:
        return stated_size(file, found[1], found[2])
    sides = [re.search(rf"\b{name}[=: ] *(\d+)", header, re.I) for name in ("width", "height")]
    return stated_size(file, sides[0][1], sides[1][1]) if sides[0] and sides[1] else None


def _decoder(file: Path, header: str, stream: BinaryIO) -> type[_Decoder]:
    """The decoder of the format that a header states."""
    stated = re.search(r"^(?:format +EVT|evt +)([\d.]+)", header, re.M | re.I)
    version = stated[1].replace(".", "").removesuffix("0") if stated else "none"
    decoders: dict[str, type[_Decoder]] = {"2": Evt2, "3": Evt3}
    if version in decoders:
        return decoders[version]
    if version != "21":
        got = stated[0] if stated else "none"
        raise DataError(f"{file}: expected a header with evt 2.0, 2.1 or 3.0, got {got}")
    endianness = re.search(r"endianness=(\w+)", header, re.I)
    if endianness:
        return Evt21Swapped if endianness[1].lower() == "legacy" else Evt21
    content = stream.read(8 * _LAYOUT_WORDS)
    words = np.frombuffer(content, "<u8", len(content) // 8)
    # Words of time are of type 8, in the upper bits of that half which has the types.
    upper, lower = (int((((words >> np.uint64(place)) & np.uint64(15)) == 8).sum()) for place in (60, 28))
    return Evt21Swapped if lower > upper else Evt21


def _dat_type(file: Path, stream: BinaryIO) -> None:
    """Refuse other events than changes of contrast."""
    kind = stream.read(2)
    if len(kind) < 2 or kind[0] not in _CD or kind[1] != _DAT_EVENT.itemsize:
        raise DataError(
            f"{file}: expected a DAT file, events of type 0 or 12 and 8 bytes, got {list(kind) or 'its end'}"
        )
