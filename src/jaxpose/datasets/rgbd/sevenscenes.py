"""The 7-Scenes layout: `frame-NNNNNN.{color.png,depth.png,pose.txt}` in one folder per sequence."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import (
    INTRINSICS,
    Pinhole,
    check_depth,
    common_size,
    default_intrinsics,
    found,
    frame_times,
    name_of,
    only,
    read_color,
    read_depth,
    read_intrinsics,
    read_matrix,
    sidecar,
    some,
    usable_poses,
    within,
)
from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera

_FRAME = re.compile(r"frame-(\d{6})\.(color\.png|color\.jpg|depth\.png|pose\.txt)")
_LAYOUT = "frame-NNNNNN.color.png (or .jpg) with frame-NNNNNN.depth.png"
_PUBLISHED, _PUBLISHED_SIZE = Pinhole(585.0, 585.0, 320.0, 240.0), (640, 480)


class _Files(NamedTuple):
    """The files of one frame."""

    number: int
    color: Path
    depth: Path
    pose: Path | None


def detect(path: Path) -> bool:
    """Whether a folder is a sequence or holds sequences.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    files = path.iterdir() if path.is_dir() else ()
    return any(_FRAME.fullmatch(file.name) or file.match("seq-*") for file in files)


def load(path: Path | str, *, rate_hz: float = 30.0) -> Recording:
    """Read a sequence of 7-Scenes.

    Depth [m] is 0 where the sensor gave none (0 or 65535 mm). Poses are optional: one with NaN or infinity,
    or missing while others are there, is a ground truth of NaN. Images are read when asked for.

    Args:
        path: The sequence folder, or one that holds a single `seq-*`.
        rate_hz: Frames a second, as the data set has no timestamps: frame number k is (k - first) / rate_hz
            seconds after the first, so a missing frame leaves its gap.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    folder = _sequence_folder(Path(path))
    frames, skipped = _list_frames(folder)
    t = frame_times([frame.number for frame in frames], rate_hz)
    size = common_size([file for frame in frames for file in (frame.color, frame.depth)])
    pinhole, assumed = _intrinsics(folder, size)
    check_depth(folder, [frame.depth for frame in frames])
    read_color(frames[0].color)
    poses, repaired = _read_poses(frames)
    return Recording(
        name=name_of(folder),
        camera=Camera(*pinhole, *size),
        t=t,
        read=lambda i: Frame(read_color(frames[i].color), read_depth(frames[i].depth)),
        T_world_cam=poses,
        notes=(*skipped, *assumed, *repaired),
        files=within([frame.color for frame in frames], path),
    )


def _sequence_folder(path: Path) -> Path:
    """The folder that holds the frames."""
    if not path.is_dir():
        raise DataError(f"{path}: expected a folder of {_LAYOUT}, got {found(path)}")
    if any(_FRAME.fullmatch(file.name) for file in path.iterdir()):
        return path
    sequences = sorted(folder for folder in path.glob("seq-*") if folder.is_dir())
    return only(sequences, path, f"{_LAYOUT}, or one folder seq-* of them", "sequences")


def _list_frames(folder: Path) -> tuple[list[_Files], tuple[str, ...]]:
    """Frames that have colour and depth, in order, and a note on those that lack one."""
    by_number: dict[int, dict[str, Path]] = {}
    # Sorted, so that of two colour images of a frame the png, which has lost nothing, comes last and stays.
    for file in sorted(folder.iterdir(), key=lambda file: (file.name.endswith("png"), file.name)):
        if match := _FRAME.fullmatch(file.name):
            by_number.setdefault(int(match[1]), {})[match[2].split(".")[0]] = file
    frames, lacking = [], []
    for number, files in sorted(by_number.items()):
        missing = [kind for kind in ("color", "depth") if kind not in files]
        if missing:
            lacking.append(f"{number:06d} has no {' and no '.join(missing)}")
        else:
            frames.append(_Files(number, files["color"], files["depth"], files.get("pose")))
    if not frames:
        raise DataError(f"{folder}: expected {_LAYOUT}, got {some(lacking)}")
    return frames, (f"{len(lacking)} frames skipped: {some(lacking)}",) if lacking else ()


def _intrinsics(folder: Path, size: tuple[int, int]) -> tuple[Pinhole, tuple[str, ...]]:
    """Those of the file in or beside the sequence, else as published, with a note."""
    file = sidecar(folder, INTRINSICS)
    if file is None:
        return _PUBLISHED, (default_intrinsics(_PUBLISHED, size, _PUBLISHED_SIZE, INTRINSICS),)
    return read_intrinsics(file, size), ()


def _read_poses(frames: list[_Files]) -> tuple[Float[np.ndarray, "n 4 4"] | None, tuple[str, ...]]:
    """Ground truth, and notes on what is missing or was repaired."""
    none = np.full((4, 4), np.nan)
    poses = [none if frame.pose is None else read_matrix(frame.pose, 4) for frame in frames]
    names = [f"{frame.number:06d}" for frame in frames]
    return usable_poses(np.stack(poses), names, lambda i: str(frames[i].pose), "none, NaN or infinity")
