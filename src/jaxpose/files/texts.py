"""Text as other programs and systems write it."""

from collections.abc import Iterator
from pathlib import Path

from jaxpose.errors import DataError
from jaxpose.files.opening import open_file

_ARCHIVES = {
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "zip",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"7z\xbc\xaf": "7z",
    b"Rar!": "rar",
}
_LOOKED_AT = 4096  # bytes, of which text has no 0
_UTF16 = (b"\xff\xfe", b"\xfe\xff")  # what Windows' shell writes


def archive_kind(path: Path) -> str | None:
    """What archive a file is by its first bytes.

    Args:
        path: A file.

    Returns:
        The name of its format; None for what is none.
    """
    with open_file(path) as stream:
        return _archive(stream.read(8))


def _archive(head: bytes) -> str | None:
    return next((name for magic, name in _ARCHIVES.items() if head.startswith(magic)), None)


def read_text(path: Path) -> str:
    """Read text in UTF-8, or in UTF-16 where it begins with that mark; what is no letter is replaced.

    Args:
        path: The file.

    Returns:
        The text, its lines as they end.

    Raises:
        DataError: For an archive and for other bytes that are no text, by the first of them.
    """
    with open_file(path) as stream:
        head = stream.read(8)
        if (name := _archive(head)) is not None:
            raise DataError(f"{path}: expected text, got a {name} archive to be unpacked first")
        content = head + stream.read()
    if content[:2] in _UTF16:
        return content.decode("utf-16", errors="replace")
    if b"\0" in content[:_LOOKED_AT]:
        raise DataError(f"{path}: expected text, got bytes that are none")
    return content.decode("utf-8-sig", errors="replace")


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text with something on them, without blanks around them.

    Args:
        path: The file.

    Returns:
        Their numbers, from 1, and the lines.

    Raises:
        DataError: As `read_text`.
    """
    text = read_text(path).splitlines()
    return ((k, stripped) for k, line in enumerate(text, 1) if (stripped := line.strip()))
