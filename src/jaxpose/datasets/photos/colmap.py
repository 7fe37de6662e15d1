"""Photographs with a sparse model of COLMAP, in its folders, nerfstudio's or Gaussian splatting's."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import natural_order, some
from jaxpose.datasets.lens import Lens, from_colmap, resized
from jaxpose.datasets.photos.common import Depths, frame_numbers, guessed_depths, held_out_rows
from jaxpose.datasets.photos.names import finder
from jaxpose.datasets.photos.pixels import Mask, read_views, stored_size
from jaxpose.datasets.types import Photographs, take
from jaxpose.errors import DataError
from jaxpose.files.colmap import ColmapModel, is_colmap, read_colmap

_MODELS = (
    "[0-9]*",
    "sparse",
    "sparse/*",
    "colmap/sparse",
    "colmap/sparse/*",
    "dense/sparse",
    "dense/sparse/*",
)
_LEVELS = 3  # above the model, where its images are looked for
_SHARE = (0.005, 0.995)  # of the matched points, within whose depths the scene is
_ROOM = 0.8, 4.0  # of their nearest and farthest depth, where samples begin and end


def detect(path: Path) -> bool:
    """Whether a folder has a sparse model of COLMAP.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return bool(_models(path))


def find_model(path: Path | str) -> Path:
    """The folder of the sparse model.

    Args:
        path: The model itself, or a folder with one in `sparse/0`, `sparse`, `colmap/sparse/0` or the like.

    Returns:
        The model; of several the one of most images, by the size of the file that lists them.

    Raises:
        DataError: Where there is none.
    """
    models = _models(Path(path))
    if not models:
        raise DataError(f"{path}: expected a model of COLMAP, cameras and images (.bin or .txt), got none")
    return max(models, key=lambda model: max(file.stat().st_size for file in model.glob("images.*")))


def load(path: Path | str, *, width: int | None = None) -> tuple[Photographs, Photographs]:
    """Read photographs with the poses, cameras and points of a sparse model: for training, and held out.

    Held out is every 8th image, as by the readers of Gaussian splatting. Image files are looked for in
    `images` (or the smallest of `images_2`, `images_4`, ... that is at least `width` wide) beside the model
    or above it; those that are not there are skipped and counted in a note. Masks are COLMAP's, `masks/` with
    the image's name and `.png` behind it, 0 where pixels do not count. Cameras that differ or that `Camera`
    does not have: `pixels.read_views`. Depths are those of the points that each image saw.

    Args:
        path: The model or a folder that holds one (`find_model`).
        width: Images are resized by area to it [px]; by default they are not.

    Returns:
        Photographs to train on, and those held out.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a width below 1.
    """
    folder = find_model(path)
    model = read_colmap(folder)
    order = sorted(range(len(model.names)), key=lambda row: natural_order(model.names[row]))
    images, found = _images(folder, [model.names[row] for row in order], width)
    rows = [row for row, image in zip(order, found, strict=True) if image is not None]
    files = [image for image in found if image is not None]
    if len(rows) < 3:
        raise DataError(f"{images}: expected at least 3 images of {folder}, got {len(rows)}")
    names = [model.names[row] for row in rows]
    lenses, scaled = _lenses(folder, model, rows, files)
    masks = [_mask(images, name) for name in names]
    pixels = read_views(files, lenses, masks, stated=f"as {folder} states", width=width)
    T_world_cam = model.T_world_cam[rows]
    t, timing = frame_numbers(names)
    depths = _depths(model, rows)
    near, far, spacing, guess = depths or guessed_depths(T_world_cam, pixels.transparent)
    train, held_out, split = held_out_rows(len(rows))
    several = len(_models(Path(path)))
    notes = [f"{several} models: {folder} has the most images"] if several > 1 else []
    if len(rows) < len(order):
        lacking = [model.names[row] for row, image in zip(order, found, strict=True) if image is None]
        notes.append(f"{len(lacking)} images of the model are not in {images}, skipped: {some(lacking)}")
    photographs = Photographs(
        name=images.resolve().parent.name,
        camera=pixels.camera,
        t=t,
        rgb=pixels.rgb,
        T_world_cam=T_world_cam,
        near=near,
        far=far,
        spacing=spacing,
        files=tuple(file.relative_to(images.parent).as_posix() for file in files),
        notes=(*notes, timing, *scaled, *pixels.notes, *guess, split),
        mask=pixels.mask,
        lenses=tuple(lenses),
    )
    return take(photographs, train), take(photographs, held_out)


def images_folder(path: Path | str) -> Path:
    """The folder that the names of `load`'s images are relative to.

    Args:
        path: As `load` takes it.

    Returns:
        The folder that holds the folder of images.
    """
    folder = find_model(path)
    return _images(folder, list(read_colmap(folder).names), None)[0].parent


def _models(path: Path) -> list[Path]:
    if not path.is_dir():
        return []
    places = [path, *(model for place in _MODELS for model in sorted(path.glob(place)))]
    return [model for model in places if is_colmap(model)]


def _images(folder: Path, names: Sequence[str], width: int | None) -> tuple[Path, list[Path | None]]:
    """The folder of images that has the most of those named, and their files."""
    places = [folder.resolve(), *folder.resolve().parents][: _LEVELS + 1]
    candidates = [place / "images" for place in places] + [
        folder for place in places for folder in sorted(place.glob("images_*"))
    ]
    best: list[tuple[int, int, Path, list[Path | None]]] = []
    for candidate in (*candidates, *places):
        if not candidate.is_dir() or (candidate in places and best):
            continue
        files = list(map(finder(candidate), names))
        if count := sum(file is not None for file in files):
            first = next(file for file in files if file is not None)
            best.append((count, stored_size(first)[0][0], candidate, files))
    if not best:
        raise DataError(f"{folder}: expected its {len(names)} images in images beside or above it, got none")
    most = max(count for count, *_ in best)
    whole = sorted((row for row in best if row[0] == most), key=lambda row: row[1])
    wide = [row for row in whole if width is None or row[1] >= width]
    *_, place, files = (wide[0] if width is not None else wide[-1]) if wide else whole[-1]
    return place, files


def _lenses(
    folder: Path, model: ColmapModel, rows: Sequence[int], files: Sequence[Path]
) -> tuple[list[Lens], tuple[str, ...]]:
    """The lens of each image in its file, which may be a reduced copy of what the model was made from."""
    of_camera = {number: from_colmap(camera, str(folder)) for number, camera in model.cameras.items()}
    lenses, reduced = [], 0
    for row, file in zip(rows, files, strict=True):
        seen = of_camera[model.camera_ids[row]]
        (width, height), orientation = stored_size(file)
        by = seen.width / width
        if width < seen.width and abs(height * by - seen.height) <= by and orientation == 1:
            seen, reduced = resized(seen, width, height), reduced + 1
        lenses.append(seen)
    note = f"{reduced} images are smaller than the model states: intrinsics scaled"
    return lenses, (note,) if reduced else ()


def _mask(images: Path, name: str) -> Mask | None:
    """COLMAP's mask of an image: its name with `.png` behind it, or in place of its suffix."""
    folder = images.parent / "masks"
    for candidate in (folder / f"{name}.png", (folder / name).with_suffix(".png")):
        if candidate.is_file():
            return Mask(candidate)
    return None


def _depths(model: ColmapModel, rows: Sequence[int]) -> Depths | None:
    """Near and far by the points that the images saw; None where they saw none in front of them."""
    depth: list[Float[np.ndarray, " k"]] = []
    for row in rows:
        T = model.T_world_cam[row]
        along = (model.points[model.seen[row]] - T[:3, 3]) @ T[:3, 2]
        depth.append(along[along > 0])
    seen = np.concatenate(depth)
    if not len(seen):
        return None
    nearest, farthest = np.quantile(seen, _SHARE)
    near, far = _ROOM[0] * float(nearest), _ROOM[1] * float(farthest)
    note = f"near {near:.3g} and far {far:.3g} by the depths of the model's points"
    return near, far, "disparity", (note,)
