"""Polycam's raw data of a phone: `keyframes/` with `images/`, `depth/`, `confidence/` and `cameras/`."""

from pathlib import Path

import numpy as np

from jaxpose.datasets.images import Pinhole, found, frame_times, read_depth
from jaxpose.datasets.photos.common import OPENGL
from jaxpose.datasets.rgbd.frames import Poses, numbered, of_files, pair_numbered
from jaxpose.datasets.rgbd.phones import UNSURE, Y_UP, middle, sure_by_file
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.schema import numbers
from jaxpose.files.timestamps import nanoseconds
from jaxpose.files.untrusted import read_json

_LAYOUT = "keyframes/images/N.jpg, keyframes/depth/N.png and keyframes/cameras/N.json"
_ENTRIES = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_STEPS_S = (0.01, 10.0)  # between keyframes, by which the unit of their names is known


def detect(path: Path) -> bool:
    """Whether a folder has the layout's.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return (path / "keyframes" / "depth").is_dir() and (path / "keyframes" / "cameras").is_dir()


def load(path: Path | str, *, rate_hz: float = 30.0) -> Recording:
    """Read raw data that Polycam exports: its corrected images and cameras where it has both, else ARKit's.

    A camera is fx fy cx cy for its width and height and a camera-to-world pose in OpenGL's axes, its world's
    y up. Intrinsics are the median of all. Depth is in mm, 0 where the confidence is 0; colour is resized to
    it. Names are timestamps, whose unit is known by their steps; else frames are at `rate_hz`.

    Args:
        path: The folder with `keyframes/`.
        rate_hz: Frames a second, where names are no timestamps.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    root = Path(path) / "keyframes"
    corrected = (root / "corrected_images").is_dir() and (root / "corrected_cameras").is_dir()
    prefix = "corrected_" if corrected else ""
    color, depth = numbered(root / f"{prefix}images"), numbered(root / "depth")
    sheets = numbered(root / f"{prefix}cameras", (".json",))
    with_sheet = {n: file for n, file in color.items() if n in sheets}
    pairs = pair_numbered(root, _LAYOUT, with_sheet, depth, found(root))
    files = [sheets[number] for number in pairs.numbers]
    poses, intrinsics, sizes = (np.stack(column) for column in zip(*map(_camera, files), strict=True))
    confidence = root / "confidence"
    notes = [*pairs.notes, *([UNSURE] if confidence.is_dir() else [])]
    t, timed = _times(root, pairs.numbers, rate_hz)

    def camera(size: tuple[int, int], depth_size: tuple[int, int]) -> tuple[Pinhole, tuple[str, ...]]:
        for file, stated in zip(files, sizes, strict=True):
            if tuple(stated) != size:
                got = f"{stated[0]:g}x{stated[1]:g}"
                raise DataError(f"{file}: expected the size of the images, {size[0]}x{size[1]}, got {got}")
        return middle(intrinsics)

    return of_files(
        path,
        pairs.colors,
        pairs.depths,
        camera,
        t=t,
        names=[str(number) for number in pairs.numbers],
        poses=Poses(poses, lambda i: str(files[i])),
        depth_of=lambda i: sure_by_file(read_depth(pairs.depths[i]), confidence / pairs.depths[i].name),
        notes=(*notes, *timed),
        gravity_world=Y_UP,
    )


def _camera(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose in OpenCV's axes, fx fy cx cy, and width and height."""
    content = read_json(file, "a camera")
    get = lambda *keys, **bounds: np.array([float(numbers(file, content, key, **bounds)) for key in keys])
    T = np.eye(4)
    T[:3] = get(*_ENTRIES).reshape(3, 4)
    return T @ OPENGL, np.append(get("fx", "fy", above=0), get("cx", "cy")), get("width", "height")


def _times(root: Path, frames: list[int], rate_hz: float) -> tuple[np.ndarray | list[int], tuple[str, ...]]:
    """Timestamps [ns] if the names are some, else seconds, and a note on what they were taken for."""
    step = float(np.median(np.diff(frames))) if len(frames) > 1 else 0.0
    for unit, seconds in _UNITS.items():
        if _STEPS_S[0] < step * seconds < _STEPS_S[1] and step > 10:
            note = f"took the names for timestamps in {unit}"
            return nanoseconds(root, np.array(frames) * seconds), (note,)
    return frame_times(range(len(frames)), rate_hz), ("names are no timestamps: took frames in their order",)
