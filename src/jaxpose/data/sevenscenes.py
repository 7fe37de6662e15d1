"""The 7-Scenes layout: `frame-NNNNNN.{color.png,depth.png,pose.txt}` in one folder per sequence."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image

from jaxpose.camera import Camera
from jaxpose.errors import DataError
from jaxpose.metrics import nearest_rotation
from jaxpose.recording import Frame, Recording

_FRAME = re.compile(r"frame-(\d{6})\.(color\.png|color\.jpg|depth\.png|pose\.txt)")
_LAYOUT = "frame-NNNNNN.color.png (or .jpg) with frame-NNNNNN.depth.png"
_PUBLISHED = (585.0, 585.0, 320.0, 240.0)  # fx fy cx cy of the data set, for 640 x 480
_MOST_OFF_ROTATION = 1e-2  # entries of a rotation matrix; beyond it the user is told
_DEPTH_SAMPLES = 5  # depth images looked at before a sequence is accepted


class _Files(NamedTuple):
    """The files of one frame."""

    number: int
    color: Path
    depth: Path
    pose: Path | None


def load(path: Path | str, *, rate_hz: float = 30.0) -> Recording:
    """Read the sequence folder `path`, or the only `seq-*` in it.

    The data set has no time stamps: frame number k is (k - first) / rate_hz seconds after the first, so a
    missing frame leaves its gap. Depth [m] is 0 where the sensor gave none (0 or 65535 mm). Poses are
    optional: one with NaN or infinity, or missing while others are there, is a truth of NaN. What had to be
    skipped, repaired or assumed is told in `notes`. Images are read when asked for.

    DataError naming the file for anything that cannot be used; ValueError for a rate that is not positive.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"rate_hz: expected a positive rate, got {rate_hz}")
    folder = _sequence_folder(Path(path))
    frames, skipped = _list_frames(folder)
    width, height = _common_size(frames)
    intrinsics, assumed = _read_intrinsics(folder, width, height)
    _check_depth(folder, frames)
    _read_color(frames[0].color)
    poses, repaired = _read_poses(frames)
    numbers = np.array([frame.number for frame in frames])
    return Recording(
        name=f"{folder.resolve().parent.name}/{folder.resolve().name}",
        camera=Camera(*intrinsics, width, height),
        t=(numbers - numbers[0]) / rate_hz,
        read=lambda i: Frame(_read_color(frames[i].color), _read_depth(frames[i].depth)),
        T_world_cam=poses,
        notes=(*skipped, *assumed, *repaired),
        files=tuple(str(frame.color.relative_to(path)) for frame in frames),
    )


def _sequence_folder(path: Path) -> Path:
    """The folder that holds the frames."""
    if not path.is_dir():
        raise DataError(
            f"{path}: expected a folder of {_LAYOUT}, got {'a file' if path.exists() else 'nothing'}"
        )
    if any(_FRAME.fullmatch(file.name) for file in path.iterdir()):
        return path
    sequences = sorted(folder for folder in path.glob("seq-*") if folder.is_dir())
    if len(sequences) == 1:
        return sequences[0]
    if sequences:
        found = (
            f"{len(sequences)} sequences, name one of them: {_some([folder.name for folder in sequences])}"
        )
    else:
        found = _some(sorted(file.name for file in path.iterdir())) or "an empty folder"
    raise DataError(f"{path}: expected {_LAYOUT}, or one folder seq-* of them, got {found}")


def _list_frames(folder: Path) -> tuple[list[_Files], tuple[str, ...]]:
    """Frames that have colour and depth, in order, and a note on those that lack one."""
    found: dict[int, dict[str, Path]] = {}
    # Sorted, so that of two colour images of a frame the png, which has lost nothing, comes last and stays.
    for file in sorted(folder.iterdir(), key=lambda file: (file.name.endswith("png"), file.name)):
        if match := _FRAME.fullmatch(file.name):
            found.setdefault(int(match[1]), {})[match[2].split(".")[0]] = file
    frames, lacking = [], []
    for number, files in sorted(found.items()):
        missing = [kind for kind in ("color", "depth") if kind not in files]
        if missing:
            lacking.append(f"{number:06d} has no {' and no '.join(missing)}")
        else:
            frames.append(_Files(number, files["color"], files["depth"], files.get("pose")))
    if not frames:
        raise DataError(f"{folder}: expected {_LAYOUT}, got {_some(lacking)}")
    return frames, (f"{len(lacking)} frames skipped: {_some(lacking)}",) if lacking else ()


def _common_size(frames: list[_Files]) -> tuple[int, int]:
    """Width and height, which every image of the sequence must have; reads the images' headers only."""
    first = frames[0].color
    width, height = _image(first, lambda image: image.size)
    for file in (file for frame in frames for file in (frame.color, frame.depth)):
        other = _image(file, lambda image: image.size)
        if other != (width, height):
            raise DataError(
                f"{file}: expected {width}x{height}, the size of {first.name}, got {other[0]}x{other[1]}"
            )
    return width, height


def _read_intrinsics(
    folder: Path, width: int, height: int
) -> tuple[tuple[float, float, float, float], tuple[str, ...]]:
    """fx, fy, cx, cy [px] of the file in or beside the sequence, else as published, with a note."""
    for file in (folder / "camera-intrinsics.txt", folder.resolve().parent / "camera-intrinsics.txt"):
        if file.is_file():
            break
    else:
        note = "no camera-intrinsics.txt: took the published fx fy cx cy = 585 585 320 240"
        if (width, height) != (640, 480):
            note += f", which are for 640x480; the images are {width}x{height}"
        return _PUBLISHED, (note,)
    K = _read_matrix(file, 3)
    inside = 0 <= K[0, 2] < width and 0 <= K[1, 2] < height
    zeros = K[[0, 1, 2, 2], [1, 0, 0, 1]]
    if not (K[0, 0] > 0 and K[1, 1] > 0 and inside and not zeros.any() and K[2, 2] == 1):
        raise DataError(
            f"{file}: expected fx 0 cx / 0 fy cy / 0 0 1 with the centre in {width}x{height}, "
            f"got {' / '.join(' '.join(f'{number:g}' for number in row) for row in K)}"
        )
    return (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])), ()


def _check_depth(folder: Path, frames: list[_Files]) -> None:
    """Refuse a sequence whose depth, looked at here and there, is never valid."""
    rows = sorted({round(row) for row in np.linspace(0, len(frames) - 1, _DEPTH_SAMPLES)})
    if not any(_read_depth(frames[row].depth).any() for row in rows):
        looked_at = _some([frames[row].depth.name for row in rows])
        raise DataError(f"{folder}: expected depth in mm, got only 0 and 65535 (none) in {looked_at}")


def _read_poses(frames: list[_Files]) -> tuple[Float[np.ndarray, "n 4 4"] | None, tuple[str, ...]]:
    """Truth with proper rotations, rows of NaN where it is not finite; None if there is no pose at all."""
    poses = np.full((len(frames), 4, 4), np.nan)
    unusable, repaired = [], []
    for row, frame in enumerate(frames):
        pose = None if frame.pose is None else _read_matrix(frame.pose, 4)
        if pose is None or not np.isfinite(pose).all():
            unusable.append(f"{frame.number:06d}")
            continue
        if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6 or np.linalg.det(pose[:3, :3]) <= 0:
            raise DataError(
                f"{frame.pose}: expected a pose, rotation and last row 0 0 0 1, got determinant "
                f"{np.linalg.det(pose[:3, :3]):.3g} and {' '.join(f'{number:g}' for number in pose[3])}"
            )
        rotation = nearest_rotation(pose[:3, :3])
        if np.abs(pose[:3, :3] - rotation).max() > _MOST_OFF_ROTATION:
            repaired.append(f"{frame.number:06d}")
        poses[row] = pose
        poses[row, :3, :3] = rotation
    if len(unusable) == len(frames):
        return None, ("no usable poses: there is no truth to compare with",)
    notes = []
    if unusable:
        notes.append(
            f"{len(unusable)} frames without a usable pose (none, NaN or infinity): {_some(unusable)}"
        )
    if repaired:
        notes.append(
            f"{len(repaired)} poses were more than {_MOST_OFF_ROTATION} off a rotation, made orthonormal: "
            f"{_some(repaired)}"
        )
    return poses, tuple(notes)


def _read_matrix(file: Path, size: int) -> Float[np.ndarray, "{size} {size}"]:
    """A square matrix of numbers, NaN and infinity included."""
    rows = []
    for number, line in enumerate(_read_text(file).splitlines(), start=1):
        if not (fields := line.split()):
            continue
        try:
            rows.append([float(field) for field in fields])
        except ValueError:
            raise DataError(f"{file}:{number}: expected {size} numbers, got {line[:60]!r}") from None
        if len(fields) != size:
            raise DataError(f"{file}:{number}: expected {size} numbers, got {len(fields)}")
    if len(rows) != size:
        raise DataError(f"{file}: expected {size} rows of {size} numbers, got {len(rows)} rows")
    return np.array(rows)


def _read_text(file: Path) -> str:
    return file.read_text(encoding="utf-8-sig", errors="replace")


def _read_color(file: Path) -> np.ndarray:
    """(height, width, 3) uint8."""
    return _image(file, lambda image: np.asarray(image.convert("RGB")))


def _read_depth(file: Path) -> np.ndarray:
    """(height, width) float32 [m], 0 where there is none."""
    millimetres = _image(file, np.asarray)
    if millimetres.dtype != np.uint16 or millimetres.ndim != 2:
        found = f"{millimetres.dtype} of shape {millimetres.shape}"
        raise DataError(f"{file}: expected depth in mm, one channel of 16 bits, got {found}")
    return np.where(millimetres == 65535, 0, millimetres) / np.float32(1000)


def _image(file: Path, use: Callable[[Image.Image], Any]) -> Any:
    """What `use` makes of an image file, of which Pillow reads only the header until pixels are asked for."""
    try:
        with Image.open(file) as image:
            return use(image)
    except Exception as error:  # Pillow raises many kinds on damaged files
        found = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{file}: expected an image, got {found}") from None


def _some(items: list[str], most: int = 5) -> str:
    """The first few of a list, for a message of one line."""
    return ", ".join(items[:most]) + (", ..." if len(items) > most else "")
