"""AEDAT 4 files of iniVation's cameras, by the package `aedat` (extra `events`)."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

from jaxpose.datasets.events.stream import Block, Stream
from jaxpose.errors import DataError
from jaxpose.files.opening import open_file

MAGIC = b"#!AER-DAT4.0"


def aedat4_stream(file: Path) -> Stream:
    """The events of an AEDAT 4 file, of its first stream of them; timestamps are microseconds since 1970."""
    with _panics_named(file):
        _check(file)
        found = _decoder(file).id_to_stream()
    streams = {number: about for number, about in found.items() if about["type"] == "events"}
    if not streams:
        raise DataError(f"{file}: expected a stream of events, got none")
    first = min(streams)

    def blocks() -> Iterator[Block]:
        with _panics_named(file):
            for packet in _decoder(file):
                if packet["stream_id"] == first and "events" in packet:
                    events = packet["events"]
                    # Views of the packet's own structure: copied, so that it can be let go.
                    t, x, y = (events[name].copy() for name in ("t", "x", "y"))
                    yield Block(t, x, y, events["on"].astype("i1"))

    def notes() -> tuple[str, ...]:
        others = len(streams) - 1
        return (f"{others} other streams of events left out",) if others else ()

    size = (streams[first]["width"], streams[first]["height"])
    return Stream(file, blocks, lambda row: f"{file}: event {row}", "us", size, notes, unit_is_sure=True)


def _decoder(file: Path):  # noqa: ANN202 - of a package that may lack
    try:
        import aedat
    except ImportError:
        raise DataError(
            f'{file}: expected the package aedat to read it, got none: pip install -e ".[events]"'
        ) from None
    return aedat.Decoder(file)


@contextmanager
def _panics_named(file: Path) -> Iterator[None]:
    """DataError for whatever the package makes of a damaged file, its panics too, which are no Exception."""
    try:
        yield
    except DataError:
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        words = " ".join(str(error).split())[:80]
        raise DataError(f"{file}: expected an AEDAT 4 file, got {words}") from None


def _check(file: Path) -> None:
    """An error for what ends the package, or the whole process: it allots what a packet asks for.

    ValueError for packets that do not end within the file or where its header says, ParseError for streams
    that are no XML.
    """
    end, said = file.stat().st_size, -1
    with open_file(file) as stream:
        stream.seek(len(MAGIC) + len("\r\n"))
        (length,) = struct.unpack("<I", stream.read(4))
        if length > end:
            raise ValueError(f"a header of {length} bytes")
        header = stream.read(length)
        # FlatBuffers: the table, its vtable, and of that the second entry, where the table of packets begins.
        (table,) = struct.unpack_from("<I", header)
        (back,) = struct.unpack_from("<i", header, table)
        size, _, _, place, about = struct.unpack_from("<5H", header + bytes(10), table - back)
        if size >= 8 and place:
            (said,) = struct.unpack_from("<q", header, table + place)
            end = said if 0 <= said < end else end
        if size >= 10 and about:  # the streams, as text
            (text,) = struct.unpack_from("<I", header, table + about)
            (count,) = struct.unpack_from("<I", header, table + about + text)
            ElementTree.fromstring(header[table + about + text + 4 :][:count])
        while (at := stream.tell()) + 8 <= end:
            _, length = struct.unpack("<iI", stream.read(8))
            if length > end - at - 8:
                raise ValueError(f"a packet of {length} bytes at {at}, where {end - at - 8} are left")
            stream.seek(length, 1)
        if end == said and at != end:  # the package goes on until it is there
            raise ValueError(f"packets that end at {at}, and a header that says {said}")
