"""Files that appear whole or not at all, and JSON."""

import dataclasses
import json
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.errors import DataError

_MARK = ".unfinished"
_TEMPORARY = re.compile(r"\..+\.\d+\.unfinished(\.\w+)?")


@contextmanager
def atomic(path: Path | str) -> Iterator[Path]:
    """Where to write a file that is to appear at `path` only when the block ends, and not if it fails.

    The temporary path is in the same folder and has the same suffix (by which some writers choose a format).
    It is on the disk before it takes the place of `path`, so that a crash of the machine leaves one or the
    other. A link is followed; DataError for what is no file, as a device; OSError names the path.
    """
    path = Path(path)
    place = Path(os.path.realpath(path)) if path.is_symlink() else path
    if place.is_symlink():
        raise DataError(f"{path}: expected a file to write, got a link that leads to itself")
    if place.exists() and not place.is_file():
        raise DataError(
            f"{path}: expected a file to write, got {'a folder' if place.is_dir() else 'a device'}"
        )
    temporary = place.with_name(f".{place.stem}.{os.getpid()}{_MARK}{place.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        os.replace(temporary, place)
    except OSError as error:
        if error.filename is None and error.errno is not None:  # a full disk does not say where
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from None
        raise
    finally:
        temporary.unlink(missing_ok=True)


def clear_temporary(folder: Path) -> None:
    """Delete what `atomic` has left in a folder where it was killed; nothing else.

    Args:
        folder: in which nothing is being written.
    """
    for path in folder.glob(f".*{_MARK}*"):
        if _TEMPORARY.fullmatch(path.name) and path.is_file() and not path.is_symlink():
            path.unlink(missing_ok=True)


def write_text(path: Path | str, text: str) -> None:
    """Write a text file atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON atomically; see `json_text` for what it takes."""
    write_text(path, json_text(value) + "\n")


def json_text(value: Any) -> str:
    """A value as JSON.

    Beside what JSON knows, it takes numpy and JAX numbers and arrays, paths, dataclasses and NamedTuples (as
    objects); NaN and infinities, which JSON lacks, become null. TypeError for anything else.
    """
    return json.dumps(_plain(value), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    """The value in JSON's own types."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()  # pyright: ignore[reportAttributeAccessIssue]
    elif hasattr(value, "__array__"):
        value = np.asarray(value).tolist()
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
