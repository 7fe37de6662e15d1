"""Replica as NICE-SLAM renders it: `results/frameNNNNNN.jpg`, `results/depthNNNNNN.png` and `traj.txt`."""

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import (
    Pinhole,
    check_depth,
    check_intrinsics,
    common_size,
    default_intrinsics,
    found,
    frame_times,
    name_of,
    read_color,
    read_depth,
    sidecar,
    some,
    usable_poses,
    within,
)
from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.files import schema
from jaxpose.files.tables import read_numbers
from jaxpose.files.untrusted import read_json
from jaxpose.geometry.camera import Camera

_IMAGE = re.compile(r"(frame|depth)(\d+)\.(jpg|jpeg|png)")
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
    numbers, colors, depths, skipped = _list_frames(folder)
    t = frame_times(numbers, rate_hz)
    size = common_size([*colors, *depths])
    pinhole, per_metre, assumed = _read_parameters(folder, size)
    check_depth(folder, depths, per_metre)
    read_color(colors[0])
    poses, lacking = _read_poses(folder / "traj.txt", numbers)
    return Recording(
        name=name_of(folder),
        camera=Camera(*pinhole, *size),
        t=t,
        read=lambda i: Frame(read_color(colors[i]), read_depth(depths[i], per_metre)),
        T_world_cam=poses,
        notes=(*skipped, *assumed, *lacking),
        files=within(colors, path),
    )


def _list_frames(folder: Path) -> tuple[list[int], list[Path], list[Path], tuple[str, ...]]:
    """Numbers and images of the frames that have both, in order, and a note on those that lack one."""
    results = folder / "results"
    if not results.is_dir():
        raise DataError(f"{folder}: expected a folder of {_LAYOUT}, got {found(folder)}")
    files: dict[str, dict[int, Path]] = {"frame": {}, "depth": {}}
    for file in sorted(results.iterdir()):
        if match := _IMAGE.fullmatch(file.name):
            files[match[1]][int(match[2])] = file
    color, depth = files["frame"], files["depth"]
    both = sorted(color.keys() & depth.keys())
    lacking = [f"{number:06d}" for number in sorted(color.keys() ^ depth.keys())]
    if not both:
        got = f"half of it for {some(lacking)}" if lacking else found(results)
        raise DataError(f"{folder}: expected {_LAYOUT}, got {got}")
    skipped = (f"{len(lacking)} frames skipped, without color or depth: {some(lacking)}",) if lacking else ()
    return both, [color[number] for number in both], [depth[number] for number in both], skipped


def _read_parameters(folder: Path, size: tuple[int, int]) -> _Parameters:
    """Intrinsics and depth scale, and a note where they are assumed."""
    file = sidecar(folder, _PARAMETERS)
    if file is None:
        note = default_intrinsics(_PUBLISHED, size, _PUBLISHED_SIZE, _PARAMETERS)
        return _Parameters(_PUBLISHED, _PER_METRE, (f"{note}, and {_PER_METRE} depth counts per metre",))
    values = read_json(file, "the camera of the recording").get("camera", {})
    number = lambda key: float(schema.numbers(file, values, key))
    width, height, fx, fy, cx, cy = map(number, ("w", "h", "fx", "fy", "cx", "cy"))
    per_metre = number("scale") if "scale" in values else _PER_METRE
    if (width, height) != size:
        raise DataError(
            f"{file}: expected the size of the images, {size[0]}x{size[1]}, got {width:g}x{height:g}"
        )
    if not 0 < per_metre < math.inf:
        raise DataError(f"{file}: expected a positive scale, got {per_metre}")
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return _Parameters(check_intrinsics(file, K, size), per_metre, ())


def _read_poses(file: Path, numbers: list[int]) -> tuple[Float[np.ndarray, "n 4 4"] | None, tuple[str, ...]]:
    """Ground truth by frame number, and notes on what is missing or was repaired."""
    if not file.is_file():
        return None, ("no traj.txt: there is no ground truth to compare with",)
    lines, rows = read_numbers(file, "16 numbers (a 4x4 pose, row by row)", (16,), finite=False)
    poses = np.full((len(numbers), 4, 4), np.nan)
    for i, number in enumerate(numbers):
        if number < len(rows):
            poses[i] = rows[number].reshape(4, 4)
    names = [f"{number:06d}" for number in numbers]
    return usable_poses(poses, names, lambda i: f"{file}:{lines[numbers[i]]}", "none, NaN or infinity")
