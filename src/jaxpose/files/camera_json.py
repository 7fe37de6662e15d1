"""The camera of a run folder, `camera.json`: intrinsics, and the name of each frame's image."""

import reprlib
from functools import partial
from pathlib import Path
from typing import NamedTuple

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


def write_camera(path: Path | str, camera: Camera, images: tuple[str, ...], folder: Path | str) -> None:
    """Write `camera.json`.

    Args:
        path: The file, written whole or not at all.
        camera: Of the images as the run used them.
        images: A name for each frame, relative to `folder`; empty where they are on no disk.
        folder: Absolute, or relative to the file.
    """
    write_json(path, {**camera._asdict(), "images": images, "images_folder": str(folder)})


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
    images = content.get("images")
    if not isinstance(images, list) or not all(isinstance(name, str) for name in images):
        raise DataError(f"{path}: images: expected a list of file names, got {reprlib.repr(images)}")
    folder = path.parent / choice(path, content, "images_folder")
    return CameraFile(camera, tuple(name_inside(path, name) for name in images), folder)
