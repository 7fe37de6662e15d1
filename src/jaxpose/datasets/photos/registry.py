"""Any folder of photographs: which of the layouts it has, by its files, and its loader."""

from pathlib import Path
from types import ModuleType
from typing import Literal, NamedTuple, get_args

from jaxpose.datasets.images import found
from jaxpose.datasets.photos import blender, colmap, llff, plain, video
from jaxpose.datasets.types import Photographs
from jaxpose.errors import DataError

Format = Literal["llff", "transforms", "colmap", "plain", "video"]


class Layout(NamedTuple):
    """A layout: what it is called, what files it has, and its loader."""

    title: str
    files: str
    module: ModuleType
    tested: str  # what its test reads


# In the order in which they are tried: what states poses goes before a model that it was made from.
LAYOUTS: dict[Format, Layout] = {
    "llff": Layout("LLFF", "poses_bounds.npy", llff, "a made folder, fern"),
    "transforms": Layout(
        "Blender, nerfstudio, instant-ngp",
        "transforms_train.json or transforms.json",
        blender,
        "made folders, lego",
    ),
    "colmap": Layout("COLMAP", "a sparse model", colmap, "pycolmap"),
    "plain": Layout("photographs without poses", "images alone", plain, "made folders with EXIF by Pillow"),
    "video": Layout(
        "a video, with or without a gyroscope's csv (extra `video`)",
        "a video alone",
        video,
        "a film of a made room by PyAV, with a csv",
    ),
}


def find_format(path: Path | str) -> Format:
    """The layout of a folder by its files, or of a json file.

    Args:
        path: The folder or file.

    Returns:
        The name of the layout.

    Raises:
        DataError: Saying what was expected and what is there.
    """
    path = Path(path)
    for name in get_args(Format):
        if LAYOUTS[name].module.detect(path):
            return name
    expected = ", ".join(f"{layout.files} ({layout.title})" for layout in LAYOUTS.values())
    raise DataError(f"{path}: expected photographs, with {expected}, got {found(path)}")


def load_photographs(
    path: Path | str,
    format: Format | None = None,
    *,
    width: int | None = None,
    focal_px: float | None = None,
) -> tuple[Photographs, Photographs]:
    """Read photographs in any of the layouts.

    Args:
        path: The folder, or a json file.
        format: The layout; by default the one that `find_format` finds.
        width: Images are resized by area to it [px]; by default they are not.
        focal_px: Focal length of the images as they are on disk [px], where no file states a camera.

    Returns:
        Photographs to train on, and those held out. Poses are NaN where none are known: "plain", "video".

    Raises:
        DataError: Naming the file for anything that cannot be used, and for a focal length beside a camera.
        ValueError: For a width below 1.
    """
    format = format or find_format(path)
    if format in ("plain", "video"):
        return LAYOUTS[format].module.load(path, width=width, focal_px=focal_px)
    if focal_px is not None:
        files = LAYOUTS[format].files
        raise DataError(f"{path}: expected no focal length with {files}, which states cameras")
    return LAYOUTS[format].module.load(path, width=width)


def images_folder(path: Path | str, format: Format | None = None) -> Path:
    """The folder that the names of photographs' files are relative to.

    Args:
        path: As `load_photographs` takes it.
        format: The layout; by default the one that `find_format` finds.

    Returns:
        The folder.
    """
    format = format or find_format(path)
    if format == "transforms":
        return blender.transforms_file(path).parent
    return colmap.images_folder(path) if format == "colmap" else Path(path)
