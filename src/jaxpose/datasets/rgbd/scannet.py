"""ScanNet as its reader exports it: numbered images in `color/` and `depth/`, poses in `pose/`."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import (
    SUFFIXES,
    Pinhole,
    check_depth,
    common_size,
    default_intrinsics,
    found,
    frame_times,
    name_of,
    read_color,
    read_depth,
    read_intrinsics,
    read_matrix,
    some,
    usable_poses,
    within,
)
from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera

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

    Colour is resized to the size of depth, whose intrinsics are those of `intrinsic/intrinsic_depth.txt`
    (4x4), else the ones that NICE-SLAM takes for every scene. Depth is in mm. Poses are camera-to-world; one
    that is missing or holds infinity, as the data set's own lost frames do, is a ground truth of NaN.

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
    color, depth = (_numbered(folder, frames / kind) for kind in ("color", "depth"))
    numbers = sorted(color.keys() & depth.keys())
    lacking = [str(number) for number in sorted(color.keys() ^ depth.keys())]
    if not numbers:
        raise DataError(
            f"{folder}: expected {_LAYOUT}, got color without depth or the other way: {some(lacking)}"
        )
    t = frame_times(numbers, rate_hz)
    colors, depths = [color[n] for n in numbers], [depth[n] for n in numbers]
    size, color_size = common_size(depths), common_size(colors)
    pinhole, assumed = _intrinsics((frames, folder), size)
    check_depth(folder, depths)
    read_color(colors[0])
    poses, unusable = _read_poses(frames / "pose", numbers)
    notes = [f"{len(lacking)} frames skipped, without color or depth: {some(lacking)}"] if lacking else []
    if color_size != size:
        wide, narrow = (f"{width}x{height}" for width, height in (color_size, size))
        notes.append(f"colour resized from {wide} to {narrow}, the size of depth")
    return Recording(
        name=name_of(folder),
        camera=Camera(*pinhole, *size),
        t=t,
        read=lambda i: Frame(read_color(colors[i], size), read_depth(depths[i])),
        T_world_cam=poses,
        notes=(*notes, *assumed, *unusable),
        files=within(colors, path),
    )


def _numbered(folder: Path, kind: Path) -> dict[int, Path]:
    """The images of a folder that are named by a number."""
    if not kind.is_dir():
        raise DataError(f"{folder}: expected {_LAYOUT}, got {found(folder)}")
    files = [file for file in sorted(kind.iterdir()) if file.suffix.lower() in SUFFIXES]
    numbered = {int(file.stem): file for file in files if file.stem.isdecimal()}
    if not numbered:
        raise DataError(f"{kind}: expected images N.jpg or N.png, got {found(kind)}")
    return numbered


def _intrinsics(folders: tuple[Path, ...], size: tuple[int, int]) -> tuple[Pinhole, tuple[str, ...]]:
    """Those of the depth camera's file, else as published, with a note."""
    for folder in folders:
        if (folder / _INTRINSICS).is_file():
            return read_intrinsics(folder / _INTRINSICS, size, rows=4), ()
    return _PUBLISHED, (default_intrinsics(_PUBLISHED, size, _PUBLISHED_SIZE, _INTRINSICS),)


def _read_poses(
    folder: Path, numbers: list[int]
) -> tuple[Float[np.ndarray, "n 4 4"] | None, tuple[str, ...]]:
    """Ground truth, and notes on what is missing or was repaired."""
    files = [folder / f"{number}.txt" for number in numbers]
    poses = [read_matrix(file, 4) if file.is_file() else np.full((4, 4), np.nan) for file in files]
    names = [str(number) for number in numbers]
    return usable_poses(np.stack(poses), names, lambda i: str(files[i]), "none, NaN or infinity")
