"""Bytes that others wrote: one reader for each kind, which bounds what it allocates by what the file holds.

Nothing is unpickled. Whatever goes wrong inside becomes one `DataError` that names the file, and the entry
where there is one. `schema` checks what was read.
"""

import json
import math
import os
import re
import reprlib
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxpose.errors import DataError
from jaxpose.files.opening import BoundedFile, open_file
from jaxpose.files.texts import read_text

_TEXT_BYTES = 256 << 20  # JSON; its objects take some twenty times as much
_YAML_BYTES = 100_000  # data sheets of sensors are a few kB, and its parser is slow
_ARRAY_BYTES = 1 << 36  # of one array
_PIECE_BYTES = 1 << 18  # read at a time: what a processor's cache holds
_HEADER_BYTES = 4096  # of an array: its type and shape in words
_HEADER = re.compile(
    rb"""\{['"]descr['"]: ['"]([<>|=]?\w{1,20})['"], ['"]fortran_order['"]: (True|False), """
    rb"""['"]shape['"]: \(((?:\d{1,20}L?, ?){0,16}(?:\d{1,20}L?)?)\),? ?\}"""
)
_DEFLATE = 1032  # how far deflate can compress
_UNPACKED, _UNPACKED_PER_BYTE = 1 << 29, 64  # bytes of an archive's arrays, beyond both of which it is none
_PIXELS = 100_000_000  # of one image
_PIXELS_PER_BYTE = 4096  # how far PNG and JPEG can
_FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP")
_PLAIN = {"UnidentifiedImageError": "bytes of no kind that is known", "RecursionError": "nesting without end"}


@runtime_checkable
class _Stream(Protocol):
    def read(self, n: int = ..., /) -> bytes: ...

    def tell(self) -> int: ...


@contextmanager
def reading(path: Path | str, wanted: str) -> Iterator[None]:
    """Whatever goes wrong in the block is a DataError of one line.

    Errors of the system (no such file, no permission) pass, as they name the file too.

    Args:
        path: the file that is read.
        wanted: what it was expected to be, in words.

    Raises:
        DataError: `path: expected wanted, got ...`.
    """
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno is not None and error.filename is not None:
            raise
        raise DataError(f"{path}: expected {wanted}, got {_words(error)}") from None


# --- arrays -------------------------------------------------------------------------------------------------


def read_npz(path: Path | str, wanted: str) -> dict[str, np.ndarray]:
    """Read an archive of arrays (npz).

    Args:
        path: the file.
        wanted: what it was expected to be, in words.

    Returns:
        The arrays by name.

    Raises:
        DataError: for a damaged file, arrays that are longer than it, and entries that are no plain arrays.
    """
    path = Path(path)
    with reading(path, wanted), open_file(path) as stream, zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        size, unpacked = path.stat().st_size, sum(member.file_size for member in members)
        if sum(member.compress_size for member in members) > size:
            raise ValueError("entries that are longer than the file")
        if unpacked > max(_UNPACKED, _UNPACKED_PER_BYTE * size):
            raise ValueError(f"{unpacked} bytes packed into {size}")
        found = {}
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in found or name == member.filename:
                raise ValueError(f"{member.filename!r}, which is no array or is there twice")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{member.filename!r}, compressed in a way that numpy does not")
            with reading(path, f"{wanted} with an array {name!r}"), archive.open(member) as content:
                if member.file_size > _DEFLATE * member.compress_size + 64:
                    raise ValueError("more bytes than can be compressed to what is there")
                found[name] = _array(content, member.file_size)
        return found


def read_npy(path: Path | str, wanted: str) -> np.ndarray:
    """Read an array (npy).

    Args:
        path: the file.
        wanted: what it was expected to be, in words.

    Returns:
        The array.

    Raises:
        DataError: for a damaged file, one that is longer or shorter than its header says, and for objects.
    """
    path = Path(path)
    with reading(path, wanted), open_file(path) as stream:
        return _array(stream, path.stat().st_size)


def array_header(stream: _Stream) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read the header of an array (npy): numpy's own format, but numbers and texts only.

    Args:
        stream: at the beginning of the array; afterwards at its first number.

    Returns:
        Shape, whether it is in Fortran's order, and type.

    Raises:
        ValueError: for what is no header, for objects and for records.
    """
    version = np.lib.format.read_magic(stream)
    width = {(1, 0): 2, (2, 0): 4, (3, 0): 4}[version]
    size = int.from_bytes(stream.read(width), "little")
    if size > _HEADER_BYTES:
        raise ValueError(f"a header of {size} bytes")
    text = stream.read(size)
    words = _HEADER.fullmatch(text.rstrip())
    if words is None:
        raise ValueError(f"an array described as {text[:80]!r}")
    kind, order, sizes = (word.decode() for word in words.groups())
    shape = tuple(int(size.strip().rstrip("L")) for size in sizes.split(",") if size.strip())
    if len(shape) > 16 or any(size >= 2**48 for size in shape):
        raise ValueError(f"an array of shape {str(shape)[:60]}")
    found = np.dtype(kind)
    if found.kind not in "biufcUS":
        raise ValueError(f"entries of type {kind}")
    return shape, order == "True", found


def _array(stream: _Stream, size: int) -> np.ndarray:
    """The array in so many bytes."""
    start = stream.tell()
    shape, fortran, kind = array_header(stream)
    rest, wanted = size - (stream.tell() - start), math.prod(shape) * kind.itemsize
    if wanted != rest or wanted > _ARRAY_BYTES:
        raise ValueError(f"{kind} of shape {shape} in {rest} bytes")
    content, filled = np.empty(wanted, np.uint8), 0
    while filled < wanted and (piece := stream.read(min(_PIECE_BYTES, wanted - filled))):
        content[filled : filled + len(piece)] = np.frombuffer(piece, np.uint8)
        filled += len(piece)
    if filled < wanted or stream.read(1):  # the end of a member has its checksum
        raise EOFError(f"{filled} bytes for {kind} of shape {shape}")
    if not wanted:
        return np.zeros(shape, kind)
    return content.view(kind).reshape(shape, order="F" if fortran else "C")


@contextmanager
def opened_hdf5(path: Path | str, wanted: str) -> Iterator[Any]:
    """Open an HDF5 file. Needs h5py and hdf5plugin (extra `hdf5`).

    Args:
        path: the file.
        wanted: what it was expected to be, in words.

    Yields:
        The open file; `hdf5_column` gives its data sets.

    Raises:
        DataError: for a damaged file, and without the packages.
    """
    try:
        import h5py
        import hdf5plugin  # noqa: F401  # DSEC's files are compressed with one of its filters
    except ImportError as error:
        raise DataError(
            f'{path}: expected h5py and hdf5plugin to read it, got no {error.name}: pip install -e ".[hdf5]"'
        ) from None
    open_file(path).close()  # says what the system says of it
    with reading(path, wanted), h5py.File(path, "r") as content:
        yield content


def hdf5_column(content: Any, name: str, *, table: bool = False) -> Any:
    """A row of numbers of an HDF5 file, or a table of them, to be read in pieces.

    Args:
        content: the open file.
        name: of the data set.
        table: whether rows have named fields, or are of four numbers.

    Returns:
        The data set; None where there is none of that kind.

    Raises:
        ValueError: for one that the file cannot hold: HDF5 allots space of any size that nothing fills.
    """
    import h5py

    link = content.get(name, getlink=True)
    column = content.get(name) if isinstance(link, h5py.HardLink) else None  # others lead to other files
    if not isinstance(column, h5py.Dataset):
        return None
    named = column.ndim == 1 and column.dtype.names is not None
    numbers = column.dtype.kind in "biuf" and (column.shape[1:] == (4,) if table else column.ndim == 1)
    if not (numbers or (table and named)):
        return None
    if column.external or column.is_virtual:
        raise ValueError(f"{name} in another file")
    stored = column.id.get_storage_size()
    if column.size * column.dtype.itemsize > 100 * _DEFLATE * stored:
        raise ValueError(f"{len(column)} numbers of {name} in {stored} bytes")
    return column


def hdf5_whole_number(content: Any, name: str, default: int) -> int:
    """A whole number of an HDF5 file.

    Args:
        content: the open file.
        name: of the data set.
        default: where there is none.

    Returns:
        The number.

    Raises:
        ValueError: for what is no single whole number.
    """
    import h5py

    if name not in content:
        return default
    column = content.get(name)
    if not isinstance(column, h5py.Dataset) or column.size != 1 or column.dtype.kind not in "iu":
        raise ValueError(f"{name} that is no whole number")
    return int(column[()].item())


# --- texts --------------------------------------------------------------------------------------------------


def read_json(path: Path | str, wanted: str) -> dict[str, Any]:
    """Read an object in JSON.

    Args:
        path: the file.
        wanted: what it was expected to be, in words.

    Returns:
        Its entries.

    Raises:
        DataError: naming the file, and the line where it breaks off, for what is not that.
    """
    path = Path(path)
    with reading(path, wanted):
        return json_object(_text(path, _TEXT_BYTES), path, wanted)


def json_object(text: str | bytes, path: Path | str, wanted: str) -> dict[str, Any]:
    """The object in a JSON text, of a file or of an entry of one.

    Args:
        text: the text.
        path: the file, and the entry where it is one.
        wanted: what it was expected to be, in words.

    Returns:
        Its entries.

    Raises:
        DataError: naming `path`, and the line where it breaks off, for what is not that.
    """
    with reading(path, wanted):
        try:
            content = json.loads(text)
        except json.JSONDecodeError as error:
            raise DataError(f"{path}:{error.lineno}: expected {wanted}, got {error.msg}") from None
        if not isinstance(content, dict):
            raise ValueError(f"no JSON object but {reprlib.repr(content)}")
        return content


def read_yaml(path: Path | str, wanted: str) -> dict[str, Any]:
    """Read a mapping in YAML, OpenCV's kind too; scalars that are numbers become floats, others stay texts.

    Args:
        path: the file.
        wanted: what it was expected to be, in words.

    Returns:
        Its entries.

    Raises:
        DataError: naming the file, and the line where it breaks off, for what is not that.
    """
    import yaml

    class Plain(yaml.BaseLoader):
        """Texts, lists and mappings; none of them twice, which could make a short file a large tree."""

        def compose_node(self, parent, index):
            if self.check_event(yaml.AliasEvent):
                raise ValueError("an alias")
            return super().compose_node(parent, index)

    path = Path(path)
    with reading(path, wanted):
        text = _text(path, _YAML_BYTES)
        if text.startswith("%YAML"):  # OpenCV and EuRoC write %YAML:1.0, which is none
            text = "#" + text
        try:
            content = yaml.load(text, Plain)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            raise DataError(f"{path}:{line}: expected {wanted}, got {_words(error.problem)}") from None
        if not isinstance(content, dict):
            raise ValueError(f"no mapping but {reprlib.repr(content)}")
        return _numeric(content)


def _text(path: Path, most: int) -> str:
    if (size := path.stat().st_size) > most:
        raise ValueError(f"{size} bytes, more than {most}")
    return read_text(path)


def _numeric(value: Any) -> Any:
    """A tree of YAML with numbers for the texts that are some."""
    if isinstance(value, dict):
        return {key: _numeric(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_numeric(entry) for entry in value]
    words = value.strip("[]() ").replace(",", " ").split()  # several in one text are a list
    try:
        return float(value) if len(words) < 2 else [float(word) for word in words]
    except ValueError:
        return value


# --- images -------------------------------------------------------------------------------------------------


@contextmanager
def opened_image(path: Path | str) -> Iterator[Any]:
    """Open an image, of which Pillow reads only the header until pixels are asked for.

    Args:
        path: the file.

    Yields:
        The image of Pillow.

    Raises:
        DataError: for what is no image, and for one of more pixels than the file can hold.
    """
    from PIL import Image

    if not os.path.isfile(path):
        raise DataError(f"{path}: expected an image, got nothing")
    with (
        reading(path, "an image"),
        BoundedFile(path) as stream,
        Image.open(stream, formats=_FORMATS) as image,
    ):
        if not 0 < image.width * image.height <= min(_PIXELS, _PIXELS_PER_BYTE * stream.size):
            raise ValueError(f"{image.width}x{image.height} pixels in {stream.size} bytes")
        yield image


def _words(error: Any) -> str:
    """An error in one short line; of those whose own words say little, in others."""
    if isinstance(error, KeyError):
        return f"no {error}"
    text = " ".join(str(error).split()) or type(error).__name__
    return _PLAIN.get(type(error).__name__, text[:200])
