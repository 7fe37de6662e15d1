"""ARKitScenes: `lowres_wide/ID_T.png`, `lowres_depth/`, `lowres_wide_intrinsics/` and `lowres_wide.traj`."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxpose.datasets.ground_truth import poses_at
from jaxpose.datasets.images import SUFFIXES, Pinhole, found, only, read_depth
from jaxpose.datasets.rgbd.frames import Poses, of_files, visible
from jaxpose.datasets.rgbd.pairs import nearest_pairs, unpaired_note
from jaxpose.datasets.rgbd.phones import UNSURE, middle, sure_by_file
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.tables import read_all_numbers, read_stamped, seconds
from jaxpose.files.timestamps import nanoseconds
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry import rigid

_COLOR, _DEPTH, _SHEETS = "lowres_wide", "lowres_depth", "lowres_wide_intrinsics"
_LAYOUT = f"{_COLOR}/ID_T.png, {_DEPTH}/ID_T.png and {_SHEETS}/ID_T.pincam"
_MOST_APART_S = 0.02


def detect(path: Path) -> bool:
    """Whether a folder has the layout's, or holds one that does.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return path.is_dir() and bool(_roots(path))


def load(path: Path | str) -> Recording:
    """Read a scene of ARKitScenes (Baruch et al. 2021) at the size of its depth.

    Timestamps are in the files' names; colour and depth are paired one to one, nearest first, within 0.02 s.
    Intrinsics (width height fx fy cx cy) are the median of the sheets. Depth is in mm, 0 where
    `confidence/` says 0. `lowres_wide.traj` has world-to-camera poses in OpenCV's axes, a rotation vector and
    a translation, which are inverted and interpolated to the images; the world's z points up.

    Args:
        path: The scene's folder, or the one with the images.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    root = only(_roots(Path(path)), Path(path), _LAYOUT, "scenes")
    (ns, colors), (depth_ns, depths) = (_stamped(root / name) for name in (_COLOR, _DEPTH))
    t, depth_t = seconds(ns, ns[0]), seconds(depth_ns, ns[0])
    rows, partners = nearest_pairs(str(root), t, depth_t, _MOST_APART_S)
    chosen = [depths[i] for i in partners]
    notes = [*unpaired_note("colour", "depth", [f.name for f in colors], rows, _MOST_APART_S)]
    notes += unpaired_note("depth", "colour", [f.name for f in depths], partners, _MOST_APART_S)
    confidence = root / "confidence"
    notes += [UNSURE] if confidence.is_dir() else []
    return of_files(
        path,
        [colors[i] for i in rows],
        chosen,
        lambda size, depth_size: _intrinsics(root / _SHEETS, size),
        t=[ns[row] for row in rows],
        names=[colors[row].stem for row in rows],
        poses=_poses(root, [ns[row] for row in rows]),
        depth_of=lambda i: sure_by_file(read_depth(chosen[i]), confidence / chosen[i].name),
        notes=notes,
    )


def _roots(path: Path) -> list[Path]:
    """The folders with the images: the path, or those in it."""
    inner = [folder for folder in visible(path) if folder.name.endswith("_frames")] if path.is_dir() else []
    candidates = [path, *inner]
    return [folder for folder in candidates if (folder / _COLOR).is_dir() and (folder / _DEPTH).is_dir()]


def _stamped(folder: Path) -> tuple[list[int], list[Path]]:
    """Timestamps [ns] and images of a folder, by time."""
    by_time = {}
    for file in visible(folder):
        name, _, stamp = file.stem.rpartition("_")
        if name and file.suffix.lower() in SUFFIXES:
            try:
                by_time[nanoseconds(file, np.array([float(stamp)]))[0]] = file
            except ValueError:
                raise DataError(
                    f"{file}: expected a name ID_T with a timestamp in seconds, got {stamp}"
                ) from None
    if not by_time:
        raise DataError(f"{folder}: expected images ID_T.png, got {found(folder)}")
    return sorted(by_time), [by_time[ns] for ns in sorted(by_time)]


def _intrinsics(folder: Path, size: tuple[int, int]) -> tuple[Pinhole, tuple[str, ...]]:
    files = [file for file in visible(folder) if file.suffix == ".pincam"] if folder.is_dir() else []
    if not files:
        raise DataError(f"{folder}: expected files ID_T.pincam, got {found(folder)}")
    sheets = np.stack([read_all_numbers(file, (6,), "width height fx fy cx cy") for file in files])
    other = np.flatnonzero((sheets[:, :2] != size).any(axis=1) | (sheets[:, 2:4] <= 0).any(axis=1))
    if len(other):
        got = " ".join(f"{x:g}" for x in sheets[other[0]])
        raise DataError(
            f"{files[other[0]]}: expected {size[0]} {size[1]} and a camera's fx fy cx cy, got {got}"
        )
    return middle(sheets[:, 2:])


def _poses(root: Path, ns: list[int]) -> Poses:
    file = next((f for f in (root / f"{_COLOR}.traj", root.parent / f"{_COLOR}.traj") if f.is_file()), None)
    if file is None:
        return Poses(None, str, missing=f"no {_COLOR}.traj")
    rows = read_stamped(file, "7 numbers (t, rotation vector, translation)", 7, unit="s")
    T_cam_world = rigid.make(Rotation.from_rotvec(rows.values[:, :3]).as_matrix(), rows.values[:, 3:])
    known = Trajectory(seconds(rows.ns, ns[0]), rigid.inverse(T_cam_world))
    return Poses(poses_at(known, seconds(ns, ns[0])), lambda i: str(file), f"none near it in {file.name}")
