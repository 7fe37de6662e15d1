"""The pixels of photographs: turned as stated, masked, resized, and brought to one camera."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import ExifTags, Image, ImageOps
from PIL.PngImagePlugin import PngImageFile

from jaxpose.datasets import lens
from jaxpose.datasets.images import image_size, open_image, some
from jaxpose.datasets.lens import WIDEST_DEG, Lens
from jaxpose.errors import DataError
from jaxpose.files.opening import read_bytes
from jaxpose.geometry import camera
from jaxpose.geometry.camera import Camera

_PNG_ORIENTATIONS = (b"eXIf", b"Raw profile type", b"XML:com.adobe.xmp")  # chunks of PNG that may hold it
_SWAPPED = (5, 6, 7, 8)  # EXIF orientations by which width and height change places
_MOST_SUBPIXELS = 4  # along each side of a pixel, where images are resampled
_COARSER = 0.7  # resolution, by which images are reduced before
_WHOLE = 0.999  # of a pixel's area that a mask must keep


class Mask(NamedTuple):
    """A file that says which pixels count."""

    file: Path
    hides: bool = False  # whether its bright pixels are those that do not count


class Pixels(NamedTuple):
    """Images of one camera.

    Attributes:
        rgb: On white where a file had alpha.
        mask: Which pixels count; None: all.
        camera: Of all of them.
        transparent: Whether anything showed through one.
        notes: What was done to them, for the user.
    """

    rgb: UInt8[np.ndarray, "n h w 3"]
    mask: Bool[np.ndarray, "n h w"] | None
    camera: Camera
    transparent: bool
    notes: tuple[str, ...]


def stored_size(file: Path) -> tuple[tuple[int, int], int]:
    """Width and height of an image as its file has it, and its EXIF orientation (1: upright)."""
    return open_image(file, lambda image: (image.size, _orientation(file, image)))


def read_images(
    files: Sequence[Path], full: Camera, *, stated: str, width: int | None
) -> tuple[UInt8[np.ndarray, "n h w 3"], bool, Camera]:
    """Images on white, resized by area to `width`, whether any was transparent, and the resized camera.

    Every image must be of the size of `full`; `stated` says in the error where that size comes from. Images
    are not enlarged: DataError for a `width` beyond theirs, ValueError for one below 1.
    """
    small = smaller_view(files[0], full, width)
    for file in files:
        size = image_size(file)
        if size != (full.width, full.height):
            raise DataError(f"{file}: expected {full.width}x{full.height}, {stated}, got {size[0]}x{size[1]}")
    rgb = np.empty((len(files), small.height, small.width, 3), np.uint8)
    transparent = False
    for number, file in enumerate(files):
        opaque, alpha = open_image(file, _on_white)
        transparent |= alpha
        rgb[number] = _by_area(opaque, (small.width, small.height))
    return rgb, transparent, small


def read_views(
    files: Sequence[Path],
    lenses: Sequence[Lens],
    masks: Sequence[Mask | None],
    *,
    stated: str,
    width: int | None,
) -> Pixels:
    """Read photographs, each through its own lens, as images of one camera.

    Where all lenses are one that `Camera` has, the camera is that. Else all images are brought to one pinhole
    camera, and what none of their pixels shows is masked. Images are turned by their EXIF orientation if only
    then they have the size of their lens: the programs that state poses mostly read pixels as stored.

    Args:
        files: One an image.
        lenses: One an image, of its full size.
        masks: One an image, or None.
        stated: Where the sizes come from, for errors.
        width: Images are resized by area to it [px]; by default they are not.

    Returns:
        Their pixels.

    Raises:
        DataError: For an image or mask of another size or that cannot be read, and for a `width` beyond.
        ValueError: For a `width` below 1.
    """
    turned = [_turned(file, seen, stated) for file, seen in zip(files, lenses, strict=True)]
    one = lens.as_camera(lenses[0]) if len(set(lenses)) == 1 else None
    full, beyond = (one, False) if one is not None else lens.pinhole_for(lenses)
    small = smaller_view(files[0], full, width)
    rgb = np.full((len(files), small.height, small.width, 3), 255, np.uint8)
    kept = np.ones(rgb.shape[:3], bool)
    transparent, maps = False, {}
    for number, (file, seen, mask) in enumerate(zip(files, lenses, masks, strict=True)):
        opaque, alpha = open_image(file, lambda image, k=number: _on_white(_upright(image, turned[k])))
        transparent |= alpha
        shown = None if mask is None else _read_mask(mask, seen)
        if one is not None:
            rgb[number] = _by_area(opaque, (small.width, small.height))
            if shown is not None:
                kept[number] = _by_area(shown, (small.width, small.height)) >= _WHOLE * 255
            continue
        if seen not in maps:
            maps[seen] = _Resampling(seen, small, full)
        rgb[number], kept[number] = maps[seen].bring(opaque, shown)
    notes = _notes(files, turned, lenses, one, small, beyond)
    every = one is not None and all(mask is None for mask in masks)
    return Pixels(rgb, None if every or kept.all() else kept, small, transparent, notes)


class _Resampling:
    """Brings images of one lens to a pinhole camera, averaging over the area of its pixels."""

    def __init__(self, seen: Lens, small: Camera, full: Camera):
        self.sub = max(1, min(math.ceil(full.width / small.width), _MOST_SUBPIXELS))
        fine = camera.resized(small, small.width * self.sub, small.height * self.sub)
        column, row = np.meshgrid(np.arange(fine.width), np.arange(fine.height))
        rays = np.stack([(column - fine.cx) / fine.fx, (row - fine.cy) / fine.fy], axis=-1)
        pixel, self.inside = lens.project(seen, rays)
        # Images are first reduced by area to about the resolution of the finer grid.
        ratio = fine.fx / seen.fx if fine.fx < _COARSER * seen.fx else 1.0
        self.size = (max(round(seen.width * ratio), 1), max(round(seen.height * ratio), 1))
        at = (pixel + 0.5) * np.divide(self.size, (seen.width, seen.height)) - 0.5
        self.at = np.where(self.inside[..., None], at, -1).astype(np.float32)
        self.shape = (small.height, self.sub, small.width, self.sub)

    def bring(
        self, image: Image.Image, shown: Image.Image | None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
        """The image as the pinhole camera sees it, white where it shows nothing, and where it does."""
        kept = self.inside
        if shown is not None:
            kept = kept & (self._sampled(shown) >= _WHOLE * 255)
        whole = np.asarray(kept.reshape(self.shape).all((1, 3)))
        colours = self._sampled(image).reshape(*self.shape, 3).mean((1, 3), dtype=np.float32)
        return np.where(whole[..., None], np.rint(colours), 255).astype(np.uint8), whole

    def _sampled(self, image: Image.Image) -> np.ndarray:
        reduced = _by_area(image, self.size)
        return cv2.remap(
            reduced, self.at[..., 0], self.at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )


def smaller_view(file: Path, full: Camera, width: int | None) -> Camera:
    """The camera of images that are resized to a width; DataError naming the file for a wider one."""
    if width is None:
        return full
    if width < 1:
        raise ValueError(f"width: expected at least 1 pixel, got {width}")
    if width > full.width:
        raise DataError(f"{file}: expected an image at least {width} wide, got {full.width}")
    return camera.scale(full, width / full.width)


def _by_area(image: Image.Image, size: tuple[int, int]) -> np.ndarray:
    """The image reduced to a width and height: means over the area of each new pixel, in shares too."""
    return cv2.resize(np.asarray(image), size, interpolation=cv2.INTER_AREA)


def _orientation(file: Path, image: Image.Image) -> int:
    # In a PNG it may stand behind the pixels, which Pillow decodes to look there.
    if isinstance(image, PngImageFile):
        content = read_bytes(file)
        if not any(name in content for name in _PNG_ORIENTATIONS):
            return 1
    return int(image.getexif().get(ExifTags.Base.Orientation, 1))


def _turned(file: Path, seen: Lens, stated: str) -> int:
    """The EXIF orientation by which the image is to be turned: 1, or what gives it the size of its lens.

    0 where there is an orientation that the size does not ask for.
    """
    size, orientation = stored_size(file)
    if size == (seen.width, seen.height):
        return 1 if orientation == 1 else 0
    if size[::-1] == (seen.width, seen.height) and orientation in _SWAPPED:
        return orientation
    raise DataError(f"{file}: expected {seen.width}x{seen.height}, {stated}, got {size[0]}x{size[1]}")


def _upright(image: Image.Image, orientation: int) -> Image.Image:
    return image if orientation < 2 else ImageOps.exif_transpose(image)


def _read_mask(mask: Mask, seen: Lens) -> Image.Image:
    """255 where pixels count, 0 where they do not."""

    def pixels(image: Image.Image) -> np.ndarray:
        return np.asarray(image.convert("L") if image.mode not in ("L", "1", "I;16", "I") else image)

    values = open_image(mask.file, pixels)
    size = values.shape[1::-1]
    # Masks count 0 and 255, 0 and 1, or, in JPEG, what is near to one of these.
    bright = values > max(int(values.max()), 1) / 2
    image = Image.fromarray(np.where(bright != mask.hides, np.uint8(255), np.uint8(0)))
    if size == (seen.width, seen.height):
        return image
    if abs(size[0] * seen.height - size[1] * seen.width) <= 1.5 * max(size):  # of the same shape
        return image.resize((seen.width, seen.height), Image.Resampling.NEAREST)
    got = f"{size[0]}x{size[1]}"
    raise DataError(
        f"{mask.file}: expected a mask of {seen.width}x{seen.height}, as the image has, got {got}"
    )


def _notes(
    files: Sequence[Path],
    turned: Sequence[int],
    lenses: Sequence[Lens],
    one: Camera | None,
    small: Camera,
    beyond: bool,
) -> tuple[str, ...]:
    notes = []
    as_stored = [file.name for file, k in zip(files, turned, strict=True) if k == 0]
    if as_stored:
        notes.append(
            f"EXIF orientation of {len(as_stored)} images not applied, as their size is that of the camera "
            f"without: {some(as_stored)}"
        )
    if count := sum(k > 1 for k in turned):
        notes.append(f"{count} images turned by their EXIF orientation, to the size of the camera")
    if one is None:
        kinds = sorted({seen.kind for seen in lenses})
        what = f"{len(set(lenses))} cameras ({', '.join(kinds)})" if len(set(lenses)) > 1 else kinds[0]
        notes.append(
            f"{what}: images brought to one pinhole camera, {math.degrees(2 * _half(small)):.3g} degrees wide"
        )
    if beyond:
        notes.append(f"what is more than {WIDEST_DEG:g} degrees off the optical axis is left out")
    return tuple(notes)


def _half(seen: Camera) -> float:
    """Half the angle that a pinhole camera sees in a row [rad]."""
    edges: Float[np.ndarray, " 2"] = np.array([-0.5 - seen.cx, seen.width - 0.5 - seen.cx]) / seen.fx
    return float(np.ptp(np.arctan(edges)) / 2)


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
