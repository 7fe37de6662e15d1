"""`jaxpose export` with the images of a run: their names or copies, depth, points and camera."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxpose.cli.source import Source, images_on_disk
from jaxpose.datasets.images import image_size
from jaxpose.datasets.photos.transforms_json import write_transforms
from jaxpose.datasets.types import Photographs
from jaxpose.errors import DataError
from jaxpose.files.atomic import atomic
from jaxpose.files.camera_json import read_camera
from jaxpose.files.colmap import write_colmap
from jaxpose.files.ply import read_coloured_points
from jaxpose.geometry.camera import Camera, resized

_MOST_POINTS = 200_000  # not more than trainers begin with
_MODEL, _IMAGES = "sparse/0", "images"  # where readers of COLMAP's folders look
_MM = 1000.0


class _Shots(NamedTuple):
    """The images of a run, and what there is to say of them."""

    camera: Camera
    names: tuple[str, ...]
    files: list[Path]  # empty unless all are there
    depths: list[Path]  # likewise
    depth_per_metre: float
    notes: tuple[str, ...]


def export_transforms(source: Source, out: Path) -> tuple[str, ...]:
    """Write `transforms.json`, whose files are named relative to it.

    Args:
        source: A run.
        out: The file.

    Returns:
        Notes on images and camera.

    Raises:
        DataError: For what is no run, and for one whose images were brought to one camera.
    """
    shots = _shots(source, "transforms")
    here, relative = out.parent.resolve(), lambda file: os.path.relpath(file.resolve(), out.parent.resolve())
    names = tuple(map(relative, shots.files)) or shots.names
    t, T_world_cam, _ = source.trajectory
    pixels = np.empty((len(t), 0, 0, 3), np.uint8)  # only names are written; near and far are unknown
    name, cloud = source.path.name, source.path / "points.ply"
    photographs = Photographs(name, shots.camera, t, pixels, T_world_cam, np.nan, np.nan, "disparity", names)
    write_transforms(
        out,
        photographs,
        points=os.path.relpath(cloud.resolve(), here) if cloud.is_file() else None,
        depths=[relative(file) for file in shots.depths],
        depth_per_metre=shots.depth_per_metre,
    )
    notes = (*shots.notes, "axes right, up, back, as these files have them")
    if shots.depths and shots.depth_per_metre != _MM:
        notes += (f"for nerfstudio's data parser: --depth-unit-scale-factor {1 / shots.depth_per_metre:g}",)
    return notes


def export_colmap(source: Source, out: Path, *, binary: bool) -> tuple[str, ...]:
    """Write a folder as COLMAP and Gaussian splatting have it: `sparse/0` with the model, `images`.

    Args:
        source: A run.
        out: The folder; images are copied into it where they are on disk.
        binary: Whether the model is in binary files.

    Returns:
        Notes on images, camera and points.

    Raises:
        DataError: As `export_transforms`.
    """
    shots = _shots(source, "colmap")
    points, rgb, told = run_points(source.path / "points.ply")
    T_world_cam = source.trajectory.T
    write_colmap(out / _MODEL, shots.camera, shots.names, T_world_cam, points=points, rgb=rgb, binary=binary)
    notes = (*shots.notes, told)
    for file, name in zip(shots.files, shots.names, strict=bool(shots.files)):
        copy = out / _IMAGES / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        with atomic(copy) as temporary:
            shutil.copyfile(file, temporary)
    if shots.files:
        notes += (f"{len(shots.files)} images copied to {out / _IMAGES}",)
    if any(shots.camera.distortion):
        undistorter = f"colmap image_undistorter --image_path {out / _IMAGES} --input_path {out / _MODEL}"
        notes += (f"for trainers that want pinhole cameras: {undistorter} --output_path DIR",)
    return notes


def run_camera(source: Source) -> Camera | None:
    """The camera of a run.

    Args:
        source: Anything.

    Returns:
        Its camera; None where no file has one.
    """
    file = source.path / "camera.json"
    return read_camera(file).camera if source.is_run and file.is_file() else None


def run_points(
    file: Path,
) -> tuple[Float[np.ndarray, "m 3"] | None, UInt8[np.ndarray, "m 3"] | None, str]:
    """The points of a run with their colours, thinned to 200000.

    Args:
        file: Its `points.ply`, which may lack.

    Returns:
        Points and colours, None where there are none, and what there is to say.
    """
    if not file.is_file():
        return None, None, "no points"
    points, rgb = read_coloured_points(file)
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).round().astype(int))
    share = "" if len(chosen) == len(points) else f" of {len(points)}"
    return points[chosen], rgb[chosen], f"{len(chosen)}{share} points of {file.name}, without their matches"


def _shots(source: Source, form: str) -> _Shots:
    if not source.is_run:
        raise DataError(
            f"{source.path}: expected a run folder for --format {form}, got a {source.what}: it names "
            "neither camera nor images"
        )
    camera, images, folder, depths, per_metre = read_camera(source.path / "camera.json")
    count = len(source.trajectory.t)
    if images and len(images) != count:
        raise DataError(f"{source.path}: expected {len(images)} poses, one an image, got {count}")
    if not images and (source.path / "transforms.json").is_file():
        raise DataError(
            f"{source.path}: expected images of one camera for --format {form}, got a run that brought them "
            "to one: its transforms.json has the poses with the lens of each"
        )
    found, notes = images_on_disk(folder, images), ()
    if found:
        camera, notes = _as_on_disk(camera, found[0])
        names = _names(found, folder)
    elif images:
        names = tuple(Path(name).as_posix() for name in images)
        notes = (f"not all images are in {folder}: names and camera are those that the run had",)
    else:
        names = tuple(f"frame-{number:06d}.png" for number in range(count))
        notes = (
            "the images of the run are on no disk: their names are made up; `jaxpose convert` writes those "
            "of a bag or a video, to be tracked in its place",
        )
    there = [folder / name for name in depths] if found else []
    return _Shots(camera, names, found, there if all(f.is_file() for f in there) else [], per_metre, notes)


def _names(files: Sequence[Path], folder: Path) -> tuple[str, ...]:
    """Names relative to a folder, in which a folder `images` of their own goes without saying."""
    names = [file.relative_to(folder) for file in files]
    inner = all(len(name.parts) > 1 and name.parts[0] == _IMAGES for name in names)
    return tuple((name.relative_to(_IMAGES) if inner else name).as_posix() for name in names)


def _as_on_disk(camera: Camera, file: Path) -> tuple[Camera, tuple[str, ...]]:
    """The camera of the images as they are in their files, which a run may have made smaller."""
    width, height = image_size(file)
    if (width, height) == (camera.width, camera.height):
        return camera, ()
    note = f"the camera is that of the files, {width}x{height}; the run used {camera.width}x{camera.height}"
    return resized(camera, width, height), (note,)
