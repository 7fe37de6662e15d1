"""The poses of recordings, photographs and events, for commands that take trajectories."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.cli.source import Source
from jaxpose.datasets.events import registry as event_registry
from jaxpose.datasets.images import natural_order
from jaxpose.datasets.photos import blender, colmap, llff
from jaxpose.datasets.photos import registry as photo_registry
from jaxpose.datasets.photos.common import frame_numbers
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.errors import DataError
from jaxpose.files.colmap import read_colmap
from jaxpose.files.tables import seconds
from jaxpose.files.timestamps import origin, to_stamps, units
from jaxpose.files.trajectories import Trajectory, TrajectoryFile, read_trajectory

_STAMP = re.compile(r"\d{1,10}\.\d{2,9}|\d{13}|\d{16}|\d{19}")  # seconds; ms, us or ns since 1970
_BESIDE_EVENTS = ("groundtruth.txt", "poses.txt")


def read_data(path: Path) -> Source | None:
    """The poses of a recording with depth, of photographs or beside events.

    Args:
        path: A folder or file.

    Returns:
        The poses; None for what is none of these.

    Raises:
        DataError: Naming the file for what cannot be used, and for data without poses.
    """
    if (form := rgbd_registry.detect(path)) is not None:
        return _recording(path, form)
    if colmap.detect(path) and photo_registry.find_format(path) == "colmap":
        model = read_colmap(colmap.find_model(path))  # its images are not needed
        return _of_images(path, "COLMAP model", model.names, model.T_world_cam)
    if llff.detect(path) or blender.detect(path):
        parts = photo_registry.load_photographs(path)
        names = [name for part in parts for name in part.files]
        poses = np.concatenate([part.T_world_cam for part in parts])
        return _of_images(path, f"{photo_registry.find_format(path)} folder", names, poses)
    return _beside_events(path)


def _recording(path: Path, form: rgbd_registry.Format) -> Source:
    """The true poses of a recording."""
    recording = rgbd_registry.load_recording(path, form)
    if recording.T_world_cam is None:
        raise DataError(f"{path}: expected a recording with true poses, got a {form} one without")
    known = np.isfinite(recording.T_world_cam).all((1, 2))
    trajectory = Trajectory(recording.t[known], recording.T_world_cam[known], recording.t0_ns)
    missing, stamped = int((~known).sum()), rgbd_registry.has_timestamps(path, form)
    notes = (f"{missing} frames without a true pose",) if missing else ()
    file = TrajectoryFile(trajectory, "TUM", stamped, notes, 0, missing, len(recording.t))
    names = tuple(np.array(recording.files)[known].tolist()) if recording.files else ()
    return Source(path, f"{form} recording", trajectory, stamped, file, names=names)


def _of_images(path: Path, what: str, names: Sequence[str], T: Float[np.ndarray, "n 4 4"]) -> Source:
    """Poses with the names of their images, which are timestamps or frame numbers, or only in order."""
    order = sorted(range(len(names)), key=lambda row: natural_order(names[row]))
    names, T = [names[row] for row in order], T[order]
    trajectory, notes = _stamped(names, T), ("timestamps are the names of the images",)
    if not (stamped := trajectory is not None):
        trajectory, notes = Trajectory(frame_numbers(names)[0], T), ()
    file = TrajectoryFile(trajectory, "TUM", stamped, notes, 0, 0, len(names))
    return Source(path, what, trajectory, stamped, file, names=tuple(names))


def _stamped(names: Sequence[str], T: Float[np.ndarray, "n 4 4"]) -> Trajectory | None:
    """The trajectory, where all names are timestamps."""
    stems = [Path(name).stem for name in names]
    if not all(map(_STAMP.fullmatch, stems)):
        return None
    stamps = to_stamps(stems)
    possible = units(stamps, "s")
    ns = stamps.ns(possible[0]) if len(possible) == 1 else []
    if not ns or any(after <= before for before, after in zip(ns, ns[1:], strict=False)):
        return None
    return Trajectory(seconds(ns, origin(ns)), T, origin(ns))


def _beside_events(path: Path) -> Source | None:
    """The file of poses in a folder of events."""
    file = next((path / name for name in _BESIDE_EVENTS if (path / name).is_file()), None)
    try:
        form = event_registry.find_format(path)
    except DataError:
        return None
    if file is None:
        raise DataError(
            f"{path}: expected {' or '.join(_BESIDE_EVENTS)} with the events ({form}), got neither"
        )
    found = read_trajectory(file)
    return Source(file, f"{found.format} file", found.trajectory, found.has_timestamps, found)
