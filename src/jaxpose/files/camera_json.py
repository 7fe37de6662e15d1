"""The camera of a run folder, `camera.json`: intrinsics, and the name of each frame's image."""

import reprlib
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from jaxpose.errors import DataError
from jaxpose.files.atomic import write_json
from jaxpose.files.schema import choice, name_inside, numbers
from jaxpose.files.untrusted import read_json
from jaxpose.geometry.camera import Camera

MOST_PIXELS = 100_000  # along one side of an image
_MOST = 1e9  # [px] and coefficients of distortion


class CameraFile(NamedTuple):
    """The camera that a run worked with, and where the images of its frames are."""

    camera: Camera  # of the images as the run used them, which may have made them smaller
    images: tuple[str, ...]  # one a frame, relative to `folder`; empty where they are on no disk
    folder: Path
    depths: tuple[str, ...] = ()  # one a frame, 16 bits, registered to images; empty where there are none
    depth_per_metre: float = 1000.0  # their counts


def write_camera(
    path: Path | str,
    camera: Camera,
    images: tuple[str, ...],
    folder: Path | str,
    *,
    depths: tuple[str, ...] = (),
    depth_per_metre: float = 1000.0,
) -> None:
    """Write `camera.json`.

    Args:
        path: The file, written whole or not at all.
        camera: Of the images as the run used them.
        images: A name for each frame, relative to `folder`; empty where they are on no disk.
        folder: Absolute, or relative to the file.
        depths: A name of a depth image for each frame, relative to `folder` too; empty where there are none.
        depth_per_metre: Counts of depth a metre.
    """
    content = {**camera._asdict(), "images": images, "images_folder": str(folder)}
    content |= {"depths": depths, "depth_per_metre": depth_per_metre} if depths else {}
    write_json(path, content)


def read_camera(path: Path | str) -> CameraFile:
    """Read `camera.json`.

    Args:
        path: The file, of a run folder.

    Returns:
        The camera, and where the images are.

    Raises:
        DataError: Naming the file for what is not one.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(
            f"{path}: expected the camera of a run, got nothing: runs of before it was written lack it"
        )
    content = read_json(path, "the camera of a run")
    number = partial(numbers, path, content)
    lens = numbers(path, content, "distortion", (None,), least=-_MOST, most=_MOST)
    if len(lens) not in (0, 4, 5):
        raise DataError(f"{path}: distortion: expected 0, 4 or 5 numbers, got {len(lens)}")
    fx, fy = (float(number(key, above=0, most=_MOST)) for key in ("fx", "fy"))
    cx, cy = (float(number(key, least=-_MOST, most=_MOST)) for key in ("cx", "cy"))
    width, height = (int(number(key, whole=True, least=1, most=MOST_PIXELS)) for key in ("width", "height"))
    camera = Camera(fx, fy, cx, cy, width, height, tuple(lens.tolist()))
    folder = path.parent / choice(path, content, "images_folder")
    images, depths = _names(path, content, "images"), ()
    per_metre = 1000.0
    if "depths" in content:
        depths, per_metre = (
            _names(path, content, "depths"),
            float(number("depth_per_metre", above=0, most=_MOST)),
        )
        if len(depths) != len(images):
            raise DataError(f"{path}: depths: expected one an image, {len(images)}, got {len(depths)}")
    return CameraFile(camera, images, folder, depths, per_metre)


def _names(path: Path, content: dict[str, Any], key: str) -> tuple[str, ...]:
    names = content.get(key)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(f"{path}: {key}: expected a list of file names, got {reprlib.repr(names)}")
    return tuple(name_inside(path, name) for name in names)
