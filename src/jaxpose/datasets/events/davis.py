"""DAVIS text, as the event camera data set has it.

Lines of `t x y p`, frames, calibration and ground truth.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.events.sidecar import Source, load_source, with_camera
from jaxpose.datasets.events.stream import Unit
from jaxpose.datasets.events.text import text_stream
from jaxpose.datasets.ground_truth import poses_at
from jaxpose.datasets.images import image_size, only, some
from jaxpose.datasets.photos.common import extent_depths
from jaxpose.datasets.photos.pixels import read_images
from jaxpose.datasets.rgbd.tum import read_list
from jaxpose.datasets.types import EventRecording, Photographs
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.files.trajectories import Trajectory


def detect(path: Path) -> bool:
    """Whether a folder has a file of events in text.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return any(path.glob("events*.txt"))


def load(
    path: Path | str,
    *,
    mosaic: Mosaic = "mono",
    size: tuple[int, int] | None = None,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
) -> EventRecording:
    """Read events in DAVIS text, as the event camera data set has them.

    Time 0 is the first event's timestamp. `calib.txt` is fx fy cx cy k1 k2 p1 p2 k3; the sensor is as large
    as the images, else `size`, else as `sidecar.with_camera` says. `groundtruth.txt` has T_world_cam as `t tx
    ty tz qx qy qz qw`, given as it is, before and after the events too.

    `frames` are the images of `images.txt` (lines of timestamp and file name) during the events, with the one
    before and the one after; their poses are interpolated, and those without ground truth around them are
    left out. Their near and far are a guess from how far the camera moves.

    Args:
        path: The file of events, or a folder with `events.txt`, else a single `events*.txt`.
        mosaic: The colour of the pixels.
        size: Width and height of the sensor where no file says.
        unit: Of the timestamps; by default found out, as a note then says.
        span: The part to read, two increasing times [s]; by default all.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file, and line or event, for anything that cannot be used (`validate.clean`).
        ValueError: For another mosaic, and for a span that does not rise.
    """
    source = find(path, size=size)
    folder = source.stream.file.parent
    recording, zero_s = load_source(source, folder / "groundtruth.txt", mosaic=mosaic, unit=unit, span=span)
    if not (folder / "images.txt").is_file():
        return recording
    images = read_list(folder / "images.txt")
    frames, notes = _frames(folder, images.t - zero_s, images.files, recording)
    return recording._replace(frames=frames, notes=(*recording.notes, *images.notes, *notes))


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
    path = Path(path)
    file = path if path.is_file() else _only_file(path)
    stream = text_stream(file, "s")
    listing = file.parent / "images.txt"
    if not listing.is_file():
        return with_camera(stream, size)
    stated = image_size(read_list(listing).files[0])
    if size and size != stated:
        raise DataError(f"{listing}: expected images of {size[0]}x{size[1]}, got {stated[0]}x{stated[1]}")
    return with_camera(stream, stated)


def _only_file(folder: Path) -> Path:
    files = sorted(folder.glob("events*.txt")) if folder.is_dir() else []
    if folder / "events.txt" in files:
        return folder / "events.txt"
    return only(files, folder, "events.txt, or one events*.txt")


def _frames(
    folder: Path, t: Float[np.ndarray, " n"], images: list[Path], recording: EventRecording
) -> tuple[Photographs | None, tuple[str, ...]]:
    """The images next to and during the events that have a pose, and notes on the others."""
    events = recording.events.t
    first = max(int(np.searchsorted(t, events[0], "right")) - 1, 0)
    near = np.arange(first, min(int(np.searchsorted(t, events[-1])) + 1, len(t)))
    poses = poses_at(Trajectory(recording.t, recording.T_world_cam), t[near])
    posed = np.isfinite(poses).all((1, 2))
    notes = []
    if len(near) < len(t):
        notes.append(
            f"{len(t) - len(near)} of {len(t)} frames left out, not next to or within the events' time"
        )
    if not posed.all():
        names = [images[i].name for i in near[~posed]]
        notes.append(f"{len(names)} frames left out, no true pose around their timestamp: {some(names)}")
    rows = near[posed]
    if not len(rows):
        return None, tuple(notes)
    depths = extent_depths(recording.T_world_cam)
    notes.append(
        f"near {depths[0]:.3g} and far {depths[1]:.3g} of the frames are guessed from the cameras' extent"
    )
    files = [images[i] for i in rows]
    rgb, _, camera = read_images(files, recording.camera, stated="the size of the first", width=None)
    frames = Photographs(
        name=recording.name,
        camera=camera,
        t=t[rows],
        rgb=rgb,
        T_world_cam=poses[posed],
        near=depths[0],
        far=depths[1],
        spacing="disparity",
        files=tuple(str(file.relative_to(folder)) for file in files),
    )
    return frames, tuple(notes)
