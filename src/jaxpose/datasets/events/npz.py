"""Events in numpy's files: arrays x, y, t and p, or one of four columns; `poses.txt`, `calib.txt` beside."""

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.events.columns import named, order_of
from jaxpose.datasets.events.sidecar import Source, load_beside, with_camera
from jaxpose.datasets.events.stream import BLOCK, Block, Stream, Unit
from jaxpose.datasets.images import only, some
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.files.opening import open_file
from jaxpose.files.untrusted import array_header, reading


def detect(path: Path) -> bool:
    """Whether a folder has an archive with the four arrays.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return any(_names(file) is not None for file in path.glob("*.npz"))


def load(
    path: Path | str,
    *,
    mosaic: Mosaic = "mono",
    size: tuple[int, int] | None = None,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
) -> EventRecording:
    """Read events in a numpy archive, of arrays x, y, t, p (`columns.NAMES`), or in one array (n, 4).

    Time 0 is the first event's timestamp. In the same folder may lie `poses.txt`, T_world_cam in TUM's format
    on the clock of the events, and the camera (`sidecar.with_camera`).

    Args:
        path: The file, or a folder with a single one.
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
    return with_camera(npz_stream(_file(Path(path))), size)


def npz_stream(file: Path) -> Stream:
    """The events of an archive, of which no more than a block is in memory.

    Args:
        file: The archive.

    Returns:
        The stream; it raises DataError for what is no archive of events when it is read.
    """
    return Stream(file, lambda: _blocks(file), lambda row: f"{file}: event {row}")


def _file(path: Path) -> Path:
    if path.is_file():
        return path
    files = [file for file in sorted(path.glob("*.npz")) if _names(file) is not None]
    return only(files, path, "one npz file with arrays x y t p")


def _names(file: Path) -> tuple[str, ...] | None:
    """What the file calls t, x, y and p; None where it has no such arrays."""
    try:
        with open_file(file) as stream, zipfile.ZipFile(stream) as archive:
            members = {name.removesuffix(".npy") for name in archive.namelist()}
    except Exception:  # zipfile raises many kinds on damaged files
        return None
    return named(members)


def _table(file: Path, stream: Any) -> Iterator[Block]:
    """The events of one array (n, 4), row by row."""
    shape, by_column, kind = array_header(stream)
    if len(shape) != 2 or shape[1] != 4:
        raise DataError(f"{file}: expected arrays x y t p, or one of 4 columns, got {kind} of shape {shape}")
    if by_column:
        whole = _rows(stream, kind, 4 * shape[0]).reshape(4, -1).T
        yield Block(*whole.T[order_of(file.name, whole[:BLOCK].astype(np.float64))])
        return
    order = None
    for start in range(0, shape[0], BLOCK):
        rows = _rows(stream, kind, 4 * min(BLOCK, shape[0] - start)).reshape(-1, 4)
        order = order or order_of(file.name, rows.astype(np.float64))
        yield Block(*rows.T[order])


def _blocks(file: Path) -> Iterator[Block]:
    if file.suffix.lower() == ".npy":
        with reading(file, "a whole array"), open_file(file) as stream:
            yield from _table(file, stream)
        return
    with reading(file, "a whole npz file"):
        with ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(stack.enter_context(open_file(file))))
            members = {name.removesuffix(".npy") for name in archive.namelist()}
            names = named(members)
            if names is None and len(members) == 1:
                yield from _table(file, stack.enter_context(archive.open(archive.namelist()[0])))
                return
            if names is None:
                got = some(sorted(members)) or "none"
                raise DataError(f"{file}: expected arrays x y t p, got {got}")
            columns: list[Any] = [stack.enter_context(archive.open(f"{name}.npy")) for name in names]
            kinds, lengths = zip(
                *(_header(file, *pair) for pair in zip(names, columns, strict=True)), strict=True
            )
            if len(set(lengths)) != 1:
                got = ", ".join(f"{length} {name}" for name, length in zip(names, lengths, strict=True))
                raise DataError(f"{file}: expected arrays of one length, got {got}")
            for start in range(0, lengths[0], BLOCK):
                rows = min(BLOCK, lengths[0] - start)
                yield Block(*(_rows(column, kind, rows) for column, kind in zip(columns, kinds, strict=True)))
            # The end has the checksum.
            for column in columns:
                if column.read(1):
                    raise ValueError("an array that is longer than it says")


def _header(file: Path, name: str, column: Any) -> tuple[np.dtype, int]:
    """Kind of number and length of an array."""
    shape, _, kind = array_header(column)
    if len(shape) != 1:
        raise DataError(f"{file}: expected {name} as a row of numbers, got {kind} of shape {shape}")
    return kind, shape[0]


def _rows(column: Any, kind: np.dtype, rows: int) -> np.ndarray:
    content = column.read(rows * kind.itemsize)
    if len(content) < rows * kind.itemsize:
        raise EOFError("an array that ends early")
    return np.frombuffer(content, kind)
