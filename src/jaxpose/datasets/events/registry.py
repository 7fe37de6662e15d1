"""Any recording of events: which of the layouts a folder or file has, by its files, and its loader."""

from pathlib import Path
from typing import Literal, NamedTuple, Protocol, get_args

from jaxpose.datasets.events import davis, eventnerf, ros, single_file
from jaxpose.datasets.events import hdf5 as event_hdf5
from jaxpose.datasets.events import npz as event_npz
from jaxpose.datasets.events.sidecar import Source
from jaxpose.datasets.events.stream import Unit
from jaxpose.datasets.images import found
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Mosaic

Format = Literal["eventnerf", "davis", "hdf5", "npz", "file", "ros"]


class _Module(Protocol):
    """What the module of a layout has."""

    def detect(self, path: Path, /) -> bool: ...

    def find(self, path: Path | str, /, *, size: tuple[int, int] | None = None) -> Source: ...

    def load(
        self,
        path: Path | str,
        /,
        *,
        mosaic: Mosaic,
        size: tuple[int, int] | None = None,
        unit: Unit | None = None,
        span: tuple[float, float] | None = None,
    ) -> EventRecording: ...


class Layout(NamedTuple):
    """A layout: what it is called, what files it has, its module, and the colour of its pixels."""

    title: str
    tested: str  # what its test reads
    files: str
    suffixes: tuple[str, ...]
    module: _Module
    mosaic: Mosaic


# In the order in which they are tried: EventNeRF's events are an npz, too.
LAYOUTS: dict[Format, Layout] = {
    "eventnerf": Layout(
        "EventNeRF", "a made folder", "intrinsics/, pose/ and events/*.npz", (), eventnerf, "rggb"
    ),
    "davis": Layout("DAVIS text", "made folders, slider_depth", "events.txt", (".txt",), davis, "mono"),
    "hdf5": Layout(
        "HDF5: DSEC, Prophesee's, at the root (extra `hdf5`)",
        "h5py",
        "an HDF5 file",
        (".h5", ".hdf5"),
        event_hdf5,
        "mono",
    ),
    "npz": Layout("npz", "numpy", "an npz file with x y t p, npy", (".npz", ".npy"), event_npz, "mono"),
    "file": Layout(
        "Prophesee RAW (EVT 2, 2.1, 3), DAT, AEDAT 4 (extra `events`), Event Stream, csv",
        "made bytes by the vendors' documents, dv-processing",
        "a RAW, DAT, AEDAT 4, ES or csv file",
        single_file.SUFFIXES,
        single_file,
        "mono",
    ),
    "ros": Layout(
        "ROS 1 and ROS 2 bags (extra `ros`)",
        "bags that rosbags writes",
        "a ROS bag with events",
        (),
        ros,
        "mono",
    ),
}


def find_format(path: Path | str) -> Format:
    """The layout of a folder by its files, or of a file by its suffix.

    Args:
        path: The folder or file.

    Returns:
        The name of the layout.

    Raises:
        DataError: Saying what was expected and what is there.
    """
    path = Path(path)
    for name in get_args(Format):
        layout = LAYOUTS[name]
        if (path.is_dir() or name == "ros") and layout.module.detect(path):
            return name
        if path.is_file() and path.suffix.lower() in layout.suffixes:
            return name
    expected = ", or ".join(f"{layout.files} ({name})" for name, layout in LAYOUTS.items())
    raise DataError(f"{path}: expected a recording of events, {expected}, got {found(path)}")


def find(path: Path | str, format: Format | None = None, *, size: tuple[int, int] | None = None) -> Source:
    """The file of events and the camera that `load_events` reads, before it does.

    Args:
        path: The folder or file.
        format: The layout; by default the one that `find_format` finds.
        size: Width and height of the sensor where no file says.

    Returns:
        Where the events are, and the camera that saw them.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    return LAYOUTS[format or find_format(path)].module.find(path, size=size)


def load_events(
    path: Path | str,
    format: Format | None = None,
    *,
    mosaic: Mosaic | None = None,
    size: tuple[int, int] | None = None,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
) -> EventRecording:
    """Read a recording of events in any of the layouts.

    Args:
        path: The folder or file.
        format: The layout; by default the one that `find_format` finds.
        mosaic: The colour of the pixels; by default "rggb" for EventNeRF's layout, else "mono".
        size: Width and height of the sensor where no file says.
        unit: Of the timestamps; by default found out, as a note then says.
        span: The part to read, two increasing times [s]; by default all.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file, and line or event, for anything that cannot be used (`validate.clean`).
        ValueError: For another mosaic, and for a span that does not rise.
    """
    layout = LAYOUTS[format or find_format(path)]
    return layout.module.load(path, mosaic=mosaic or layout.mosaic, size=size, unit=unit, span=span)
