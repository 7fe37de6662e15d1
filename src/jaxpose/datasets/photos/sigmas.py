"""How sure stated poses are: a table of one sigma of position and one of rotation for each photograph."""

import math
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import SUFFIXES, some
from jaxpose.errors import DataError
from jaxpose.files.atomic import write_text
from jaxpose.files.schema import FARTHEST_M
from jaxpose.files.tables import numbered_lines

_COLUMNS = "an image, the sigma of its position and that of its rotation [deg]"
_OTHERS = "*"


def read_sigmas(path: Path, files: Sequence[str]) -> tuple[Float[np.ndarray, "n 2"], tuple[str, ...]]:
    """Read what is known of how sure poses are.

    Args:
        path: Lines of an image's name, the sigma of its position along each axis [scene units] and that of
            its rotation about each [deg], between commas or blanks; a header before them may name the
            columns. The image `*` is every other one.
        files: The names of the images.

    Returns:
        Sigmas of position [scene units] and rotation [rad] of every image; and notes on lines that are of
        none of them.

    Raises:
        DataError: Naming file and line for anything else, for two lines of one image, and for images without
            a line.
    """
    stated: dict[str, tuple[float, float]] = {}
    for row, (number, line) in enumerate(numbered_lines(path)):
        words = [word.strip().strip('"') for word in line.rsplit("," if "," in line else None, 2)]
        name, sigmas = words[0], _numbers(words[1:])
        if sigmas is None and row == 0 and len(words) == 3:
            continue  # the names of the columns
        if sigmas is None or len(words) != 3:
            raise DataError(f"{path}:{number}: expected {_COLUMNS}, got {line[:60]!r}")
        position, degrees = sigmas
        if not (0 < position <= FARTHEST_M and 0 < degrees <= 180):
            raise DataError(
                f"{path}:{number}: expected sigmas above 0, of at most {FARTHEST_M:g} and 180 degrees, "
                f"got {position:g} and {degrees:g}"
            )
        if _plain(name) in stated:
            raise DataError(f"{path}:{number}: expected one line of each image, got another of {name}")
        stated[_plain(name)] = position, math.radians(degrees)
    return _of_files(path, stated, files)


def write_sigmas(path: Path, files: Sequence[str], sigmas: Float[np.ndarray, "n 2"]) -> None:
    """Write a table that `read_sigmas` reads.

    Args:
        path: The file.
        files: The names of the images.
        sigmas: Of position [scene units] and rotation [rad]; rows of NaN are left out.
    """
    rows = [
        f"{file},{position:.6g},{math.degrees(rotation):.6g}"
        for file, (position, rotation) in zip(files, sigmas.tolist(), strict=True)
        if math.isfinite(position)
    ]
    write_text(path, "\n".join(["image,position,rotation_deg", *rows]) + "\n")


def _of_files(
    path: Path, stated: dict[str, tuple[float, float]], files: Sequence[str]
) -> tuple[Float[np.ndarray, "n 2"], tuple[str, ...]]:
    found, used, lacking = [], {_OTHERS}, []
    for file in files:
        # A table may have names without the folder that the photographs are in.
        names = (_plain(file), PurePosixPath(_plain(file)).name, _OTHERS)
        name = next((name for name in names if name in stated), None)
        if name is None:
            lacking.append(file)
            continue
        if name != _OTHERS and name in used:
            raise DataError(f"{path}: expected names of one image each, got {name}, which is of two")
        used.add(name)
        found.append(stated[name])
    if lacking:
        raise DataError(f"{path}: expected a line of every image, or one of *, got none of {some(lacking)}")
    others = [name for name in stated if name not in used]
    notes = (f"{path.name}: lines of no image that is trained on: {some(others)}",) if others else ()
    return np.array(found, np.float64), notes


def _plain(name: str) -> str:
    """A name without its suffix and what stands for the folder itself."""
    path = PurePosixPath(name.replace("\\", "/"))
    return (path.with_suffix("") if path.suffix.lower() in SUFFIXES else path).as_posix()


def _numbers(words: Sequence[str]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None
