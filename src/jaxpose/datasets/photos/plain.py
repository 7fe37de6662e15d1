"""A plain folder of photographs without poses."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from jaxpose.datasets.images import open_image, some
from jaxpose.datasets.lens import Lens, lens
from jaxpose.datasets.photos.common import frame_numbers
from jaxpose.datasets.photos.names import images_in
from jaxpose.datasets.photos.pixels import Mask, read_views, stored_size
from jaxpose.datasets.types import Photographs, take
from jaxpose.errors import DataError

_FILM = 43.2666  # [mm] diagonal of 36 mm x 24 mm, to which EXIF's equivalent focal length refers
_FARTHEST = 1e8  # [scene units] as LLFF's scenes have it
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # of EXIF's FocalPlaneResolutionUnit
_NOT_READ = (".heic", ".heif", ".dng", ".cr2", ".nef", ".arw", ".exr")


def detect(path: Path) -> bool:
    """Whether a folder has photographs, itself or in `images`, and nothing that states their poses.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return path.is_dir() and bool(_files(path))


def load(
    path: Path | str, *, width: int | None = None, focal_px: float | None = None
) -> tuple[Photographs, Photographs]:
    """Read photographs of which no pose is known; none is held out, as none could be placed.

    Images are upright by their EXIF orientation. The focal length is `focal_px`, else that of EXIF, by its
    equivalent for film (along the diagonal) or by the resolution of its sensor; the principal point is the
    middle. The unit of length is the nearest depth: near 1, and far infinite in disparity. Masks are those of
    `masks/`, as `colmap.load` finds them.

    Args:
        path: The folder of images, or one with a folder `images`.
        width: Images are resized by area to it [px]; by default they are not.
        focal_px: Focal length of the images as they are on disk [px].

    Returns:
        The photographs, their poses NaN; and none of them.

    Raises:
        DataError: Naming the file for anything that cannot be used, and where no focal length is known.
        ValueError: For a width below 1.
    """
    folder = Path(path)
    files = _files(folder)
    if not files:
        raise DataError(f"{folder}: expected photographs, got {_other(folder)}")
    lenses, notes = _lenses(files, focal_px)
    masks = [_mask(folder, file) for file in files]
    pixels = read_views(files, lenses, masks, stated="its own size", width=width)
    names = [file.relative_to(folder).as_posix() for file in files]
    t, timing = frame_numbers(names)
    photographs = Photographs(
        name=folder.resolve().name,
        camera=pixels.camera,
        t=t,
        rgb=pixels.rgb,
        T_world_cam=np.full((len(files), 4, 4), np.nan),
        near=1.0,
        far=_FARTHEST,
        spacing="disparity",
        files=tuple(names),
        notes=("no poses are known: no image is held out", timing, *notes, *pixels.notes),
        mask=pixels.mask,
        lenses=tuple(lenses),
    )
    return photographs, take(photographs, np.arange(0))


def _files(folder: Path) -> list[Path]:
    inner = folder / "images"
    masks = folder / "masks"
    found = images_in(inner if inner.is_dir() else folder)
    return [file for file in found if masks not in file.parents]


def _other(folder: Path) -> str:
    """What is there in place of photographs."""
    raw = [file.name for file in sorted(folder.glob("**/*")) if file.suffix.lower() in _NOT_READ]
    return f"files to convert to JPEG or PNG first: {some(raw)}" if raw else "none"


def _mask(folder: Path, file: Path) -> Mask | None:
    inside = folder / "images" if (folder / "images").is_dir() else folder
    name = folder / "masks" / file.relative_to(inside)
    for candidate in (name.with_name(f"{name.name}.png"), name.with_suffix(".png")):
        if candidate.is_file():
            return Mask(candidate)
    return None


def _lenses(files: Sequence[Path], focal_px: float | None) -> tuple[list[Lens], tuple[str, ...]]:
    """A pinhole for each image, and how its focal length is known."""
    lenses = []
    for file in files:
        (width, height), orientation = stored_size(file)
        if orientation in (5, 6, 7, 8):
            width, height = height, width
        focal = focal_px or open_image(file, _exif_focal)
        if focal is None:
            raise DataError(f"{file}: expected a focal length in its EXIF, got none: --focal-px says it")
        centre = (0.5 * (width - 1), 0.5 * (height - 1))
        lenses.append(lens("opencv", (focal, focal, *centre), (width, height), {}))
    if focal_px:
        return lenses, ()
    focal = sorted({seen.fx for seen in lenses})
    span = f"{focal[0]:.4g}" if len(focal) == 1 else f"{focal[0]:.4g} to {focal[-1]:.4g}"
    return lenses, (f"focal length by EXIF: {span} px",)


def _exif_focal(image: Image.Image) -> float | None:
    """The focal length [px] that EXIF states; None where it does not."""
    tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
    film = _positive(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if film:
        return film * math.hypot(*image.size) / _FILM
    length = _positive(tags.get(ExifTags.Base.FocalLength))
    per_unit = _positive(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _MM_PER_UNIT.get(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    recorded = _positive(tags.get(ExifTags.Base.ExifImageWidth)) or image.size[0]
    if length and per_unit and unit:
        return length * per_unit / unit * image.size[0] / recorded
    return None


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None
