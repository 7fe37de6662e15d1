"""EventNeRF's folders: `<scene>/<split>/{intrinsics,pose,events,rgb}`, a file a view, and one of events."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.events.npz import npz_stream
from jaxpose.datasets.events.sidecar import Source, check_mosaic
from jaxpose.datasets.events.stream import Unit
from jaxpose.datasets.events.validate import check_span, clean
from jaxpose.datasets.images import SUFFIXES, check_intrinsics, common_size, found, name_of
from jaxpose.datasets.photos.common import check_poses, frame_numbers
from jaxpose.datasets.photos.pixels import read_images
from jaxpose.datasets.types import EventRecording, Photographs
from jaxpose.errors import DataError
from jaxpose.events import Events, Mosaic
from jaxpose.files.tables import read_all_numbers
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

_LAYOUT = "intrinsics/*.txt, pose/*.txt and events/*.npz, or a folder train of them"
_TRAINING = ("train", "train1")
_HELD_OUT = ("test", "validation")
_SIZE = (346, 260)  # of the authors' DAVIS346C, and of their code
_NEAREST = 1e-4  # where their rays begin
_FEWEST_OF_A_TURN = 8
_CLOSED = 2.0  # median steps that the last view may be from the first


class _Views(NamedTuple):
    """The views of a split."""

    camera: Camera
    T_world_cam: Float[np.ndarray, "n 4 4"]
    images: list[Path]  # one a view, or none
    notes: tuple[str, ...]


def detect(path: Path) -> bool:
    """Whether a folder is a split with events, or a scene with one to train on.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return _training(path) is not None


def load(
    path: Path | str,
    *,
    mosaic: Mosaic = "rggb",
    size: tuple[int, int] | None = None,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
) -> EventRecording:
    """Read a scene of EventNeRF.

    View i of n is at i / (n - 1) of the last timestamp, as EventNeRF has it; time 0 is the timestamp 0. Poses
    are camera-to-world in OpenCV's axes; intrinsics are the same in all views, 4x4, or 5x4 with k1 and k2 in
    the last row, and count from the outer corner of the first pixel. The sensor is as large as the images of
    `rgb/`, else `size`, else 346x260 with a note. The motion is cyclic if the last view is no farther from
    the first, in position and in angle, than twice the median step between views, of which there are eight or
    more.

    `held_out` are the images of `test`, else of `validation`, where they are: the scene is in the unit
    sphere, so it lies within 1 of the cameras' distances from the origin.

    Args:
        path: The scene folder (its split `train` or `train1`), or the folder of a split with events.
        mosaic: The colour of the pixels, which the files do not say.
        size: Width and height of the sensor where no file says.
        unit: Of the timestamps; by default found out, as a note then says.
        span: The part to read, two increasing times [s]; by default all.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file, and line or event, for anything that cannot be used (`validate.clean`).
        ValueError: For another mosaic, and for a span that does not rise.
    """
    check_mosaic(mosaic)
    split = _split(Path(path))
    views = _read_views(split, size)
    camera = views.camera
    stream = npz_stream(_event_file(split))
    events, stats, notes_on_events = clean(stream, (camera.width, camera.height), unit=unit, zero=0)
    if stats.latest <= 0:
        raise DataError(f"{stream.file}: expected timestamps from 0 on, got {stats.latest:g} s as the last")
    count = len(views.T_world_cam)
    if count < 2:
        raise DataError(f"{split / 'pose'}: expected at least 2 views, got {count}")
    held_out, lacking = _held_out(split)
    cyclic = _closes(views.T_world_cam)
    closed = "the last view is next to the first: taken as cyclic"
    turn = closed if cyclic else "the views do not close: not cyclic"
    return EventRecording(
        name=name_of(split),
        camera=camera,
        mosaic=mosaic,
        events=events if span is None else _within(stream.file, events, span),
        t=np.arange(count) / (count - 1) * stats.latest,
        T_world_cam=views.T_world_cam,
        cyclic=cyclic,
        held_out=held_out,
        notes=(*views.notes, *notes_on_events, f"views taken as evenly spaced in time; {turn}", *lacking),
    )


def find(path: Path | str, *, size: tuple[int, int] | None = None) -> Source:
    """The file of events and the camera that `load` reads, before it does.

    Args:
        path: As `load` takes it.
        size: Width and height of the sensor where no file says.

    Returns:
        Where the events are, and the camera that saw them.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    split = _split(Path(path))
    views = _read_views(split, size)
    return Source(npz_stream(_event_file(split)), views.camera, views.notes)


def _split(path: Path) -> Path:
    """The folder of the views that have events."""
    split = _training(path)
    if split is None:
        raise DataError(f"{path}: expected {_LAYOUT}, got {found(path)}")
    return split


def _training(path: Path) -> Path | None:
    """The split that has events."""
    for split in (path, *(path / name for name in _TRAINING)):
        if (split / "pose").is_dir() and (split / "events").is_dir():
            return split
    return None


def _event_file(split: Path) -> Path:
    files = sorted((split / "events").glob("*.npz"))
    if len(files) != 1:
        raise DataError(f"{split / 'events'}: expected exactly one npz file, got {found(split / 'events')}")
    return files[0]


def _read_views(split: Path, size: tuple[int, int] | None) -> _Views:
    """Camera, poses and image files of a split."""
    poses, intrinsics = _files(split / "pose", (".txt",)), _files(split / "intrinsics", (".txt",))
    images = _files(split / "rgb", SUFFIXES)
    for kind, files in (("pose", poses), ("intrinsics", intrinsics)):
        if not files:
            raise DataError(f"{split / kind}: expected a txt file for each view, got {found(split / kind)}")
    for kind, files in (("intrinsics", intrinsics), ("rgb", images)):
        if files and len(files) != len(poses):
            raise DataError(
                f"{split / kind}: expected {len(poses)} files, as many as poses, got {len(files)}"
            )
    notes = ()
    if images:
        stated = common_size(images)
        if size and size != stated:
            raise DataError(
                f"{split / 'rgb'}: expected images of {size[0]}x{size[1]}, got {stated[0]}x{stated[1]}"
            )
        size = stated
    elif size is None:
        size, notes = _SIZE, (f"no images in rgb: size of the sensor taken as {_SIZE[0]}x{_SIZE[1]}",)
    T = np.stack([_numbers(file, (16,)).reshape(4, 4) for file in poses])
    return _Views(_camera(intrinsics, size), check_poses(T, lambda i: str(poses[i])), images, notes)


def _files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Files of a folder by their suffix, in the order of their names, as EventNeRF pairs them."""
    return sorted(file for file in folder.glob("*") if file.suffix.lower() in suffixes)


def _numbers(file: Path, counts: tuple[int, ...]) -> Float[np.ndarray, " n"]:
    return read_all_numbers(file, counts, f"{' or '.join(map(str, counts))} finite numbers")


def _camera(files: Sequence[Path], size: tuple[int, int]) -> Camera:
    """The one camera that all intrinsics are of."""
    first = _numbers(files[0], (16, 20))
    for file in files[1:]:
        other = _numbers(file, (16, 20))
        if other.shape != first.shape or not np.allclose(other, first, rtol=1e-6, atol=1e-6):
            raise DataError(f"{file}: expected the intrinsics of {files[0].name}, got others")
    pinhole = check_intrinsics(files[0], first[:16].reshape(4, 4), size)
    lens = (float(first[16]), float(first[17]), 0.0, 0.0) if len(first) == 20 else ()
    # To the first order what their rays do, which divide by 1 + k1 r^2 + k2 r^4 of the distorted r.
    return Camera(
        *pinhole._replace(cx=pinhole.cx - 0.5, cy=pinhole.cy - 0.5), *size, lens if any(lens) else ()
    )


def _closes(T_world_cam: Float[np.ndarray, "n 4 4"]) -> bool:
    """Whether the last pose is next to the first."""
    if len(T_world_cam) < _FEWEST_OF_A_TURN:
        return False
    after = np.roll(T_world_cam, -1, axis=0)
    step = np.linalg.norm(after[:, :3, 3] - T_world_cam[:, :3, 3], axis=1)
    angle = rigid.rotation_angle(T_world_cam[:, :3, :3], after[:, :3, :3])
    moved = bool(np.median(step[:-1]) > 0)
    return moved and all(x[-1] <= _CLOSED * np.median(x[:-1]) + 1e-6 for x in (step, angle))


def _held_out(split: Path) -> tuple[Photographs | None, tuple[str, ...]]:
    """Views of another split to measure on, and what there is to tell of them."""
    for name in _HELD_OUT:
        other = split.parent / name
        if other.resolve() == split.resolve() or not _files(other / "rgb", SUFFIXES):
            continue
        views = _read_views(other, None)
        rgb, _, camera = read_images(views.images, views.camera, stated="the size of the first", width=None)
        t, timestamps = frame_numbers([file.name for file in views.images])
        distance = np.linalg.norm(views.T_world_cam[:, :3, 3], axis=1)
        photographs = Photographs(
            name=name_of(other),
            camera=camera,
            t=t,
            rgb=rgb,
            T_world_cam=views.T_world_cam,
            near=max(float(distance.min()) - 1, _NEAREST),
            far=float(distance.max()) + 1,
            spacing="depth",
            files=tuple(f"rgb/{file.name}" for file in views.images),
            notes=(timestamps,),
        )
        return photographs, (f"{len(t)} views held out, of {name}",)
    return None, ("no images in a split test or validation: no views are held out",)


def _within(file: Path, events: Events, span: tuple[float, float]) -> Events:
    """The events from span[0] to before span[1] [s]."""
    check_span(span)
    first, last = np.searchsorted(events.t, span)
    if first == last:
        raise DataError(f"{file}: expected events, got none from {span[0]:g} to {span[1]:g} s")
    return Events(*(column[first:last].copy() for column in events))
