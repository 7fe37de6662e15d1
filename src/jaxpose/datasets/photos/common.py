"""What loaders of posed photographs share: image files of one size, frame numbers, poses checked."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from jaxpose.datasets.images import image_size, open_image
from jaxpose.errors import DataError
from jaxpose.files.trajectories import orthonormal
from jaxpose.geometry import camera
from jaxpose.geometry.camera import Camera

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # right, up, back to right, down, forward, and the other way


def read_images(
    files: Sequence[Path], full: Camera, *, stated: str, width: int | None
) -> tuple[UInt8[np.ndarray, "n h w 3"], bool, Camera]:
    """Images on white, resized by area to `width`, whether any was transparent, and the resized camera.

    Every image must be of the size of `full`; `stated` says in the error where that size comes from. Images
    are not enlarged: DataError for a `width` beyond theirs, ValueError for one below 1.
    """
    if width is not None and width < 1:
        raise ValueError(f"width: expected at least 1 pixel, got {width}")
    if width is not None and width > full.width:
        raise DataError(f"{files[0]}: expected an image at least {width} wide, got {full.width}")
    for file in files:
        size = image_size(file)
        if size != (full.width, full.height):
            raise DataError(f"{file}: expected {full.width}x{full.height}, {stated}, got {size[0]}x{size[1]}")
    small = full if width is None else camera.scale(full, width / full.width)
    rgb = np.empty((len(files), small.height, small.width, 3), np.uint8)
    transparent = False
    for number, file in enumerate(files):
        opaque, alpha = open_image(file, _on_white)
        transparent |= alpha
        # The box filter is the mean over each new pixel's area.
        rgb[number] = opaque.resize((small.width, small.height), Image.Resampling.BOX)
    return rgb, transparent, small


def frame_numbers(names: Sequence[str]) -> tuple[Float[np.ndarray, " n"], str]:
    """Times of images without timestamps, which are in order already, and a note that says what they are.

    It is the last number of the file names, if they differ in nothing else and it increases, so that frames
    that were left out leave their gap; else 0, 1, 2 and so on.
    """
    parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", Path(name).stem) for name in names]
    kept = [part for part in parts if part]
    numbers = np.array([float(part[2]) for part in kept])
    same = len(kept) == len(names) and len({(part[1], part[3]) for part in kept}) == 1
    if same and (np.diff(numbers) > 0).all():
        return numbers, "no timestamps: the time of an image is the frame number in its file name"
    return np.arange(float(len(names))), "no timestamps: the time of an image is its place among the files"


def check_poses(
    T_world_cam: Float[np.ndarray, "n 4 4"], where: Callable[[int], str]
) -> Float[np.ndarray, "n 4 4"]:
    """The poses with rotations orthonormal to the last digit; `where(i)` names pose i in the DataError."""
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.all():
        raise DataError(f"{where(int(finite.argmin()))}: expected a finite pose, got NaN or infinity")
    return orthonormal(T_world_cam, where)


def extent_depths(T_world_cam: Float[np.ndarray, "n 4 4"]) -> tuple[float, float]:
    """Near and far where nothing else tells them: 0.1 and 100 times the cameras' extent (1 if they rest)."""
    centres = T_world_cam[:, :3, 3]
    extent = float(np.linalg.norm(centres - centres.mean(0), axis=1).max()) or 1.0
    return 0.1 * extent, 100 * extent


def _on_white(image: Image.Image) -> tuple[Image.Image, bool]:
    """The image in 8-bit RGB, what shows through it white, and whether anything does."""
    if image.mode.startswith(("I", "F")):  # Pillow would clip these
        raise ValueError(f"pixels of kind {image.mode}, not of 8 bits")
    if not image.has_transparency_data:
        return image.convert("RGB"), False
    image = image.convert("RGBA")
    white = Image.new("RGBA", image.size, "white")
    transparent = bool(np.asarray(image.getchannel("A")).min() < 255)
    return Image.alpha_composite(white, image).convert("RGB"), transparent
