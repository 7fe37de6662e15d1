"""Any recording of events: which of the layouts a folder or file has, told by its files, and its loader."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from jaxpose.data import davis, event_hdf5, event_npz, eventnerf
from jaxpose.data.event_stream import Unit
from jaxpose.data.images import found
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.recording import EventRecording

Format = Literal["eventnerf", "davis", "hdf5", "npz"]


class _Layout(NamedTuple):
    """What a layout looks like in words and in a file's suffix, how a folder has it, loader and colours."""

    files: str
    suffixes: tuple[str, ...]
    is_here: Callable[[Path], bool]
    load: Callable[..., EventRecording]
    mosaic: Mosaic


# In the order in which they are tried: EventNeRF's events are an npz, too.
_LAYOUTS: dict[Format, _Layout] = {
    "eventnerf": _Layout(
        "intrinsics/, pose/ and events/*.npz", (), eventnerf.is_here, eventnerf.load, "rggb"
    ),
    "davis": _Layout("events.txt", (".txt",), davis.is_here, davis.load, "mono"),
    "hdf5": _Layout("an HDF5 file", (".h5", ".hdf5"), event_hdf5.is_here, event_hdf5.load, "mono"),
    "npz": _Layout("an npz file with x y t p", (".npz",), event_npz.is_here, event_npz.load, "mono"),
}


def find_format(path: Path | str) -> Format:
    """The layout of a folder by its files, or of a file by its suffix.

    DataError saying what was expected and what is there.
    """
    path = Path(path)
    for name in get_args(Format):
        layout = _LAYOUTS[name]
        if layout.is_here(path) if path.is_dir() else path.is_file() and path.suffix in layout.suffixes:
            return name
    expected = ", or ".join(f"{layout.files} ({name})" for name, layout in _LAYOUTS.items())
    raise DataError(f"{path}: expected a recording of events, {expected}, got {found(path)}")


def load(
    path: Path | str,
    format: Format | None = None,
    *,
    mosaic: Mosaic | None = None,
    size: tuple[int, int] | None = None,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
) -> EventRecording:
    """Read a recording of events in the layout `format`, or in the one that `find_format` finds.

    `mosaic` is the colour of the pixels: without it "rggb" for EventNeRF's layout, else "mono". `size`
    (width, height) is that of the sensor where no file tells it, `unit` that of the stamps, and `span` [s]
    the part to read; see the loaders, whose errors these are.
    """
    layout = _LAYOUTS[format or find_format(path)]
    return layout.load(path, mosaic=mosaic or layout.mosaic, size=size, unit=unit, span=span)
