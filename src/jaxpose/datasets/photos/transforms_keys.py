"""What the keys of a `transforms.json` say of camera and depths, and which say more than is used."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jaxpose.datasets.images import some
from jaxpose.datasets.lens import Kind, Lens, lens
from jaxpose.errors import DataError
from jaxpose.files.untrusted import read_json

_LENS = ("k1", "k2", "p1", "p2", "k3", "k4")
INTRINSICS = ("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h", *_LENS)
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE", "OPENCV_FISHEYE")
_MOST_OBLONG = 1.1  # ratio of the focal lengths that is still that of pixels
_USED = (*INTRINSICS, "camera_model", "is_fisheye", "frames", "near", "far")
_USED_OF_A_FRAME = ("file_path", "transform_matrix", "time", "timestamp", "mask_path")
SPLITS = ("train_filenames", "val_filenames", "test_filenames")
# What no pose, ray or colour depends on: bounds and scales of other programs' scenes, depth, bookkeeping.
_WITHOUT_EFFECT = (
    "aabb_scale", "render_aabb", "scale", "offset", "up", "centroid", "ply_file_path", "sparse_pc",
    "applied_transform", "applied_scale", "orientation_override", "auto_scale_poses_override",
    "enable_depth_loading", "integer_depth_scale", "depth_unit_scale_factor", "depth_file_path", "depth_path",
    "sharpness", "sharpen", "colmap_im_id", "colmap_id", "rotation", "frame_id", "version",
)  # fmt: skip


_LARGEST = 1e300  # of a number: it is squared


def parse(file: Path) -> dict[str, Any]:
    """The JSON object of a file; DataError naming the line for what is none."""
    return read_json(file, "JSON")


def number(file: Path, entries: dict[str, Any], key: str) -> float:
    """The number of a key; DataError where it is none."""
    value = entries[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
        raise DataError(f"{file}: expected a number for {key}, got {str(value)[:60]}")
    return float(value)


def frame_lens(file: Path, entries: dict[str, Any], size: tuple[int, int]) -> Lens:
    """The lens that the keys of a file and of a frame state, in files of `size` (width, height)."""
    model = entries.get("camera_model", _MODELS[0])
    if model not in _MODELS:
        raise DataError(f"{file}: expected a camera_model of {', '.join(_MODELS)}, got {str(model)[:60]}")
    given = {key: number(file, entries, key) for key in INTRINSICS if key in entries}
    width, height = int(given.get("w", size[0])), int(given.get("h", size[1]))
    if width < 1 or height < 1:
        raise DataError(f"{file}: expected w and h of at least 1 pixel, got {width} and {height}")
    fx, fy = _focal_lengths(file, given, width, height)
    kind: Kind = "opencv"
    if model == "OPENCV_FISHEYE" or entries.get("is_fisheye"):
        kind = "fisheye"
    elif given.get("k4"):
        kind = "radial4"
    # These files count from the outer corner of the first pixel.
    cx, cy = given.get("cx", 0.5 * width) - 0.5, given.get("cy", 0.5 * height) - 0.5
    return lens(kind, (fx, fy, cx, cy), (width, height), {key: given.get(key, 0.0) for key in _LENS})


def stated_depths(file: Path, content: dict[str, Any]) -> tuple[float, float] | None:
    """Near and far [scene units] where a file states them."""
    if "near" not in content or "far" not in content:
        return None
    near, far = number(file, content, "near"), number(file, content, "far")
    if not 0 < near < far:
        raise DataError(f"{file}: expected near above 0 and far beyond it, got {near:g} and {far:g}")
    return near, far


def unused_keys(file: Path, content: dict[str, Any], frames: Iterable[dict[str, Any]]) -> tuple[str, ...]:
    """A note on the keys that are not used and may change what the rest means."""
    known = {*_USED, *_USED_OF_A_FRAME, *SPLITS, *_WITHOUT_EFFECT}
    keys = {*content, *(key for frame in frames for key in frame)} - known
    return (f"{file.name}: keys not used: {some(sorted(keys), most=8)}",) if keys else ()


def oblong(file: Path, seen: Lens) -> tuple[str, ...]:
    """A note on pixels that are not square, and look like width and height changed with each other."""
    ratio, sides = seen.fx / seen.fy, seen.width / seen.height
    if max(ratio, 1 / ratio) < _MOST_OBLONG:
        return ()
    note = f"{file.name}: focal lengths of {seen.fx:.6g} and {seen.fy:.6g} px, pixels that are not square"
    if min(abs(ratio * sides - 1), abs(ratio / sides - 1)) < 0.02:
        note += ", by the ratio of width and height: one of the pairs may be swapped"
    return (note,)


def _focal_lengths(file: Path, given: dict[str, float], width: int, height: int) -> tuple[float, float]:
    if "fl_x" in given:
        fx = given["fl_x"]
    elif "camera_angle_x" in given:
        fx = _focal(width, given["camera_angle_x"])
    else:
        raise DataError(f"{file}: expected a focal length, fl_x or camera_angle_x, got neither")
    if "fl_y" in given:
        fy = given["fl_y"]
    elif "camera_angle_y" in given and "fl_x" not in given:
        fy = _focal(height, given["camera_angle_y"])
    else:
        fy = fx
    if not (0 < fx < 1e3 * width and 0 < fy < 1e3 * width):
        raise DataError(f"{file}: expected a focal length above 0 px, got {fx:g} and {fy:g}")
    return fx, fy


def _focal(size: int, angle: float) -> float:
    """The focal length [px] that sees `size` pixels within an angle [rad]; 0 for what is no such angle."""
    return 0.5 * size / math.tan(0.5 * angle) if 0 < angle < math.pi else 0.0
