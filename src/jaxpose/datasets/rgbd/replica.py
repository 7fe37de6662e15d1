"""Replica as NICE-SLAM renders it: `results/frameNNNNNN.jpg`, `results/depthNNNNNN.png` and `traj.txt`."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxpose.datasets.images import (
    Pinhole,
    check_intrinsics,
    default_intrinsics,
    found,
    frame_times,
    image_size,
    sidecar,
)
from jaxpose.datasets.rgbd.frames import Poses, of_files, pair_numbered, visible
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.schema import numbers
from jaxpose.files.tables import read_numbers
from jaxpose.files.untrusted import read_json
from jaxpose.geometry.camera import pinhole_matrix

_IMAGE = re.compile(r"(frame|depth)(\d+)\.(jpg|jpeg|png)", re.IGNORECASE)
_LAYOUT = "results/frameNNNNNN.jpg with results/depthNNNNNN.png"
_PARAMETERS = "cam_params.json"
_PUBLISHED, _PUBLISHED_SIZE = Pinhole(600.0, 600.0, 599.5, 339.5), (1200, 680)
_PER_METRE = 6553.5


class _Parameters(NamedTuple):
    pinhole: Pinhole
    per_metre: float
    notes: tuple[str, ...]


def detect(path: Path) -> bool:
    """Whether a folder has the layout's images or poses.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return (path / "results").is_dir() or (path / "traj.txt").is_file()


def load(path: Path | str, *, rate_hz: float = 30.0) -> Recording:
    """Read a scene as NICE-SLAM renders Replica.

    Line k of `traj.txt` is the camera-to-world pose of frame k, 16 numbers row by row, axes right, down,
    forward already (NICE-SLAM turns them to OpenGL's when it reads them). Intrinsics and depth counts per
    metre are those of `cam_params.json` in the folder or one up, else the published ones, as a note says.
    Depth [m] is 0 where there is none or it is 10 m and more (0 or 65535 counts).

    Args:
        path: The scene folder.
        rate_hz: Frames a second, as there are no timestamps: frame k is (k - first) / rate_hz seconds after
            the first.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    folder = Path(path)
    results = folder / "results"
    if not results.is_dir():
        raise DataError(f"{folder}: expected a folder of {_LAYOUT}, got {found(folder)}")
    files: dict[str, dict[int, Path]] = {"frame": {}, "depth": {}}
    for file in visible(results):
        if match := _IMAGE.fullmatch(file.name):
            files[match[1].lower()][int(match[2])] = file
    pairs = pair_numbered(folder, _LAYOUT, files["frame"], files["depth"], found(results))
    pinhole, per_metre, assumed = _read_parameters(folder, image_size(pairs.colors[0]))
    return of_files(
        path,
        pairs.colors,
        pairs.depths,
        lambda size, depth_size: (pinhole, assumed),
        t=frame_times(pairs.numbers, rate_hz),
        names=[f"{number:06d}" for number in pairs.numbers],
        poses=_read_poses(folder / "traj.txt", pairs.numbers),
        per_metre=per_metre,
        notes=pairs.notes,
    )


def _read_parameters(folder: Path, size: tuple[int, int]) -> _Parameters:
    """Intrinsics and depth scale, and a note where they are assumed."""
    file = sidecar(folder, _PARAMETERS)
    if file is None:
        note = default_intrinsics(_PUBLISHED, size, _PUBLISHED_SIZE, _PARAMETERS)
        return _Parameters(_PUBLISHED, _PER_METRE, (f"{note}, and {_PER_METRE} depth counts per metre",))
    camera = read_json(file, "the camera").get("camera")
    fx, fy, cx, cy, width, height = (
        float(numbers(file, camera, key)) for key in ("fx", "fy", "cx", "cy", "w", "h")
    )
    scaled = isinstance(camera, dict) and "scale" in camera
    per_metre = float(numbers(file, camera, "scale", above=0)) if scaled else _PER_METRE
    if (width, height) != size:
        raise DataError(
            f"{file}: expected the size of the images, {size[0]}x{size[1]}, got {width:g}x{height:g}"
        )
    K = pinhole_matrix(fx, fy, cx, cy)
    return _Parameters(check_intrinsics(file, K, size), per_metre, ())


def _read_poses(file: Path, frames: list[int]) -> Poses:
    """Ground truth by frame number."""
    if not file.is_file():
        return Poses(None, str, missing="no traj.txt")
    lines, rows = read_numbers(file, "16 numbers (a 4x4 pose, row by row)", (16,), finite=False)
    poses = np.full((len(frames), 4, 4), np.nan)
    for i, number in enumerate(frames):
        if number < len(rows):
            poses[i] = rows[number].reshape(4, 4)
    return Poses(poses, lambda i: f"{file}:{lines[frames[i]]}")
