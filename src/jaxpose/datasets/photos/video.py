"""A video of a phone or an action camera, with the readings of its gyroscope where they are beside it."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.datasets.images import name_of
from jaxpose.datasets.photos.gyroscope import align, find_readings, orientations
from jaxpose.datasets.photos.pixels import smaller_view
from jaxpose.datasets.types import Photographs, take
from jaxpose.datasets.video import Video, find_video
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera

_MOST = 100  # photographs
_FARTHEST = 1e8  # [scene units] as LLFF's scenes have it


def detect(path: Path) -> bool:
    """Whether a path is a video, or a folder with one and no more.

    Args:
        path: A file or folder.

    Returns:
        Whether `load` should read it.
    """
    return find_video(path) is not None


def load(
    path: Path | str, *, width: int | None = None, focal_px: float | None = None
) -> tuple[Photographs, Photographs]:
    """Read frames of a video, of which no pose is known; none is held out. Needs the package av (extra
    `video`).

    Frames are evenly spaced, 100 at most, turned as the file says. The principal point is the middle. A table
    of a gyroscope beside the video (`gyroscope.align`) gives their rotations.

    Args:
        path: The video, or a folder with it.
        width: Images are resized by area to it [px]; by default they are not.
        focal_px: Focal length of the frames as they are shown [px].

    Returns:
        The photographs, their poses NaN; and none of them.

    Raises:
        DataError: Naming the file for anything that cannot be used, and where no focal length is given.
        ValueError: For a width below 1.
    """
    file = find_video(Path(path))
    if file is None:
        raise DataError(f"{path}: expected a video, got none")
    video = Video(file)
    if focal_px is None:
        raise DataError(f"{file}: expected a focal length, got none, as no video has it: --focal-px says it")
    rows = np.unique(np.rint(np.linspace(0, len(video) - 1, min(_MOST, len(video)))).astype(int))
    (wide, high), lies = video.size, video.quarter_turns % 2 == 1
    full = (high, wide) if lies else (wide, high)
    camera = Camera(focal_px, focal_px, (full[0] - 1) / 2, (full[1] - 1) / 2, *full)
    small = smaller_view(file, camera, width)
    stored = (small.height, small.width) if lies else (small.width, small.height)
    t = 1e-9 * (np.array(video.ns)[rows] - video.ns[0])
    turns, said = _turns(video, focal_px, t)
    notes = ["no poses are known: no image is held out", *said]
    if len(rows) < len(video):
        notes.append(f"{len(rows)} of {len(video)} frames used, evenly spaced")
    photographs = Photographs(
        name=name_of(file.parent),
        camera=small,
        t=t,
        rgb=np.stack([np.rot90(video.read(int(i), stored), video.quarter_turns) for i in rows]),
        T_world_cam=np.full((len(rows), 4, 4), np.nan),
        near=1.0,
        far=_FARTHEST,
        spacing="disparity",
        files=tuple(f"frames/{i:06d}.png" for i in rows),
        notes=tuple(notes),
        turns=turns,
    )
    return photographs, take(photographs, np.arange(0))


def _turns(
    video: Video, focal_px: float, t: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3 3"] | None, tuple[str, ...]]:
    """Rotations of the camera as its images are shown, by a gyroscope beside the video, and a note."""
    if (readings := find_readings(video.path)) is None:
        return None, ()
    found = align(video, focal_px, readings)
    if isinstance(found, str):
        return None, (found,)
    shown = Rotation.from_rotvec([0, 0, -np.pi / 2 * video.quarter_turns]).as_matrix()
    return shown @ orientations(found, t) @ shown.T, (found.note,)
