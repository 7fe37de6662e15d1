"""LLFF: forward-facing photographs with `poses_bounds.npy`, in the conventions of BARF."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import SUFFIXES, image_size
from jaxpose.datasets.lens import from_camera
from jaxpose.datasets.photos.common import OPENGL, check_poses, frame_numbers
from jaxpose.datasets.photos.pixels import read_images
from jaxpose.datasets.types import Photographs, take
from jaxpose.errors import DataError
from jaxpose.files.untrusted import read_npy
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

_NEAREST = 0.75  # share of the least depth bound that becomes 1
_FARTHEST = 1e8  # [scene units] where BARF's disparity of 1e-8 is


def detect(path: Path) -> bool:
    """Whether a folder has the file of poses and bounds.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return (path / "poses_bounds.npy").is_file()


def load(path: Path | str, *, width: int | None = None) -> tuple[Photographs, Photographs]:
    """Read a forward-facing scene: photographs for training, and the last tenth (at least one) held out.

    The images are those of the folder `images` or `images_N`: the smallest at least `width` wide, or the
    largest without a `width`. They pair in order of name with the rows of `poses_bounds.npy`; each row is a
    pose with axes down, right, back, the size and focal length of the original image, and the depths of the
    nearest and farthest point.

    As BARF has it (Lin et al., ICCV 2021), lengths are scaled so that the nearest depth of all is 4/3, the
    world is turned and moved into the mean camera (orthonormal here, BARF's only nearly) with axes right,
    down, forward, and depths run from 1 to infinity in disparity. There are no timestamps, as a note says.

    Args:
        path: The scene folder.
        width: Images are resized by area to it [px]; by default they are not.

    Returns:
        Photographs to train on, and those held out.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a width below 1.
    """
    file = Path(path) / "poses_bounds.npy"
    rows = _read_rows(file)
    images = _images(file, len(rows), width)
    full = _camera(file, rows, images[0])
    T_world_cam, bounds = _poses(file, rows)
    rgb, _, camera = read_images(images, full, stated="the size of the first", width=width)
    t, note = frame_numbers([image.name for image in images])
    photographs = Photographs(
        name=file.parent.resolve().name,
        camera=camera,
        t=t,
        rgb=rgb,
        T_world_cam=T_world_cam,
        near=1.0,
        far=_FARTHEST,
        spacing="disparity",
        files=tuple(f"{image.parent.name}/{image.name}" for image in images),
        notes=(
            note,
            f"depths that the file states, in the scaled scene: {bounds[0]:.3g} to {bounds[1]:.3g}",
        ),
        lenses=(from_camera(full),) * len(rows),
    )
    first_held = len(rows) - max(1, len(rows) // 10)
    return take(photographs, np.arange(first_held)), take(photographs, np.arange(first_held, len(rows)))


def _read_rows(file: Path) -> Float[np.ndarray, "n 17"]:
    """The table of poses and bounds, checked for what does not need the images."""
    if not file.is_file():
        raise DataError(f"{file}: expected a file of poses and bounds, got nothing")
    rows = read_npy(file, "an array of numbers")
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        raise DataError(f"{file}: expected rows of 17 numbers, got {rows.dtype} of shape {rows.shape}")
    if len(rows) < 3:
        raise DataError(f"{file}: expected at least 3 views, 2 and one held out, got {len(rows)}")
    rows = rows.astype(np.float64)
    for number in np.flatnonzero(~np.isfinite(rows).all(1)):
        raise DataError(f"{file}: row {number}: expected finite numbers, got NaN or infinity")
    for number in np.flatnonzero(~((rows[:, 15] > 0) & (rows[:, 16] > rows[:, 15]))):
        raise DataError(
            f"{file}: row {number}: expected a near depth above 0 and a far one beyond it, got "
            f"{rows[number, 15]:g} and {rows[number, 16]:g}"
        )
    return rows


def _images(file: Path, count: int, width: int | None) -> list[Path]:
    """The images of the folder that fits best, one for each row of the file."""
    folders: list[tuple[int, list[Path]]] = []
    for folder in sorted(file.parent.glob("images*")):
        images = sorted(
            p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")
        )
        if images:
            folders.append((image_size(images[0])[0], images))
    if not folders:
        raise DataError(f"{file.parent}: expected images in images, images_4 or the like, got none")
    folders.sort(key=lambda sized: sized[0])
    wide = [sized for sized in folders if width is None or sized[0] >= width]
    if not wide:
        widest = folders[-1][0]
        raise DataError(f"{file.parent}: expected images at least {width} wide, got at most {widest}")
    images = wide[-1 if width is None else 0][1]
    if len(images) != count:
        raise DataError(
            f"{images[0].parent}: expected {count} images, one for each row of {file.name}, got {len(images)}"
        )
    return images


def _camera(file: Path, rows: Float[np.ndarray, "n 17"], image: Path) -> Camera:
    """The camera of the images found, from the size and focal length of the original ones."""
    stated = rows[:, :15].reshape(-1, 3, 5)[:, :, 4]
    if np.ptp(stated, axis=0).max() > 1e-6 * stated.max() or stated.min() <= 0:
        row = int(np.abs(stated - stated[0]).max(1).argmax())
        raise DataError(
            f"{file}: row {row}: expected one height, width and focal length for all views, "
            f"got {stated[row]} after {stated[0]}"
        )
    full_height, full_width, focal = (float(number) for number in stated[0])
    width, height = image_size(image)
    if abs(width * full_height / full_width - height) > 1.5:  # folders are scaled to whole pixels
        raise DataError(
            f"{image}: expected the shape of {full_width:g}x{full_height:g}, as {file.name} states, "
            f"got {width}x{height}"
        )
    return Camera(
        fx=focal * width / full_width,
        fy=focal * height / full_height,
        cx=0.5 * width - 0.5,
        cy=0.5 * height - 0.5,
        width=width,
        height=height,
    )


def _poses(
    file: Path, rows: Float[np.ndarray, "n 17"]
) -> tuple[Float[np.ndarray, "n 4 4"], tuple[float, float]]:
    """Camera-to-world in the mean camera's axes (OpenCV), and the scene's depths, both scaled."""
    columns = rows[:, :15].reshape(-1, 3, 5)
    scale = 1 / (_NEAREST * rows[:, 15].min())
    down, right, back, position = (columns[:, :, k] for k in range(4))
    T = rigid.make(np.stack([right, -down, back], axis=-1), scale * position)
    T = check_poses(T, lambda i: f"{file}: row {i}")
    up, back = (axis / np.linalg.norm(axis) for axis in T[:, :3, 1:3].mean(0).T)
    turn = rigid.nearest_rotation(np.stack([np.cross(up, back), up, back], axis=-1))
    mean = rigid.make(turn, T[:, :3, 3].mean(0))
    bounds = (float(scale * rows[:, 15].min()), float(scale * rows[:, 16].max()))
    return OPENGL @ rigid.inverse(mean) @ T @ OPENGL, bounds
