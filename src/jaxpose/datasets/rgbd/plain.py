"""A plain folder: images in `color/` and `depth/`, intrinsics, and optional `poses.txt` and `times.txt`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import (
    INTRINSICS,
    SUFFIXES,
    Pinhole,
    check_depth,
    check_intrinsics,
    check_positive,
    common_size,
    found,
    frame_times,
    name_of,
    natural_order,
    read_color,
    read_depth,
    read_intrinsics,
    sidecar,
    some,
    usable_poses,
    within,
)
from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.files.schema import numbers
from jaxpose.files.tables import numbered_lines, read_numbers, read_stamped, seconds
from jaxpose.files.trajectories import nearest, read_kitti, read_tum
from jaxpose.files.untrusted import read_json
from jaxpose.geometry.camera import Camera

_JSON = "intrinsics.json"
_MOST_APART_S = 0.02  # between a frame's timestamp and that of its pose
_POSE_COLUMNS = "16 (4x4), 12 (KITTI) or 8 (TUM) numbers"


class _Stated(NamedTuple):
    pinhole: Pinhole
    depth_per_metre: float | None


def detect(path: Path) -> bool:
    """Whether a folder has one of the layout's two folders.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return (path / "color").is_dir() or (path / "depth").is_dir()


def has_timestamps(path: Path) -> bool:
    """Whether a file of the folder states when each frame was taken.

    Args:
        path: The folder.

    Returns:
        True for a `times.txt`, and for poses of TUM's lines without one.
    """
    times, poses = path / "times.txt", path / "poses.txt"
    if times.is_file() or not poses.is_file():
        return times.is_file()
    return next((len(line.split()) == 8 for _, line in numbered_lines(poses)), False)


def load(path: Path | str, *, rate_hz: float = 30.0, depth_per_metre: float | None = None) -> Recording:
    """Read a plain folder: `color/` and `depth/` with png or jpg images, in the order of their numbers.

    They are paired by equal names, or in order if no names are equal and there are as many of both.
    Intrinsics are those of `camera-intrinsics.txt` (3x3) or `intrinsics.json` (fx fy cx cy, and optional
    width height depth_scale), in the folder or one up. Depth is registered to colour, 16 bits.

    `times.txt` has a timestamp [s] for each colour image. `poses.txt` has a camera-to-world pose for each
    colour image, of 16 numbers (4x4, NaN where there is none) or KITTI's 12, or TUM's lines of 8: these go by
    their timestamps, within 0.02 s, if there is a `times.txt`, and state the times of as many images if there
    is none.

    Args:
        path: The folder.
        rate_hz: Frames a second where no file has times.
        depth_per_metre: Counts of depth a metre; by default the file's depth_scale, else 1000.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a setting that is not positive.
    """
    if depth_per_metre is not None:
        check_positive("depth_per_metre", depth_per_metre)
    folder = Path(path)
    all_colors, depths_all = _images(folder, "color"), _images(folder, "depth")
    rows, partners, paired = _pairs(folder, all_colors, depths_all)
    colors, depths = [all_colors[i] for i in rows], [depths_all[i] for i in partners]
    size = common_size([*colors, *depths])
    pinhole, stated_per_metre = _intrinsics(folder, size)
    per_metre = depth_per_metre or stated_per_metre or 1000.0
    assumed = () if depth_per_metre or stated_per_metre else ("no depth_scale: took depth as mm",)
    check_depth(folder, depths, per_metre)
    read_color(colors[0])
    ns, ground_truth = _times_and_poses(folder, len(all_colors), rate_hz)
    ns = [ns[row] for row in rows]
    if ground_truth is None:
        poses, lacking = None, ("no poses.txt: there is no ground truth to compare with",)
    else:
        names = [color.stem for color in colors]
        poses, lacking = usable_poses(
            ground_truth[rows],
            names,
            lambda i: f"{folder / 'poses.txt'}: pose {rows[i]}",
            "none, NaN or infinity",
        )
    return Recording(
        name=name_of(folder),
        camera=Camera(*pinhole, *size),
        t=seconds(ns, ns[0]),
        read=lambda i: Frame(read_color(colors[i]), read_depth(depths[i], per_metre)),
        T_world_cam=poses,
        notes=(*paired, *assumed, *lacking),
        t0_ns=ns[0],
        files=within(colors, path),
    )


def _images(folder: Path, kind: str) -> list[Path]:
    """Image files of a folder, r_2 before r_10."""
    if not (folder / kind).is_dir():
        raise DataError(f"{folder}: expected folders color/ and depth/, got {found(folder)}")
    files = [file for file in (folder / kind).iterdir() if file.suffix.lower() in SUFFIXES]
    if not files:
        raise DataError(f"{folder / kind}: expected png or jpg images, got {found(folder / kind)}")
    return sorted(files, key=lambda file: natural_order(file.name))


def _pairs(
    folder: Path, colors: Sequence[Path], depths: Sequence[Path]
) -> tuple[list[int], list[int], tuple[str, ...]]:
    """Indices of colour and depth images that belong together, and a note on how or what is left out."""
    by_stem = {depth.stem: j for j, depth in enumerate(depths)}
    rows = [i for i, color in enumerate(colors) if color.stem in by_stem]
    if rows:
        alone = sorted({file.stem for file in colors} ^ by_stem.keys(), key=natural_order)
        notes = (f"{len(alone)} images without a partner left out: {some(alone)}",) if alone else ()
        return rows, [by_stem[colors[i].stem] for i in rows], notes
    if len(colors) != len(depths):
        raise DataError(
            f"{folder}: expected colour and depth of equal names or equal number, got {len(colors)} as "
            f"{colors[0].name} and {len(depths)} as {depths[0].name}"
        )
    note = f"colour and depth paired in order: {colors[0].name} with {depths[0].name} and so on"
    return list(range(len(colors))), list(range(len(colors))), (note,)


def _intrinsics(folder: Path, size: tuple[int, int]) -> _Stated:
    """Intrinsics, and the depth scale if the file has one."""
    if (file := sidecar(folder, INTRINSICS)) is not None:
        return _Stated(read_intrinsics(file, size), None)
    if (file := sidecar(folder, _JSON)) is None:
        raise DataError(f"{folder}: expected {INTRINSICS} or {_JSON} in it or one folder up, got neither")
    values = read_json(file, "intrinsics")
    number = lambda key: float(numbers(file, values, key))
    fx, fy, cx, cy = map(number, ("fx", "fy", "cx", "cy"))
    stated = tuple(number(k) if k in values else v for k, v in zip(("width", "height"), size, strict=True))
    per_metre = number("depth_scale") if "depth_scale" in values else None
    if stated != size:
        raise DataError(
            f"{file}: expected the size of the images, {size[0]}x{size[1]}, got {stated[0]:g}x{stated[1]:g}"
        )
    if per_metre is not None and not 0 < per_metre < math.inf:
        raise DataError(f"{file}: expected a positive depth_scale, got {per_metre}")
    return _Stated(check_intrinsics(file, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), size), per_metre)


def _times_and_poses(
    folder: Path, count: int, rate_hz: float
) -> tuple[list[int], Float[np.ndarray, "n 4 4"] | None]:
    """Times [ns] of all colour images, and their poses."""
    ns = _read_times(folder / "times.txt", count)
    file = folder / "poses.txt"
    columns = _columns(file) if file.is_file() else 0
    if columns == 8:
        trajectory = read_tum(file, first_of_repeated=ns is not None)
        if ns is None:
            _check_count(file, len(trajectory.t), count)
            return _whole_ns(trajectory.t), trajectory.T
        t = np.array(ns, np.float64) / 1e9
        row = nearest(t, trajectory.t)
        near = np.abs(trajectory.t[row] - t) <= _MOST_APART_S
        return ns, np.where(near[:, None, None], trajectory.T[row], np.nan)
    if ns is None:
        ns = _whole_ns(frame_times(range(count), rate_hz))
    if columns == 0:
        return ns, None
    if columns == 12:
        T = read_kitti(file).T
    else:
        T = read_numbers(file, _POSE_COLUMNS, (16,), finite=False)[1].reshape(-1, 4, 4)
    _check_count(file, len(T), count)
    return ns, T


def _whole_ns(t: Float[np.ndarray, " n"]) -> list[int]:
    return [round(s * 1e9) for s in t.tolist()]


def _read_times(file: Path, count: int) -> list[int] | None:
    """Increasing timestamps [ns], one for each colour image; None without a file."""
    if not file.is_file():
        return None
    ns = read_stamped(file, "1 number (a timestamp in seconds)", 1, unit="s").ns
    _check_count(file, len(ns), count)
    return ns


def _columns(file: Path) -> int:
    """How many numbers the first line of a file of poses has."""
    for number, line in numbered_lines(file):
        if (columns := len(line.split())) not in (8, 12, 16):
            raise DataError(f"{file}:{number}: expected {_POSE_COLUMNS}, got {columns}")
        return columns
    raise DataError(f"{file}: expected lines of {_POSE_COLUMNS}, got none")


def _check_count(file: Path, got: int, count: int) -> None:
    if got != count:
        raise DataError(f"{file}: expected {count} lines, one for each image in color/, got {got}")
