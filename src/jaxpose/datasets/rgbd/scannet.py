"""ScanNet as its reader exports it: numbered images in `color/` and `depth/`, poses in `pose/`."""

from pathlib import Path

import numpy as np

from jaxpose.datasets.images import (
    Pinhole,
    default_intrinsics,
    found,
    frame_times,
    read_intrinsics,
    read_matrix,
)
from jaxpose.datasets.rgbd.frames import Poses, numbered, of_files, pair_numbered
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera, resized

_LAYOUT = "color/N.jpg, depth/N.png and pose/N.txt, here or in frames/"
_INTRINSICS = "intrinsic/intrinsic_depth.txt"
_PUBLISHED = Pinhole(577.590698, 578.729797, 318.905426, 242.683609)  # NICE-SLAM's, for every scene
_PUBLISHED_SIZE = (640, 480)


def detect(path: Path) -> bool:
    """Whether a folder has the layout's folders; a plain one has no `pose/`, `intrinsic/` or `frames/`.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    exported = any((path / name).is_dir() for name in ("pose", "intrinsic"))
    return (path / "frames" / "color").is_dir() or (exported and (path / "color").is_dir())


def load(path: Path | str, *, rate_hz: float = 30.0) -> Recording:
    """Read a scene as ScanNet's reader exports it.

    Files are found by their numbers, with any zeros before them. Colour is resized to the size of depth,
    whose intrinsics are those of `intrinsic/intrinsic_depth.txt` (4x4), else the ones that NICE-SLAM takes
    for every scene. Depth is in mm. Poses are camera-to-world; one that is missing or holds infinity, as the
    data set's own lost frames do, is a ground truth of NaN.

    Args:
        path: The scene folder.
        rate_hz: Frames a second: frame N is (N - first) / rate_hz seconds after the first.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    folder = Path(path)
    frames = folder / "frames" if (folder / "frames" / "color").is_dir() else folder
    color, depth = (numbered(frames / kind) for kind in ("color", "depth"))
    for kind, files in (("color", color), ("depth", depth)):
        if not files:
            inside = frames / kind if (frames / kind).is_dir() else folder
            raise DataError(f"{inside}: expected {_LAYOUT}, got {found(inside)}")
    pairs = pair_numbered(folder, _LAYOUT, color, depth, found(frames))
    stated = numbered(frames / "pose", (".txt",))
    where, none = [stated.get(number) for number in pairs.numbers], np.full((4, 4), np.nan)
    poses = np.stack([none if file is None else read_matrix(file, 4) for file in where])
    return of_files(
        path,
        pairs.colors,
        pairs.depths,
        lambda size, depth_size: _intrinsics((frames, folder), size, depth_size),
        t=frame_times(pairs.numbers, rate_hz),
        names=[str(number) for number in pairs.numbers],
        poses=Poses(poses, lambda i: str(where[i])),
        notes=pairs.notes,
    )


def _intrinsics(
    folders: tuple[Path, ...], size: tuple[int, int], depth_size: tuple[int, int]
) -> tuple[Camera, tuple[str, ...]]:
    """Those of the depth camera's file, else as published, with a note; as of images of colour's size."""
    pinhole, assumed = _PUBLISHED, (default_intrinsics(_PUBLISHED, depth_size, _PUBLISHED_SIZE, _INTRINSICS),)
    for folder in folders:
        if (folder / _INTRINSICS).is_file():
            pinhole, assumed = read_intrinsics(folder / _INTRINSICS, depth_size, rows=4), ()
            break
    return resized(Camera(*pinhole, *depth_size), *size), assumed
