"""Events in one file as cameras and their programs write it, with poses and calibration beside it."""

from pathlib import Path

from jaxpose.datasets.events.aedat4 import MAGIC as AEDAT4
from jaxpose.datasets.events.aedat4 import aedat4_stream
from jaxpose.datasets.events.event_stream import MAGIC as EVENT_STREAM
from jaxpose.datasets.events.event_stream import es_stream
from jaxpose.datasets.events.prophesee import dat_stream, raw_stream
from jaxpose.datasets.events.sidecar import Source, load_beside, with_camera
from jaxpose.datasets.events.stream import Stream, Unit
from jaxpose.datasets.events.text import holds_events, text_stream
from jaxpose.datasets.images import only
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.files.opening import open_file

SUFFIXES = (".raw", ".dat", ".aedat4", ".aedat", ".es", ".csv")
_WORDS = "one file of events, RAW, DAT, AEDAT 4, ES or csv"


def detect(path: Path) -> bool:
    """Whether a folder has a file of events, by its suffix and first bytes.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return bool(_files(path))


def load(
    path: Path | str,
    *,
    mosaic: Mosaic = "mono",
    size: tuple[int, int] | None = None,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
) -> EventRecording:
    """Read events in a file of a camera's: Prophesee's RAW and DAT, AEDAT 4, Event Stream, or csv.

    Which it is, its first bytes say. Time 0 is the first event's timestamp. AEDAT 4 needs the package aedat
    (extra `events`). In csv a header names the columns; without one they are `t x y p`, or Prophesee's
    `x y p t`. In the folder of the file may lie `poses.txt`, T_world_cam in TUM's format on the clock of the
    events, and the camera (`sidecar.with_camera`).

    Args:
        path: The file, or a folder with a single one.
        mosaic: The colour of the pixels.
        size: Width and height of the sensor where no file says.
        unit: Of the timestamps; by default as the format states, or found out, as a note then says.
        span: The part to read, two increasing times [s]; by default all.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file, and line or event, for anything that cannot be used (`validate.clean`).
        ValueError: For another mosaic, and for a span that does not rise.
    """
    return load_beside(find(path, size=size), mosaic=mosaic, unit=unit, span=span)


def find(path: Path | str, *, size: tuple[int, int] | None = None) -> Source:
    """The file of events and the camera that `load` reads, before it does.

    Args:
        path: As `load` takes it.
        size: Width and height of the sensor where no file says.

    Returns:
        Where the events are, and the camera that saw them.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    path = Path(path)
    return with_camera(_stream(path if path.is_file() else only(_files(path), path, _WORDS)), size)


def _files(folder: Path) -> list[Path]:
    found = (file for file in sorted(folder.glob("*")) if file.is_file() and not file.name.startswith("."))
    return [file for file in found if is_events(file)]


def is_events(file: Path) -> bool:
    """Whether a file has the suffix and the first bytes of one of events.

    Args:
        file: Any file.

    Returns:
        Whether `load` should read it.
    """
    if file.suffix.lower() not in SUFFIXES:
        return False
    if file.suffix.lower() == ".csv":
        return holds_events(file)
    with open_file(file) as stream:
        return stream.read(2) in (b"% ", b"#!", EVENT_STREAM[:2])


def _stream(file: Path) -> Stream:
    """The events of a file, by its first bytes."""
    with open_file(file) as stream:
        head = stream.read(256)
    if head.startswith(EVENT_STREAM):
        return es_stream(file)
    if head.startswith(AEDAT4):
        return aedat4_stream(file)
    if head.startswith(b"#!AER-DAT"):
        version = head[9:12].decode("ascii", "replace")
        raise DataError(f"{file}: expected AEDAT 4, got AEDAT {version}: DV or dv-processing convert it")
    if file.suffix.lower() == ".csv":
        return text_stream(file, None)
    if file.suffix.lower() == ".dat":
        return dat_stream(file)
    return raw_stream(file)
