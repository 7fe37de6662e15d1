"""The camera of a run folder, `camera.json`: intrinsics, and the name of each frame's image."""

import json
from pathlib import Path
from typing import NamedTuple

from jaxpose.errors import DataError
from jaxpose.files.atomic import write_json
from jaxpose.geometry.camera import Camera


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
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        images, folder = tuple(content.pop("images")), Path(content.pop("images_folder"))
        camera = Camera(**content | {"distortion": tuple(content["distortion"])})
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: expected the camera of a run, got {type(error).__name__}: {error}"
        ) from None
    return CameraFile(camera, images, path.parent / folder)
