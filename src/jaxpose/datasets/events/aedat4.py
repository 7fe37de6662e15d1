"""AEDAT 4 files of iniVation's cameras, by the package `aedat` (extra `events`)."""

from collections.abc import Iterator
from pathlib import Path

from jaxpose.datasets.events.stream import Block, Stream
from jaxpose.errors import DataError

MAGIC = b"#!AER-DAT4.0"


def aedat4_stream(file: Path) -> Stream:
    """The events of an AEDAT 4 file, of its first stream of them; timestamps are microseconds since 1970."""
    streams = {
        number: about for number, about in _decoder(file).id_to_stream().items() if about["type"] == "events"
    }
    if not streams:
        raise DataError(f"{file}: expected a stream of events, got none")
    first = min(streams)

    def blocks() -> Iterator[Block]:
        try:
            for packet in _decoder(file):
                if packet["stream_id"] == first and "events" in packet:
                    events = packet["events"]
                    # Views of the packet's own structure: copied, so that it can be let go.
                    t, x, y = (events[name].copy() for name in ("t", "x", "y"))
                    yield Block(t, x, y, events["on"].astype("i1"))
        except (RuntimeError, ValueError) as error:
            raise DataError(f"{file}: expected a whole AEDAT 4 file, got {_words(error)}") from None

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
            f"{file}: expected the package aedat to read it, got none: pip install 'jaxpose[events]'"
        ) from None
    try:
        return aedat.Decoder(file)
    except Exception as error:  # the package raises its own on damaged files
        raise DataError(f"{file}: expected an AEDAT 4 file, got {_words(error)}") from None


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:80]
