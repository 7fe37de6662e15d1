"""Blender's `transforms_{train,test}.json`, and the `transforms.json` of nerfstudio and instant-ngp."""

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.datasets.images import natural_order
from jaxpose.datasets.lens import Lens
from jaxpose.datasets.photos.common import (
    OPENGL,
    Depths,
    check_poses,
    focus_depths,
    frame_numbers,
    guessed_depths,
    held_out_rows,
)
from jaxpose.datasets.photos.names import finder
from jaxpose.datasets.photos.pixels import Mask, read_views, stored_size
from jaxpose.datasets.photos.transforms_keys import (
    SPLITS,
    frame_lens,
    number,
    oblong,
    parse,
    stated_depths,
    unused_keys,
)
from jaxpose.datasets.types import Photographs, take
from jaxpose.errors import DataError
from jaxpose.geometry import rigid

_BLENDER = (2.0, 6.0)  # depths of the data set's objects, as BARF samples them


class _Source(NamedTuple):
    """One file: the frames that have an image, in order of time."""

    file: Path
    near_far: tuple[float, float] | None
    states_focal: bool  # not an opening angle
    states_size: bool
    names: list[str]
    images: list[Path]
    lenses: list[Lens]
    masks: list[Mask | None]
    T_world_cam: Float[np.ndarray, "n 4 4"]
    t: Float[np.ndarray, " n"]
    stamped: bool
    split: tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]] | None  # for training and held out, if stated
    notes: tuple[str, ...]


def transforms_file(path: Path | str) -> Path:
    """The file of training poses.

    Args:
        path: The file itself, or a folder with `transforms_train.json` or `transforms.json`.

    Returns:
        The file.

    Raises:
        DataError: Where there is none.
    """
    path = Path(path)
    files = (path, path / "transforms_train.json", path / "transforms.json")
    for file in files:
        if file.is_file():
            return file
    raise DataError(
        f"{path}: expected transforms_train.json or transforms.json, got "
        f"{'neither' if path.is_dir() else 'nothing'}"
    )


def detect(path: Path) -> bool:
    """Whether a path is a json file, or a folder with one of training poses.

    Args:
        path: A folder or file.

    Returns:
        Whether `load` should read it.
    """
    names = ("transforms_train.json", "transforms.json")
    return path.suffix == ".json" if path.is_file() else any((path / name).is_file() for name in names)


def load(path: Path | str, *, width: int | None = None) -> tuple[Photographs, Photographs]:
    """Read photographs with poses: for training, and held out.

    Held out is what `transforms_test.json` (else `transforms_val.json`) lists beside
    `transforms_train.json`, or what a `transforms.json` lists in `test_filenames` (else `val_filenames`),
    else every 8th image. A frame is a file path, with or without suffix, and a camera-to-world pose in
    OpenGL axes; a frame without its image is skipped and counted in a note. A camera, of all frames or of
    each, is a focal length (`fl_x`) or an opening angle (`camera_angle_x`), optionally centre, size and
    distortion (OpenCV's, its fisheye's, nerfstudio's); where cameras differ or have no `Camera`, images
    are brought to one (`pixels.read_views`). Masks are those of `mask_path`, and instant-ngp's
    `dynamic_mask_*.png` beside the images. Timestamps are the frames' `time` or `timestamp` [s] if each
    has its own, else frame numbers. The depth range is the file's `near` and `far` if it states them, 2
    to 6 for Blender's cameras at about 4 from the object, else a guess from where the cameras look, as a
    note says.

    Args:
        path: The folder or its json file.
        width: Images are resized by area to it [px]; by default they are not.

    Returns:
        Photographs to train on, and those held out.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a width below 1.
    """
    file = transforms_file(path)
    source = _read(file)
    others = [file.with_name(f"transforms_{split}.json") for split in ("test", "val")]
    other_file = next((other for other in others if other.is_file()), None)
    if file.name == "transforms_train.json" and other_file is not None:
        _enough(file, len(source.t), least=2)
        other = _read(other_file)
        parts, note = (source, other), ()
        rows = (np.arange(len(source.t)), len(source.t) + np.arange(len(other.t)))
    else:
        _enough(file, len(source.t), least=3)
        parts = (source,)
        rows, note = _split(source)
    photographs = _photographs(parts, width)
    train, held_out = take(photographs, rows[0]), take(photographs, rows[1])
    return (
        train._replace(notes=(*source.notes, *photographs.notes, *note)),
        held_out._replace(notes=(*parts[-1].notes, *photographs.notes)),
    )


def _split(source: _Source) -> tuple[tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]], tuple[str, ...]]:
    """Rows to train on and held out."""
    if source.split is not None:
        return source.split, ()
    *rows, note = held_out_rows(len(source.t))
    return (rows[0], rows[1]), (note,)


def _enough(file: Path, count: int, least: int) -> None:
    if count < least:
        raise DataError(f"{file}: expected at least {least} images, got {count}")


def _read(file: Path) -> _Source:
    """The content of one file, checked; DataError if it has no frame with an image."""
    content = parse(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(f"{file}: expected a list of frames, got {str(frames)[:60]}")
    if not all(isinstance(frame.get("file_path"), str) for frame in frames):
        raise DataError(f"{file}: expected a file_path in every frame, got one without")
    frames.sort(key=lambda frame: natural_order(frame["file_path"]))
    find = finder(file.parent)
    found = [(frame, image) for frame in frames if (image := find(frame["file_path"]))]
    if not found:
        raise DataError(f"{file}: expected images beside it, got none of the {len(frames)} it lists")
    missing = len(frames) - len(found)
    first: dict[Path, dict[str, Any]] = {}
    for frame, image in found:
        first.setdefault(image, frame)
    repeated, found = len(found) - len(first), [(frame, image) for image, frame in first.items()]
    frames = [frame for frame, _ in found]
    t, stamped, note = _times(file, frames)
    order = np.argsort(t)
    frames, images = [frames[i] for i in order], [found[i][1] for i in order]
    skipped = (f"{file.name}: {missing} frames without an image skipped",) if missing else ()
    if repeated:
        skipped += (f"{file.name}: {repeated} frames left out, of an image that is listed before",)
    common = {key: value for key, value in content.items() if key != "frames"}
    entries = [{**common, **frame} for frame in frames]
    lenses = _lenses(file, entries, images)
    split, left = _stated_split(file, content, find, images)
    return _Source(
        file=file,
        near_far=stated_depths(file, content),
        states_focal="fl_x" in entries[0],
        states_size="w" in entries[0] or "h" in entries[0],
        names=[frame["file_path"] for frame in frames],
        images=images,
        lenses=lenses,
        masks=[_mask(file, find, frame, image) for frame, image in zip(frames, images, strict=True)],
        T_world_cam=_poses(file, frames),
        t=t[order],
        stamped=stamped,
        split=split,
        notes=(*skipped, *note, *left, *unused_keys(file, content, frames), *oblong(file, lenses[0])),
    )


def _lenses(file: Path, entries: Sequence[dict[str, Any]], images: Sequence[Path]) -> list[Lens]:
    """The lens of each image. A size that is not stated is that of the first image."""
    size = stored_size(images[0])[0]
    return [frame_lens(file, entry, size) for entry in entries]


def _mask(file: Path, find: Callable[[str], Path | None], frame: dict[str, Any], image: Path) -> Mask | None:
    """nerfstudio's mask, bright where pixels count, or instant-ngp's, bright where they do not."""
    if frame.get("mask_path") is not None:
        found = find(str(frame["mask_path"]))
        if found is None:
            raise DataError(f"{file}: expected the mask of {frame['file_path']}, got no {frame['mask_path']}")
        return Mask(found)
    beside = image.with_name(f"dynamic_mask_{image.stem}.png")
    return Mask(beside, hides=True) if beside.is_file() else None


def _stated_split(
    file: Path, content: dict[str, Any], find: Callable[[str], Path | None], images: Sequence[Path]
) -> tuple[tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]] | None, tuple[str, ...]]:
    """Rows to train on and held out where a file lists them, and notes on what that leaves out."""
    plain = lambda name: os.path.normpath(find(str(name)) or str(name))
    listed = {key: set(map(plain, content[key])) for key in SPLITS if isinstance(content.get(key), list)}
    if not listed:
        return None, ()
    train, val, test = (listed.get(key, set()) for key in SPLITS)
    held = test or val
    rows = {os.path.normpath(image): row for row, image in enumerate(images)}
    held_rows = sorted(rows[name] for name in held if name in rows)
    chosen = train if train else rows.keys() - held - val
    train_rows = sorted(rows[name] for name in chosen if name in rows and name not in held)
    if not train_rows or not held_rows:
        raise DataError(
            f"{file}: expected {SPLITS[0]} and {SPLITS[2]} (or {SPLITS[1]}) to name frames with images, got "
            f"{len(train_rows)} and {len(held_rows)} of them"
        )
    notes = [f"held out: the {len(held_rows)} images of {SPLITS[2] if test else SPLITS[1]}"]
    if left := len(images) - len(train_rows) - len(held_rows):
        notes.append(f"{left} images left out, which are in neither of the lists used")
    if unknown := len((held | chosen) - rows.keys()):
        notes.append(f"{unknown} names of the lists are those of no frame with an image")
    return (np.array(train_rows), np.array(held_rows)), tuple(notes)


def _times(file: Path, frames: list[dict[str, Any]]) -> tuple[Float[np.ndarray, " n"], bool, tuple[str, ...]]:
    """Time of each frame, whether these are timestamps, and what to tell about them."""
    for key in ("time", "timestamp"):
        if any(key in frame for frame in frames):
            timestamps = [number(file, frame, key) if key in frame else math.nan for frame in frames]
            if len(set(timestamps)) == len(timestamps) and np.isfinite(timestamps).all():
                return np.array(timestamps), True, ()
            t, note = frame_numbers([frame["file_path"] for frame in frames])
            return t, False, (f"{file.name}: {key} is not each frame's own, so not used", note)
    t, note = frame_numbers([frame["file_path"] for frame in frames])
    return t, False, (note,)


def _poses(file: Path, frames: list[dict[str, Any]]) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world in OpenCV axes; the world's stay as they are."""
    rows = np.empty((len(frames), 3, 4))
    for index, frame in enumerate(frames):
        try:
            matrix = np.array(frame.get("transform_matrix"), np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape not in ((3, 4), (4, 4)):
            raise DataError(
                f"{file}: {frame['file_path']}: expected a transform_matrix of 4 rows of 4 numbers, "
                f"got {str(frame.get('transform_matrix'))[:60]}"
            )
        rows[index] = matrix[:3]
    T_world_cam = rigid.make(rows[..., :3], rows[..., 3])
    return check_poses(T_world_cam, lambda i: f"{file}: {frames[i]['file_path']}") @ OPENGL


def _photographs(parts: Sequence[_Source], width: int | None) -> Photographs:
    """The images of one file or of two, through one camera; the notes are those on pixels and depths."""
    first = parts[0]
    stated = f"as {first.file.name} states" if first.states_size else "the size of the first"
    pixels = read_views(
        [image for part in parts for image in part.images],
        [seen for part in parts for seen in part.lenses],
        [mask for part in parts for mask in part.masks],
        stated=stated,
        width=width,
    )
    start = float(first.t[0])
    near, far, spacing, note = _depths(first, pixels.transparent)
    return Photographs(
        name=first.file.resolve().parent.name,
        camera=pixels.camera,
        t=np.concatenate([part.t - (start if part.stamped else 0.0) for part in parts]),
        rgb=pixels.rgb,
        T_world_cam=np.concatenate([part.T_world_cam for part in parts]),
        near=near,
        far=far,
        spacing=spacing,
        files=tuple(name for part in parts for name in part.names),
        notes=(*pixels.notes, *note),
        mask=pixels.mask,
        lenses=tuple(seen for part in parts for seen in part.lenses),
    )


def _depths(source: _Source, transparent: bool) -> Depths:
    """Near, far and the spacing between them, and a note where they are a guess."""
    if source.near_far:
        return *source.near_far, "depth", ()
    depth = focus_depths(source.T_world_cam)
    if depth is not None and not source.states_focal:
        if _BLENDER[0] < depth.min() and depth.max() < _BLENDER[1]:
            return *_BLENDER, "depth", ()
    return guessed_depths(source.T_world_cam, transparent)
