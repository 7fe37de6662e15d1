"""What loaders share: images, depth, intrinsics and poses, each checked, and the words for what was found."""

import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image

from jaxpose.errors import DataError
from jaxpose.files.schema import FARTHEST_M
from jaxpose.files.tables import read_numbers
from jaxpose.files.texts import archive_kind
from jaxpose.files.untrusted import opened_image
from jaxpose.geometry.rigid import nearest_rotation

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".ppm", ".pgm")
INTRINSICS = "camera-intrinsics.txt"
_NONE = 65535  # like 0, no measurement: sensors and renderers clip what is too far to it
_LARGEST_ENTRY = 1e3  # of what is made a rotation
_MOST_OFF_ROTATION = 1e-2  # entries of a rotation matrix; beyond it a note says so
_DEPTH_SAMPLES = 5  # depth images looked at before a sequence is accepted


class Pinhole(NamedTuple):
    """Intrinsics [px], the first four fields of a `Camera`."""

    fx: float
    fy: float
    cx: float
    cy: float


# --- images -------------------------------------------------------------------------------------------------


def open_image(file: Path, use: Callable[[Image.Image], Any]) -> Any:
    """What `use` makes of an image file, of which Pillow reads only the header until pixels are asked for."""
    with opened_image(file) as image:
        return use(image)


def image_size(file: Path) -> tuple[int, int]:
    """Width and height, from the image's header; DataError for what is no image."""
    return open_image(file, lambda image: image.size)


def common_size(files: Sequence[Path]) -> tuple[int, int]:
    """Width and height of the first, which all others must have; reads the images' headers only."""
    first = files[0]
    size = image_size(first)
    for file in files[1:]:
        other = image_size(file)
        if other != size:
            raise DataError(
                f"{file}: expected {size[0]}x{size[1]}, the size of {first.name}, got {other[0]}x{other[1]}"
            )
    return size


def read_color(file: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """(height, width, 3) uint8, grey as three equal channels; resized to `size` (width, height) if given."""

    def pixels(image: Image.Image) -> np.ndarray:
        if image.mode.startswith(("I", "F")):  # Pillow would clip these
            raise ValueError(f"pixels of kind {image.mode}, not of 8 bits")
        image = image.convert("RGB")
        return np.asarray(image if size is None else image.resize(size, Image.Resampling.BILINEAR))

    return open_image(file, pixels)


def read_depth(file: Path, per_metre: float = 1000.0) -> np.ndarray:
    """(height, width) float32 [m] of 16-bit counts, 0 where there is none (0 or 65535)."""
    counts = open_image(file, np.asarray)
    if counts.dtype.kind in "ui" and counts.itemsize > 1 and 0 <= counts.min() and counts.max() <= _NONE:
        counts = counts.astype(np.uint16)  # of either order of bytes, and PGM's, which Pillow widens
    if counts.dtype != np.uint16 or counts.ndim != 2:
        found = f"{counts.dtype} of shape {counts.shape}"
        raise DataError(f"{file}: expected {depth_unit(per_metre)}, one channel of 16 bits, got {found}")
    return np.where(counts == _NONE, 0, counts) / np.float32(per_metre)


def check_depth(folder: Path, files: Sequence[Path], per_metre: float = 1000.0) -> None:
    """Refuse a sequence whose depth, looked at here and there, is never valid."""
    depth = lambda i: read_depth(files[i], per_metre)
    check_some_depth(folder, len(files), depth, lambda i: files[i].name, depth_unit(per_metre))


def check_some_depth(
    where: Path | str,
    count: int,
    depth: Callable[[int], np.ndarray],
    name: Callable[[int], str],
    unit: str = "depth",
) -> None:
    """Refuse `count` images whose depth, looked at here and there, is never valid."""
    rows = sorted({round(row) for row in np.linspace(0, count - 1, _DEPTH_SAMPLES)})
    if not any(depth(row).any() for row in rows):
        looked_at = some([name(row) for row in rows])
        raise DataError(f"{where}: expected {unit}, got only 0 and {_NONE} (none) in {looked_at}")


def depth_unit(per_metre: float) -> str:
    """Depth in words."""
    return "depth in mm" if per_metre == 1000 else f"depth in 1/{per_metre:g} m"


# --- numbers ------------------------------------------------------------------------------------------------


def read_matrix(file: Path, size: int) -> Float[np.ndarray, "{size} {size}"]:
    """A square matrix of numbers, NaN and infinity included."""
    _, rows = read_numbers(file, f"{size} numbers", (size,), finite=False)
    if len(rows) != size:
        raise DataError(f"{file}: expected {size} rows of {size} numbers, got {len(rows)} rows")
    return rows


def sidecar(folder: Path, name: str) -> Path | None:
    """The file `name` in the folder, else the one beside it (one folder up), else None."""
    for file in (folder / name, folder.resolve().parent / name):
        if file.is_file():
            return file
    return None


def read_intrinsics(file: Path, size: tuple[int, int], rows: int = 3) -> Pinhole:
    """The pinhole of a 3x3 (or, `rows` = 4, a 4x4) matrix in text, checked against the size of the images."""
    return check_intrinsics(file, read_matrix(file, rows), size)


def check_intrinsics(file: Path, K: Float[np.ndarray, "r r"], size: tuple[int, int]) -> Pinhole:
    """The pinhole that a matrix says; DataError naming the file for what no camera of that size has."""
    width, height = size
    rest = K.copy()
    rest[[0, 1, 0, 1], [0, 1, 2, 2]] = np.eye(len(K))[[0, 1, 0, 1], [0, 1, 2, 2]]
    inside = 0 <= K[0, 2] < width and 0 <= K[1, 2] < height
    if not (0 < K[0, 0] < math.inf and 0 < K[1, 1] < math.inf and inside and (rest == np.eye(len(K))).all()):
        raise DataError(
            f"{file}: expected fx 0 cx / 0 fy cy / 0 0 1 with the centre in {width}x{height}, "
            f"got {' / '.join(' '.join(f'{number:g}' for number in row) for row in K)}"
        )
    return Pinhole(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))


def default_intrinsics(pinhole: Pinhole, size: tuple[int, int], of: tuple[int, int], without: str) -> str:
    """The note on intrinsics that were taken for lack of a file: as published, for images of size `of`."""
    note = f"no {without}: took the published fx fy cx cy = {' '.join(f'{number:g}' for number in pinhole)}"
    if size != of:
        note += f", which are for {of[0]}x{of[1]}; the images are {size[0]}x{size[1]}"
    return note


def frame_times(numbers: Sequence[int], rate_hz: float) -> Float[np.ndarray, " n"]:
    """Seconds since the first of frames that have numbers but no timestamps; ValueError for a bad rate."""
    if not 0 < rate_hz < math.inf:
        raise ValueError(f"rate_hz: expected a positive rate, got {rate_hz}")
    return (np.asarray(numbers) - numbers[0]) / rate_hz


def check_positive(name: str, value: float) -> None:
    """ValueError for a setting that is not a positive number."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name}: expected a positive number, got {value}")


# --- poses --------------------------------------------------------------------------------------------------


def usable_poses(
    T_world_cam: Float[np.ndarray, "n 4 4"], names: Sequence[str], where: Callable[[int], str], lack: str
) -> tuple[Float[np.ndarray, "n 4 4"] | None, tuple[str, ...]]:
    """Ground truth with proper rotations, rows of NaN where it is not finite.

    None if there is no pose at all.

    `names` are the frames' for the notes, `where(i)` names the source of pose i in a DataError for what is no
    rigid transform, and `lack` says why a pose may be missing.
    """
    poses = np.full(T_world_cam.shape, np.nan)
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.any():
        return None, ("no usable poses: there is no ground truth to compare with",)
    known = np.flatnonzero(finite)
    given = T_world_cam[known]
    far = np.abs(given[:, :3, 3]).max(1) > FARTHEST_M
    far |= np.abs(given[:, :3, :3]).max((1, 2)) > _LARGEST_ENTRY
    determinant = np.linalg.det(np.where(far[:, None, None], np.eye(3), given[:, :3, :3]))
    wrong = far | (np.abs(given[:, 3] - [0, 0, 0, 1]).max(1) > 1e-6) | (determinant <= 0)
    if wrong.any():
        k = int(np.argmax(wrong))
        numbers = lambda x: " ".join(f"{number:g}" for number in x)
        said = f"{where(int(known[k]))}: expected a"
        if far[k]:
            position = f"{said} rotation and a position up to {FARTHEST_M:g} m"
            raise DataError(f"{position}, got {numbers(given[k, :3].ravel())}")
        raise DataError(
            f"{said} pose, rotation and last row 0 0 0 1, got determinant {determinant[k]:.3g} and "
            f"{numbers(given[k, 3])}"
        )
    rotations = nearest_rotation(given[:, :3, :3])
    off = np.abs(given[:, :3, :3] - rotations).max((1, 2)) > _MOST_OFF_ROTATION
    repaired = [names[int(i)] for i in known[off]]
    poses[known] = given
    poses[known, :3, :3] = rotations
    notes = []
    if not finite.all():
        lacking = [names[int(i)] for i in np.flatnonzero(~finite)]
        notes.append(f"{len(lacking)} frames without a usable pose ({lack}): {some(lacking)}")
    if repaired:
        notes.append(
            f"{len(repaired)} poses were more than {_MOST_OFF_ROTATION} off a rotation, made orthonormal: "
            f"{some(repaired)}"
        )
    return poses, tuple(notes)


# --- words --------------------------------------------------------------------------------------------------


def natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key by which r_2 comes before r_10."""
    numbers = (part.lstrip("0") if part.isdecimal() else part for part in re.split(r"(\d+)", name))
    return [(len(part) if k % 2 else 0, part) for k, part in enumerate(numbers)]


_SHOWN = 255  # characters of an item of a list


def some(items: Sequence[str], most: int = 5) -> str:
    """The first few of a list, for a message of one line."""
    shown = [item if len(item) <= _SHOWN else f"{item[:_SHOWN]}..." for item in items[:most]]
    return ", ".join(shown) + (", ..." if len(items) > most else "")


def found(path: Path) -> str:
    """What is at a path where a folder with files was expected, for a message of one line."""
    if path.is_file() and (kind := archive_kind(path)) is not None:
        return f"a {kind} archive to be unpacked first"
    if not path.is_dir():
        return "a file" if path.exists() else "nothing"
    return some(sorted(file.name for file in path.iterdir())) or "an empty folder"


def only(candidates: Sequence[Path], path: Path, expected: str, kind: str = "files") -> Path:
    """The one of `kind` found in `path`; DataError saying what was `expected` where there is not just one."""
    if len(candidates) == 1:
        return candidates[0]
    names = some([candidate.name for candidate in candidates])
    got = f"{len(candidates)} {kind}, name one of them: {names}" if candidates else found(path)
    raise DataError(f"{path}: expected {expected}, got {got}")


def within(files: Sequence[Path], path: Path | str) -> tuple[str, ...]:
    """Files by their names in the folder that the user named, as `Recording.files` has them."""
    root = f"{path}{os.sep}"  # most of them are named so, and `relative_to` is slow
    names = ((str(file), file) for file in files)
    return tuple(
        name[len(root) :] if name.startswith(root) else str(file.relative_to(path)) for name, file in names
    )


def name_of(folder: Path) -> str:
    """A recording's name: its folder and the one that holds it."""
    return f"{folder.resolve().parent.name}/{folder.resolve().name}"
