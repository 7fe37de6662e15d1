"""The opening of files: what has no end, or waits for who writes it, is refused before it is read."""

import io
import os
import stat
from pathlib import Path
from typing import BinaryIO, TextIO

from jaxpose.errors import DataError

_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
_KINDS |= dict.fromkeys((stat.S_IFCHR, stat.S_IFBLK), "a device")


def check_file(path: Path | str) -> None:
    """Refuse what is no file, folders aside, which the system refuses to open; OSError as usual.

    Args:
        path: What is to be read.

    Raises:
        DataError: For a pipe, a socket and a device: files are read more than once, and to their end.
    """
    kind = _KINDS.get(stat.S_IFMT(os.stat(path).st_mode))
    if kind is not None:
        raise DataError(f"{path}: expected a file, got {kind}")


def open_file(path: Path | str) -> BinaryIO:
    """Open a file to read its bytes; DataError and OSError as `check_file`."""
    check_file(path)
    return open(path, "rb")


def open_text(path: Path | str, errors: str = "replace") -> TextIO:
    """Open a file to read its text, in UTF-8; DataError and OSError as `check_file`.

    Args:
        path: The file.
        errors: What becomes of bytes that are no letter, as `open` has it.

    Returns:
        The open file.
    """
    check_file(path)
    return open(path, encoding="utf-8-sig", errors=errors)


def read_bytes(path: Path | str) -> bytes:
    """All bytes of a file; DataError and OSError as `check_file`."""
    with open_file(path) as stream:
        return stream.read()


class BoundedFile(io.BufferedReader):
    """An open file of which no more is asked than it holds: Python makes space for all that is asked first.

    Args:
        path: The file; DataError and OSError as `check_file`.
    """

    def __init__(self, path: Path | str):
        check_file(path)
        super().__init__(io.FileIO(path))
        self.size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """So many bytes, or what is left."""
        if size is not None and size > io.DEFAULT_BUFFER_SIZE:
            size = min(size, max(self.size - self.tell(), 0))
        return super().read(size)
