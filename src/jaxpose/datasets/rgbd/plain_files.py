"""Files beside the images of a plain folder, of Open3D's captures and of Redwood: camera and true poses."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import INTRINSICS, check_intrinsics, read_intrinsics, sidecar
from jaxpose.errors import DataError
from jaxpose.files.association import nearest
from jaxpose.files.schema import numbers
from jaxpose.files.tables import numbered_lines, read_numbers, seconds
from jaxpose.files.timestamps import whole_ns
from jaxpose.files.trajectories import read_kitti, read_trajectory
from jaxpose.files.untrusted import read_json
from jaxpose.geometry.camera import Camera, pinhole_matrix

JSON = ("intrinsics.json", "camera_intrinsic.json", "intrinsic.json")
LOGS = ("trajectory.log", "scene/trajectory.log")
_MOST_APART_S = 0.02  # between a frame's timestamp and that of its pose
_MOST = 1e9  # of coefficients of distortion
_POSE_COLUMNS = "16 (4x4), 12 (KITTI) or 8 (TUM) numbers"


def read_camera(folder: Path, size: tuple[int, int]) -> tuple[Camera, float | None]:
    """The camera of images of a size, and counts of depth a metre where a file says them.

    DataError where no file has them.
    """
    for name in (INTRINSICS, *JSON):
        if (file := sidecar(folder, name)) is not None:
            if name == INTRINSICS:
                return Camera(*read_intrinsics(file, size), *size), None
            return _read_json(file, size)
    names = ", ".join((INTRINSICS, *JSON))
    raise DataError(f"{folder}: expected one of {names} in it or one folder up, got none")


def _read_json(file: Path, size: tuple[int, int]) -> tuple[Camera, float | None]:
    """Our own `fx fy cx cy`, with OpenCV's `distortion`, or rows of `K`, or Open3D's columns of it."""
    content = read_json(file, "intrinsics")
    number = lambda key: float(numbers(file, content, key))
    if "intrinsic_matrix" in content:
        K = numbers(file, content, "intrinsic_matrix", (9,)).reshape(3, 3).T
    elif "K" in content:
        K = np.reshape(numbers(file, {"K": np.ravel(content["K"]).tolist()}, "K", (9,)), (3, 3))
    else:
        fx, fy, cx, cy = (number(key) for key in ("fx", "fy", "cx", "cy"))
        K = pinhole_matrix(fx, fy, cx, cy)
    stated = tuple(
        number(key) if key in content else of for key, of in zip(("width", "height"), size, strict=True)
    )
    if stated != size:
        raise DataError(
            f"{file}: expected the size of the images, {size[0]}x{size[1]}, got {stated[0]:g}x{stated[1]:g}"
        )
    per_metre = float(numbers(file, content, "depth_scale", above=0)) if "depth_scale" in content else None
    if per_metre is not None and per_metre <= 1:
        raise DataError(f"{file}: depth_scale: expected counts a metre, got {per_metre:g}: metres a count?")
    lens = ()
    if "distortion" in content:
        lens = tuple(numbers(file, content, "distortion", (None,), least=-_MOST, most=_MOST).tolist())
        if len(lens) not in (0, 4, 5):
            raise DataError(f"{file}: distortion: expected k1 k2 p1 p2 [k3], got {len(lens)} numbers")
    return Camera(*check_intrinsics(file, K, size), *size, lens if any(lens) else ()), per_metre


def read_poses(file: Path, ns: list[int] | None, count: int) -> tuple[list[int] | None, Any]:
    """Times [ns] that the file states, else None; and camera-to-world poses of `count` colour images."""
    if file.suffix == ".log":
        return None, _read_log(file, count)
    columns = _columns(file)
    if columns == 8:
        trajectory = read_trajectory(file).trajectory
        if ns is None:
            check_count(file, len(trajectory.t), count)
            return whole_ns(trajectory.t, trajectory.t0_ns), trajectory.T
        t = seconds(ns, trajectory.t0_ns)
        row = nearest(t, trajectory.t)
        near = np.abs(trajectory.t[row] - t) <= _MOST_APART_S
        return None, np.where(near[:, None, None], trajectory.T[row], np.nan)
    if columns == 12:
        T = read_kitti(file).T
    else:
        T = read_numbers(file, _POSE_COLUMNS, (16,), finite=False)[1].reshape(-1, 4, 4)
    check_count(file, len(T), count)
    return None, T


def _read_log(file: Path, count: int) -> Float[np.ndarray, "n 4 4"]:
    """Open3D's and Redwood's blocks of 5 lines: three whole numbers, then the rows of a pose.

    The first number is the frame's; frames without a block are NaN.
    """
    lines = numbered_lines(file)
    poses = np.full((count, 4, 4), np.nan)
    for start in range(0, len(lines), 5):
        block = lines[start : start + 5]
        try:
            number = int(block[0][1].split()[0])
            pose = np.array([[float(x) for x in line.split()] for _, line in block[1:]]).reshape(4, 4)
        except (ValueError, IndexError):
            raise DataError(
                f"{file}:{block[0][0]}: expected a line of three numbers and four of a 4x4 pose, "
                f"got {block[0][1][:60]!r}"
            ) from None
        if not 0 <= number < count:
            raise DataError(f"{file}:{block[0][0]}: expected a frame below {count}, got {number}")
        poses[number] = pose
    return poses


def _columns(file: Path) -> int:
    """How many numbers the first line of a file of poses has."""
    for number, line in numbered_lines(file):
        if (columns := len(line.split())) not in (8, 12, 16):
            raise DataError(f"{file}:{number}: expected {_POSE_COLUMNS}, got {columns}")
        return columns
    raise DataError(f"{file}: expected lines of {_POSE_COLUMNS}, got none")


def check_count(file: Path, got: int, count: int) -> None:
    """DataError for a file that has not one line for each colour image."""
    if got != count:
        raise DataError(f"{file}: expected {count} lines, one for each colour image, got {got}")
