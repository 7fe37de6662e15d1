"""The 7-Scenes layout: `frame-NNNNNN.{color.png,depth.png,pose.txt}` in one folder per sequence."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxpose.datasets.images import (
    INTRINSICS,
    Pinhole,
    check_intrinsics,
    default_intrinsics,
    found,
    frame_times,
    name_of,
    only,
    read_intrinsics,
    read_matrix,
    sidecar,
)
from jaxpose.datasets.rgbd.frames import Poses, of_files, pair_numbered, visible
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.texts import read_text
from jaxpose.geometry.camera import Camera, resized

_FRAME = re.compile(r"frame-(\d{6})\.(color|depth|pose)\.(png|jpg|jpeg|txt)", re.IGNORECASE)
_LAYOUT = "frame-NNNNNN.color.png (or .jpg) with frame-NNNNNN.depth.png"
_PUBLISHED, _PUBLISHED_SIZE = Pinhole(585.0, 585.0, 320.0, 240.0), (640, 480)


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
    """Read a sequence of 7-Scenes, or of BundleFusion, which has the same files and `info.txt`.

    Intrinsics are those of `camera-intrinsics.txt` (3x3) in or beside the sequence, else of `info.txt`, else
    as published. Depth [m] is 0 where the sensor gave none (0 or 65535 mm). Poses are optional: one with NaN
    or infinity, or missing while others are there, is a ground truth of NaN.

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
    files: dict[str, dict[int, Path]] = {"color": {}, "depth": {}, "pose": {}}
    # Sorted, so that of two colour images of a frame the png, which has lost nothing, comes last and stays.
    for file in sorted(visible(folder), key=lambda file: (file.suffix.lower() == ".png", file.name)):
        if match := _FRAME.fullmatch(file.name):
            files[match[2].lower()][int(match[1])] = file
    pairs = pair_numbered(folder, _LAYOUT, files["color"], files["depth"], found(folder))
    info = _read_info(folder)
    none = np.full((4, 4), np.nan)
    where = [files["pose"].get(number) for number in pairs.numbers]
    poses = np.stack([none if file is None else read_matrix(file, 4) for file in where])
    return of_files(
        path,
        pairs.colors,
        pairs.depths,
        lambda size, depth_size: _intrinsics(folder, info, size, depth_size),
        t=frame_times(pairs.numbers, rate_hz),
        names=[f"{number:06d}" for number in pairs.numbers],
        poses=Poses(poses, lambda i: str(where[i])),
        per_metre=1000.0 if info is None else info.per_metre,
        notes=pairs.notes,
    )._replace(name=name_of(folder))


class _Info(NamedTuple):
    """What BundleFusion's `info.txt` says of depth, to which colour is registered."""

    file: Path
    camera: Camera
    per_metre: float


def _read_info(folder: Path) -> _Info | None:
    """BundleFusion's lines of `m_key = numbers`; None without the file."""
    file = folder / "info.txt"
    if not file.is_file():
        return None
    pairs = (line.partition("=")[::2] for line in read_text(file).splitlines())
    values = {key.strip(): value.split() for key, value in pairs}
    try:
        matrix = np.array(values["m_calibrationDepthIntrinsic"], np.float64).reshape(-1, 4)[:3, :3]
        size = int(values["m_depthWidth"][0]), int(values["m_depthHeight"][0])
        per_metre = float(values["m_depthShift"][0])
    except (KeyError, ValueError, IndexError) as error:
        keys = "m_calibrationDepthIntrinsic, m_depthWidth, m_depthHeight and m_depthShift"
        raise DataError(f"{file}: expected {keys}, got {type(error).__name__} {error}") from None
    if not 0 < per_metre < np.inf:
        raise DataError(f"{file}: expected a positive m_depthShift, got {per_metre:g}")
    return _Info(file, Camera(*check_intrinsics(file, matrix, size), *size), per_metre)


def _sequence_folder(path: Path) -> Path:
    """The folder that holds the frames."""
    if not path.is_dir():
        raise DataError(f"{path}: expected a folder of {_LAYOUT}, got {found(path)}")
    if any(_FRAME.fullmatch(file.name) for file in visible(path)):
        return path
    sequences = sorted(folder for folder in path.glob("seq-*") if folder.is_dir())
    return only(sequences, path, f"{_LAYOUT}, or one folder seq-* of them", "sequences")


def _intrinsics(
    folder: Path, info: _Info | None, size: tuple[int, int], depth_size: tuple[int, int]
) -> tuple[Pinhole | Camera, tuple[str, ...]]:
    """Those of the file in or beside the sequence, else of `info.txt`, else as published, with a note."""
    file = sidecar(folder, INTRINSICS)
    if file is not None:
        return read_intrinsics(file, size), ()
    if info is not None:
        if (info.camera.width, info.camera.height) != depth_size:
            stated, got = (f"{w}x{h}" for w, h in (info.camera[4:6], depth_size))
            raise DataError(f"{info.file}: expected the size of the depth images, {got}, got {stated}")
        return resized(info.camera, *size), ()
    return _PUBLISHED, (default_intrinsics(_PUBLISHED, size, _PUBLISHED_SIZE, INTRINSICS),)
