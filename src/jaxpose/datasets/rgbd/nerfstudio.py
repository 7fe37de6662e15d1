"""nerfstudio's `transforms.json` whose frames have a `depth_file_path`: images, depth, poses, one camera."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.images import frame_times, natural_order, read_depth, some
from jaxpose.datasets.photos.common import OPENGL
from jaxpose.datasets.rgbd.frames import Listing, Poses, of_files
from jaxpose.datasets.rgbd.phones import middle
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.opening import read_bytes
from jaxpose.files.schema import choice, numbers
from jaxpose.files.timestamps import nanoseconds
from jaxpose.files.untrusted import read_json, read_npy
from jaxpose.geometry.camera import Camera

_FILE = "transforms.json"
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
_LENS = ("k1", "k2", "p1", "p2", "k3")
_IN_MM = 50.0  # a depth above it is in mm


def detect(path: Path) -> bool:
    """Whether a folder has the layout's file, and depth in it.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    file = path / _FILE
    return file.is_file() and b'"depth_file_path"' in read_bytes(file)


def has_timestamps(path: Path) -> bool:
    """Whether each frame of the file has a time of its own.

    Args:
        path: The folder.

    Returns:
        True for `time` or `timestamp` in all frames.
    """
    return _times(path / _FILE, _frames(path / _FILE, read_json(path / _FILE, "frames"))) is not None


def load(path: Path | str, *, rate_hz: float = 30.0) -> Recording:
    """Read a folder of nerfstudio's with depth.

    A frame without colour or depth is left out and counted. Depth is a PNG of 16 bits in mm (or in the file's
    `depth_unit_scale_factor`, metres a count), or an array (npy) in mm where its values are above 50, else in
    metres. Poses are camera-to-world in OpenGL's axes, in
    the file's world, whose z nerfstudio turns up. The camera is the file's, or the median of those of the
    frames; cx and cy are counted from the outer corner of the first pixel. Times are the frames' `time` or
    `timestamp` [s] if each has one of its own, in the order of their names else.

    Args:
        path: The folder.
        rate_hz: Frames a second, where they have no times.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    folder = Path(path)
    file = folder / _FILE
    content = read_json(file, "frames with depth_file_path")
    frames = _frames(file, content)
    stamps = _times(file, frames)
    order = range(len(frames)) if stamps is None else np.argsort(stamps).tolist()
    listing, there, lacking = Listing(folder), [], []
    for i in order:
        color, depth = (listing.find(str(frames[i].get(key, ""))) for key in ("file_path", "depth_file_path"))
        if color is None or depth is None:
            lacking.append(str(frames[i].get("file_path")))
        else:
            there.append((i, color, depth))
    if not there:
        raise DataError(f"{file}: expected images and depth beside it, got none of {len(frames)} frames")
    rows, colors, depths = (list(column) for column in zip(*there, strict=True))
    note = f"{len(lacking)} of {len(frames)} frames left out, without colour or depth: {some(lacking)}"
    t: Any = frame_times(range(len(rows)), rate_hz)
    if stamps is not None:
        t = nanoseconds(file, stamps[rows])
    used = [frames[row] for row in rows]
    poses = np.stack([_pose(file, frame) for frame in used]) @ OPENGL
    per_metre = 1000.0
    if "depth_unit_scale_factor" in content:
        per_metre = 1 / float(numbers(file, content, "depth_unit_scale_factor", above=0, most=0.1))
    return of_files(
        path,
        colors,
        depths,
        lambda size, depth_size: _camera(file, content, used, size),
        t=t,
        names=[color.stem for color in colors],
        poses=Poses(poses, lambda i: f"{file}: {used[i]['file_path']}"),
        depth_of=lambda i: _depth(depths[i], per_metre),
        notes=(note,) if lacking else (),
    )


def _frames(file: Path, content: dict[str, Any]) -> list[dict[str, Any]]:
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(f"{file}: expected a list of frames, got {str(frames)[:60]}")
    for frame in frames:
        choice(file, frame, "file_path")
    return sorted(frames, key=lambda frame: natural_order(frame["file_path"]))


def _times(file: Path, frames: list[dict[str, Any]]) -> np.ndarray | None:
    for key in ("timestamp", "time"):
        if all(key in frame for frame in frames):
            t = np.array([float(numbers(file, frame, key)) for frame in frames])
            if len(set(t.tolist())) == len(t):
                return t
    return None


def _pose(file: Path, frame: dict[str, Any]) -> np.ndarray:
    matrix = frame.get("transform_matrix")
    rows = 3 if isinstance(matrix, list) and len(matrix) == 3 else 4
    T = np.eye(4)
    T[:rows] = numbers(file, frame, "transform_matrix", (rows, 4))
    return T


def _camera(
    file: Path, content: dict[str, Any], frames: list[dict[str, Any]], size: tuple[int, int]
) -> tuple[Camera, tuple[str, ...]]:
    if "camera_model" in content:
        choice(file, content, "camera_model", _MODELS)
    each = []
    for frame in frames:
        both = {**content, **frame}
        fx = float(numbers(file, both, "fl_x", above=0))
        fy = float(numbers(file, both, "fl_y", above=0)) if "fl_y" in both else fx
        of = lambda key, default, both=both: float(numbers(file, both, key)) if key in both else default
        stated = (of("w", size[0]), of("h", size[1]))
        if stated != size:
            got = f"{stated[0]:g}x{stated[1]:g}"
            raise DataError(f"{file}: expected the size of the images, {size[0]}x{size[1]}, got {got}")
        each.append([fx, fy, of("cx", size[0] / 2) - 0.5, of("cy", size[1] / 2) - 0.5])
    lens = tuple(float(numbers(file, content, key)) if key in content else 0.0 for key in _LENS)
    if "k4" in content and float(numbers(file, content, "k4")):
        raise DataError(f"{file}: expected a lens of {' '.join(_LENS)}, got k4 {content['k4']}")
    pinhole, focus = middle(np.array(each))
    return Camera(*pinhole, *size, lens if any(lens) else ()), focus


def _depth(file: Path, per_metre: float) -> np.ndarray:
    if file.suffix.lower() != ".npy":
        return read_depth(file, per_metre)
    depth = np.squeeze(read_npy(file, "depth")).astype(np.float32)
    if depth.ndim != 2:
        raise DataError(f"{file}: expected depth of rows and columns, got shape {depth.shape}")
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0)
    return depth / np.float32(1000) if depth.max(initial=0) > _IN_MM else depth
