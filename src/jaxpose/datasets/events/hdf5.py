"""Events in HDF5: columns as DSEC has them, `events/{x,y,p,t}` and `t_offset`, other names, or a table."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxpose.datasets.events.columns import named, order_of
from jaxpose.datasets.events.sidecar import Source, load_beside, with_camera
from jaxpose.datasets.events.stream import BLOCK, Block, Stream, Unit
from jaxpose.datasets.images import only, some
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.files.untrusted import hdf5_column, hdf5_whole_number, opened_hdf5

_SUFFIXES = (".h5", ".hdf5")
# The groups and tables that have events: of DSEC and others, v2e, MVSEC, Metavision, M3ED; of two cameras the
# left one.
_GROUPS = ("events/", "", "CD/events/", "prophesee/left/", "davis/left/events/")
_TABLES = ("events", "CD/events", "davis/left/events", "data")
_ECF = 0x8ECF
_FOLDERS = (".", "events/left", "left")  # in DSEC each camera has its own
_OTHERS = ("rectify_map.h5",)  # of DSEC, with no events in it

_Read = Callable[[int, int], Any]  # t, x, y and p of the events from one row to before another


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
    """Read events in HDF5. Needs h5py and hdf5plugin (extra `hdf5`).

    `events/` (or the file itself, or `CD/events`) has x, y, p and t, or xs, ys, ps and ts, or is a table
    of them. t is in microseconds if that gives a possible rate, else in what does; `t_offset` is added
    where there is one; time 0 is the first event's timestamp. `ms_to_idx` is not used. Pixels are as
    recorded, not rectified. In the folder of the file may lie `poses.txt`, T_world_cam in TUM's format on
    the clock of t + t_offset, and the camera (`sidecar.with_camera`).

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
    file = _file(Path(path))
    return with_camera(Stream(file, lambda: _blocks(file), lambda row: f"{file}: event {row}", "us"), size)


def _files(folder: Path) -> list[Path]:
    for place in _FOLDERS:
        files = [file for file in sorted((folder / place).glob("*")) if file.suffix.lower() in _SUFFIXES]
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
        read, length = _columns(file, content) or _table(content) or _none(file, content)
        offset = hdf5_whole_number(content, "t_offset", 0)
        for start in range(0, length, BLOCK):
            t, *others = read(start, start + BLOCK)
            if t.dtype.kind in "iu":
                t = t.astype(np.int64)
            yield Block(t + offset, *others)


def _columns(file: Path, content: Any) -> tuple[_Read, int] | None:
    """Events as four rows of numbers in one group."""
    for place in _GROUPS:
        group = content.get(place.rstrip("/")) if place else content
        names = named(group) if hasattr(group, "keys") else None
        columns = [hdf5_column(content, f"{place}{name}") for name in names or ()]
        if names is None or any(column is None for column in columns):
            continue
        lengths = {len(column) for column in columns}
        if len(lengths) != 1:
            got = ", ".join(f"{len(c)} {name}" for name, c in zip(names, columns, strict=True))
            raise DataError(f"{file}: expected {place} with columns of one length, got {got}")
        for column in columns:
            _check_filters(column)
        return lambda start, stop, c=columns: [column[start:stop] for column in c], lengths.pop()
    return None


def _table(content: Any) -> tuple[_Read, int] | None:
    """Events as one table, of named fields or of four columns."""
    for place in _TABLES:
        table = hdf5_column(content, place, table=True)
        if table is None:
            continue
        _check_filters(table)
        if table.dtype.names is None:
            order = order_of(place, np.asarray(table[:BLOCK], np.float64))
            return partial(_by_order, table, order), len(table)
        if (names := named(table.dtype.names)) is not None:
            return partial(_by_name, table, names), len(table)
    return None


def _by_order(table: Any, order: list[int], start: int, stop: int) -> list[np.ndarray]:
    return list(table[start:stop].T[order])


def _by_name(table: Any, names: tuple[str, ...], start: int, stop: int) -> list[np.ndarray]:
    rows = table[start:stop]
    return [rows[name] for name in names]


def _check_filters(column: Any) -> None:
    """ValueError for data compressed by what is not installed."""
    import h5py

    plan = column.id.get_create_plist()
    for k in range(plan.get_nfilters()):
        number, *_, name = plan.get_filter(k)
        if not h5py.h5z.filter_avail(number):
            which = "Prophesee's ECF (hdf5_ecf, HDF5_PLUGIN_PATH)" if number == _ECF else name.decode()
            raise ValueError(f"{column.name} compressed by filter {number}, not installed: {which}")


def _none(file: Path, content: Any) -> NoReturn:
    events = content.get("events")
    got = some(sorted(events if hasattr(events, "keys") else content)) or "none"
    raise DataError(f"{file}: expected events/ with x y p t, a row of numbers each, got {got}")
