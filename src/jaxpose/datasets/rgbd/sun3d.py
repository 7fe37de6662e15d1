"""SUN3D and Redwood's scans: `image/` or `rgb/` and `depth/` with files of a number and a time, N-T.jpg."""

import re
from pathlib import Path

import numpy as np

from jaxpose.datasets.images import (
    Pinhole,
    default_intrinsics,
    found,
    open_image,
    read_depth,
    read_intrinsics,
)
from jaxpose.datasets.rgbd.frames import Poses, of_files, visible
from jaxpose.datasets.rgbd.pairs import nearest_pairs, unpaired_note
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.tables import read_numbers

_COLORS = ("image", "rgb")
_NAME = re.compile(r"(\d+)-(\d+)\.(png|jpg|jpeg)", re.IGNORECASE)
_LAYOUT = "image/N-T.jpg (or rgb/) and depth/N-T.png, of frame N at T microseconds"
_INTRINSICS = "intrinsics.txt"
_NOMINAL, _SIZE = Pinhole(525.0, 525.0, 319.5, 239.5), (640, 480)
_MOST_APART_S = 0.02


def detect(path: Path) -> bool:
    """Whether a folder has the layout's images.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    folders = [path / name for name in _COLORS if (path / name).is_dir()]
    return (path / "depth").is_dir() and any(
        _NAME.fullmatch(file.name) for folder in folders for file in visible(folder)[:1]
    )


def load(path: Path | str) -> Recording:
    """Read a sequence of SUN3D, or a scan of Redwood, whose folders have the same names.

    The time in a name is in microseconds; colour and depth are paired one to one, nearest first, within 0.02
    s. Intrinsics are those of `intrinsics.txt` (3x3), else PrimeSense's nominal ones. Depth is in mm; in a
    sequence of SUN3D, which has `intrinsics.txt`, its bits are turned by 3, as its tools write it. The ground
    truth is the last file of `extrinsics/`, a 3x4 pose for each colour image.

    Args:
        path: The sequence folder.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    folder = Path(path)
    color_folder = next((folder / name for name in _COLORS if (folder / name).is_dir()), folder / _COLORS[0])
    (ns, colors), (depth_ns, depths) = (_stamped(folder, inner) for inner in (color_folder, folder / "depth"))
    t, depth_t = np.array(ns) * 1e-9, np.array(depth_ns) * 1e-9
    rows, partners = nearest_pairs(str(folder), t, depth_t, _MOST_APART_S)
    notes = [*unpaired_note("colour", "depth", [file.name for file in colors], rows, _MOST_APART_S)]
    notes += unpaired_note("depth", "colour", [file.name for file in depths], partners, _MOST_APART_S)
    chosen = [depths[i] for i in partners]
    turned = (folder / _INTRINSICS).is_file()
    return of_files(
        path,
        [colors[i] for i in rows],
        chosen,
        lambda size, depth_size: _intrinsics(folder, size),
        t=[ns[row] for row in rows],
        names=[colors[row].stem for row in rows],
        poses=_poses(folder / "extrinsics", rows, len(colors)),
        depth_of=lambda i: _turned_depth(chosen[i]) if turned else read_depth(chosen[i]),
        notes=notes,
    )


def _stamped(folder: Path, inner: Path) -> tuple[list[int], list[Path]]:
    """Timestamps [ns] and files of a folder's images, by time."""
    names = visible(inner) if inner.is_dir() else []
    by_time = {int(match[2]) * 1000: file for file in names if (match := _NAME.fullmatch(file.name))}
    if not by_time:
        at = inner if inner.is_dir() else folder
        raise DataError(f"{at}: expected {_LAYOUT}, got {found(at)}")
    return sorted(by_time), [by_time[ns] for ns in sorted(by_time)]


def _intrinsics(folder: Path, size: tuple[int, int]) -> tuple[Pinhole, tuple[str, ...]]:
    if (folder / _INTRINSICS).is_file():
        return read_intrinsics(folder / _INTRINSICS, size), ()
    return _NOMINAL, (default_intrinsics(_NOMINAL, size, _SIZE, _INTRINSICS),)


def _turned_depth(file: Path) -> np.ndarray:
    """Depth [m] whose 16 bits of mm are turned to the left by 3."""
    counts = open_image(file, np.asarray)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise DataError(f"{file}: expected depth, one channel of 16 bits, got {counts.dtype} {counts.shape}")
    return ((counts >> 3) | (counts << 13)).astype(np.float32) / np.float32(1000)


def _poses(folder: Path, rows: list[int], count: int) -> Poses:
    files = [file for file in visible(folder) if file.suffix == ".txt"] if folder.is_dir() else []
    if not files:
        return Poses(None, str, missing="no extrinsics/")
    _, table = read_numbers(files[-1], "4 numbers (a row of a 3x4 pose)", (4,), finite=False)
    if len(table) != 3 * count:
        raise DataError(f"{files[-1]}: expected 3 lines for each of {count} colour images, got {len(table)}")
    poses = np.tile(np.array([0.0, 0, 0, 1]), (count, 4, 1))
    poses[:, :3] = table.reshape(-1, 3, 4)
    return Poses(poses[rows], lambda i: f"{files[-1]}: pose {rows[i]}")
