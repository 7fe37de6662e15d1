"""What formats of image files share: partners found by listing, and frames of files as a recording."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import (
    SUFFIXES,
    Pinhole,
    check_some_depth,
    common_size,
    depth_unit,
    image_size,
    name_of,
    read_color,
    read_depth,
    some,
    usable_poses,
    within,
)
from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.files.schema import FARTHEST_M, may_exist, name_inside
from jaxpose.files.tables import seconds
from jaxpose.geometry.camera import Camera, resized

_DRIVE = re.compile(r"[A-Za-z]:")  # that a name may begin with
_SAME_SHAPE = 0.02  # of width by height, for images of one view in two sizes


class Pairs(NamedTuple):
    """Frames that have both images."""

    numbers: list[int]  # increasing
    colors: list[Path]
    depths: list[Path]
    notes: tuple[str, ...]  # on those that lack one


class Poses(NamedTuple):
    """True poses of frames as a file states them, and the words for what is wrong with one."""

    T_world_cam: Float[np.ndarray, "n 4 4"] | None  # rows of NaN or infinity where there is none
    where: Callable[[int], str]  # the source of pose i
    lack: str = "none, NaN or infinity"  # why a pose may be missing
    missing: str = "no poses"  # what is not there where there are none at all


def visible(folder: Path) -> list[Path]:
    """The files of a folder in order, without hidden ones (macOS adds a `._x` to each x)."""
    files = (file for file in folder.iterdir() if not file.name.startswith("."))
    return sorted(files, key=lambda file: file.name)


def subfolder(folder: Path, names: Sequence[str]) -> Path | None:
    """The first of some folders that is there, in upper or lower case; None where none is."""
    inner = visible(folder) if folder.is_dir() else []
    there = {path.name.lower(): path for path in inner if path.is_dir()}
    return next((there[name] for name in names if name in there), None)


def numbered(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> dict[int, Path]:
    """The files of a folder that are named by a number, with any zeros before it; of equals the last."""
    files = visible(folder) if folder.is_dir() else []
    return {int(f.stem): f for f in files if f.stem.isdecimal() and f.suffix.lower() in suffixes}


def pair_numbered(
    folder: Path, layout: str, color: Mapping[int, Path], depth: Mapping[int, Path], found: str
) -> Pairs:
    """Pair images by their numbers.

    Args:
        folder: Where they are, for errors.
        layout: What was expected there.
        color: Colour images by number.
        depth: Depth images by number.
        found: What is there, for the error where there are no images.

    Returns:
        The frames that have both.

    Raises:
        DataError: Where none has.
    """
    numbers = sorted(color.keys() & depth.keys())
    lacking = [
        f"{n} has no {'depth' if n in color else 'color'}" for n in sorted(color.keys() ^ depth.keys())
    ]
    if not numbers:
        raise DataError(f"{folder}: expected {layout}, got {some(lacking) or found}")
    notes = (f"{len(lacking)} frames skipped: {some(lacking)}",) if lacking else ()
    return Pairs(numbers, [color[n] for n in numbers], [depth[n] for n in numbers], notes)


class Listing:
    """The files below a folder, found whatever system wrote the names of a list.

    Args:
        root: The folder that names are relative to.
    """

    def __init__(self, root: Path):
        self.root, self._names = root, dict[Path, dict[str, Path]]()
        self._exact = dict[str, set[str]]()

    def find(self, name: str) -> Path | None:
        """The file that a list names: with `\\` or `./`, in another case, or without its suffix."""
        if not may_exist(name):
            return None
        folder, _, last = name.rpartition("/")
        if last in self._files(folder):
            return self.root / name
        found = self.root
        *folders, last = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")] or [
            ""
        ]
        for part in folders:
            below = found.parent if part == ".." else self._below(found).get(part.lower())
            if below is None:
                return None
            found = below
        names = self._below(found)
        candidates = (names.get(f"{last}{suffix}".lower()) for suffix in ("", *SUFFIXES))
        return next((file for file in candidates if file is not None and file.is_file()), None)

    def _files(self, folder: str) -> set[str]:
        """The names of all files in a folder below the root."""
        if folder not in self._exact:
            try:
                with os.scandir(self.root / folder) as entries:
                    self._exact[folder] = {entry.name for entry in entries if entry.is_file()}
            except (OSError, ValueError):  # no such folder, and names that none has
                self._exact[folder] = set()
        return self._exact[folder]

    def _below(self, folder: Path) -> dict[str, Path]:
        if folder not in self._names:
            self._names[folder] = {f.name.lower(): f for f in visible(folder)} if folder.is_dir() else {}
        return self._names[folder]


def _listed_file(where: Path | str, listing: Listing, name: str) -> Path | None:
    """The file of a name in a list; of one that was absolute on another machine by the last parts of it."""
    parts = name.replace("\\", "/").split("/")
    if parts[0] and not _DRIVE.fullmatch(parts[0]):
        return listing.find(name_inside(where, name))
    tails = ("/".join(parts[k:]) for k in range(1, len(parts)))
    files = (listing.find(name_inside(where, tail)) for tail in tails)
    return next((file for file in files if file is not None), None)


def listed(
    where: Path | str, root: Path, names: Sequence[str]
) -> tuple[list[int], list[Path], tuple[str, ...]]:
    """The files of a list that are there.

    Args:
        where: The list, for errors.
        root: The folder that its names are relative to.
        names: The names.

    Returns:
        Which of them (indices), their files, and a note on the others.

    Raises:
        DataError: Where none is there, and for a name that leads out of the folder.
    """
    listing = Listing(root)
    files = {}
    for i, name in enumerate(names):
        if (file := _listed_file(where, listing, name)) is not None:
            files[i] = file
    lacking = [name for i, name in enumerate(names) if i not in files]
    if not files:
        raise DataError(
            f"{where}: expected the files that it lists, got none of {len(names)}: {some(lacking)}"
        )
    note = (
        f"{len(lacking)} of {len(names)} files that {Path(where).name} lists are not there: {some(lacking)}"
    )
    return list(files), list(files.values()), (note,) if lacking else ()


Intrinsics = Callable[[tuple[int, int], tuple[int, int]], tuple[Camera | Pinhole, tuple[str, ...]]]


class Images(NamedTuple):
    """How the images of frames are read."""

    size: tuple[int, int]  # width and height of colour as it is
    color: Callable[[int, tuple[int, int] | None], np.ndarray]  # of frame i, resized to what is given
    depth: Callable[[int], np.ndarray]  # of frame i [m]
    depth_name: Callable[[int], str]  # for errors
    unit: str = "depth"


def of_files(
    path: Path | str,
    colors: Sequence[Path],
    depths: Sequence[Path],
    intrinsics: Intrinsics,
    *,
    per_metre: float = 1000.0,
    depth_of: Callable[[int], np.ndarray] | None = None,
    **more: Any,
) -> Recording:
    """A recording of image files, checked as `assembled` says; all have the size of the first.

    Args:
        path: The folder that the user named.
        colors: A colour image for each of n frames.
        depths: A depth image for each.
        intrinsics: As for `assembled`.
        per_metre: Counts of depth a metre.
        depth_of: Reads the depth of a frame [m], where that is more than a PNG of counts.
        more: What `assembled` takes beside these.

    Returns:
        The recording.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    unit, of_depth = "depth", ()
    size = common_size(colors)
    if depth_of is None:
        of_depth = within(depths, path)
        if _same_shape(size, image_size(depths[0])):
            common_size(depths)
        depth_of, unit = (lambda i: read_depth(depths[i], per_metre)), depth_unit(per_metre)
    images = Images(
        size,
        lambda i, to: read_color(colors[i], to),
        depth_of,
        lambda i: depths[i].name,
        unit,
    )
    files = within(colors, path)
    recording = assembled(depths[0], images, intrinsics, first_color=colors[0].name, files=files, **more)
    recording = recording._replace(depth_files=of_depth, depth_per_metre=per_metre)
    return recording._replace(name=name_of(Path(path)))


def _first_depth(images: Images) -> tuple[tuple[int, int], Callable[[int], np.ndarray]]:
    """Width and height of the first image of depth, and what reads them but decodes that one no more."""
    first = images.depth(0)
    return first.shape[1::-1], lambda i: images.depth(i) if i else first


def assembled(
    where: Path | str,
    images: Images,
    intrinsics: Intrinsics,
    *,
    t: Float[np.ndarray, " n"] | Sequence[int],
    names: Sequence[str],
    poses: Poses,
    first_color: str = "colour",
    notes: Sequence[str] = (),
    **known: Any,
) -> Recording:
    """A recording, checked: shapes, the camera, some depth, the first colours, the poses.

    Colour is resized to depth, where the two have different sizes.

    Args:
        where: The first image of depth, or what holds it, for errors.
        images: How they are read.
        intrinsics: Takes the width and height of colour and of depth, gives colour's camera, and notes.
        t: Seconds from the first frame on, or timestamps [ns].
        names: Of the frames, for notes.
        poses: The ground truth.
        first_color: The first image's name, for errors.
        notes: On the frames.
        known: Other fields of the recording.

    Returns:
        The recording; its notes are `notes`, those on the camera, and those on the poses.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    size, (depth_size, depth_of) = images.size, _first_depth(images)
    sizes = [f"{width}x{height}" for width, height in (size, depth_size)]
    if not _same_shape(size, depth_size):
        raise DataError(f"{where}: expected {sizes[0]}, the size of {first_color}, got {sizes[1]}")
    camera, assumed = intrinsics(size, depth_size)
    camera = _checked(where, camera if isinstance(camera, Camera) else Camera(*camera, *size))
    to = None if size == depth_size else depth_size
    if to is not None:
        assumed = (f"colour resized from {' to '.join(sizes)}, the size of depth", *assumed)
        camera = resized(camera, *depth_size)
    folder = where.parent if isinstance(where, Path) and where.suffix.lower() in SUFFIXES else where
    check_some_depth(folder, len(names), depth_of, images.depth_name, images.unit)
    images.color(0, to)
    T_world_cam, lacking = None, (f"{poses.missing}: there is no ground truth to compare with",)
    if poses.T_world_cam is not None:
        T_world_cam, lacking = usable_poses(poses.T_world_cam, names, poses.where, poses.lack)
    if not isinstance(t, np.ndarray):
        t, known = seconds(list(t), t[0]), known | {"t0_ns": t[0]}
    return Recording(
        name=Path(where).stem,
        camera=camera,
        t=t,
        read=lambda i: Frame(images.color(i, to), images.depth(i)),
        T_world_cam=T_world_cam,
        notes=(*notes, *assumed, *lacking),
        **known,
    )


def _checked(where: Path | str, camera: Camera) -> Camera:
    if not all(abs(number) < FARTHEST_M for number in camera[:4]):
        got = " ".join(f"{number:g}" for number in camera[:4])
        raise DataError(f"{where}: expected a camera's fx fy cx cy, got {got}")
    return camera


def _same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    return abs(size[0] / size[1] / (other[0] / other[1]) - 1) <= _SAME_SHAPE
