"""Events in HDF5 as DSEC has them: `events/{x,y,p,t}` with t in microseconds, and `t_offset`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.events.sidecar import Source, load_source, with_camera
from jaxpose.datasets.events.stream import BLOCK, Block, Stream, Unit
from jaxpose.datasets.images import only, some
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.files.untrusted import hdf5_column, opened_hdf5

_SUFFIXES = (".h5", ".hdf5")
_NAMES = ("t", "x", "y", "p")
_FOLDERS = (".", "events/left", "left")  # in DSEC each camera has its own
_OTHERS = ("rectify_map.h5",)  # of DSEC, with no events in it


def detect(path: Path) -> bool:
    """Whether a folder has an HDF5 file, itself or where DSEC puts that of the left camera.

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
    """Read events in HDF5, as DSEC has them. Needs h5py and hdf5plugin (extra `hdf5`).

    `events/` has x, y, p and t, t in microseconds, to which `t_offset` is added where there is one; time 0 is
    the first event's timestamp. `ms_to_idx` is not used. Pixels are as recorded, not rectified. In the folder
    of the file may lie `poses.txt`, T_world_cam in TUM's format on the clock of t + t_offset, and the camera
    (`sidecar.with_camera`).

    Args:
        path: The file, or a folder with a single one, in it or in its `events/left`.
        mosaic: The colour of the pixels.
        size: Width and height of the sensor where no file says.
        unit: Of the timestamps; by default found out, as a note then says.
        span: The part to read, two increasing times [s]; by default all.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file, and line or event, for anything that cannot be used (`validate.clean`).
        ValueError: For another mosaic, and for a span that does not rise.
    """
    source = find(path, size=size)
    ground_truth = source.stream.file.parent / "poses.txt"
    return load_source(source, ground_truth, mosaic=mosaic, unit=unit, span=span)[0]


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
    file = _file(Path(path))
    return with_camera(Stream(file, lambda: _blocks(file), lambda row: f"{file}: event {row}", "us"), size)


def _files(folder: Path) -> list[Path]:
    for place in _FOLDERS:
        files = [file for file in sorted((folder / place).glob("*")) if file.suffix in _SUFFIXES]
        files = [file for file in files if file.name not in _OTHERS]
        if files:
            return files
    return []


def _file(path: Path) -> Path:
    if path.is_file():
        return path
    return only(_files(path), path, "one HDF5 file of events")


def _blocks(file: Path) -> Iterator[Block]:
    with opened_hdf5(file, "an HDF5 file") as content:
        columns = [_column(file, content, name) for name in _NAMES]
        lengths = {len(column) for column in columns}
        if len(lengths) != 1:
            got = ", ".join(f"{len(column)} {name}" for name, column in zip(_NAMES, columns, strict=True))
            raise DataError(f"{file}: expected events/ with columns of one length, got {got}")
        offset = int(np.asarray(content.get("t_offset", 0)))
        for start in range(0, lengths.pop(), BLOCK):
            t, *others = (column[start : start + BLOCK] for column in columns)
            if t.dtype.kind in "iu":
                t = t.astype(np.int64)
            yield Block(t + offset, *others)


def _column(file: Path, content: Any, name: str) -> Any:
    """The data set of one column."""
    column = hdf5_column(content, f"events/{name}")
    if column is None:
        events = content.get("events")
        got = some(sorted(events if hasattr(events, "keys") else content)) or "none"
        raise DataError(f"{file}: expected events/ with x y p t, a row of numbers each, got {got}")
    return column
