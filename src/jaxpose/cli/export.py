"""Write the trajectory of a run in a format that other programs read.

RUN is the folder of a run, or a trajectory file (to change its format). Poses are camera-to-world with camera
axes right, down, forward, in the world of the run's trajectory.txt. They are those of the frames, or of the
run's continuous trajectory at --rate-hz or at the timestamps of a file (--at).
"""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
import tyro

from jaxpose.cli.source import FIELD, Source, images_on_disk, read_field, read_source
from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_apart, check_positive
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import atomic, trajectories

if TYPE_CHECKING:
    from jaxpose.geometry.camera import Camera

Format = Literal["tum", "kitti", "euroc", "transforms", "colmap", "npz"]
_OWN = (
    1e-6  # [s] timestamps of a file closer than this are the same: float64 holds those since 1970 to 2.4e-7
)


@dataclass(frozen=True)
class Config:
    """What to take out of a run, and where to put it."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]  # run folder, or trajectory file
    # tum: `t tx ty tz qx qy qz qw`; kitti: 3x4 matrices without timestamps; euroc: csv with timestamps in ns;
    # transforms: transforms.json for nerfstudio and instant-ngp; colmap: a text model; npz: the continuous
    # trajectory itself, which `jaxpose/fields/numpy_evaluator.py` evaluates with numpy alone.
    format: Format
    out: Path  # file to write; colmap: folder
    rate_hz: float | None = None  # [Hz] poses at this rate from the first frame on; None: at the frames
    at: Path | None = None  # poses at the timestamps of this file, the first number of each line ([s], or ns)
    json: bool = False  # print what was written as JSON and nothing else

    def __post_init__(self):
        check_positive(self, "rate_hz")
        check_apart("--out", self.out, self.run, self.at)
        if self.rate_hz is not None and self.at is not None:
            raise ValueError("--at: expected no --rate-hz with it")
        if self.format in ("transforms", "colmap", "npz") and (self.rate_hz or self.at):
            why = "is for any time" if self.format == "npz" else "says where each image was taken"
            raise ValueError(f"--format {self.format}: expected no --rate-hz and no --at, as the file {why}")


class Result(NamedTuple):
    """What was written."""

    source: str  # in words
    out: Path
    format: Format
    poses: int | None  # None: npz, which has one for any time
    times: str  # which times they are for
    notes: tuple[str, ...]


def run(config: Config, on_update: OnUpdate = silent) -> Result:
    """Write what the config asks for.

    Args:
        config: what to write, and where.
        on_update: called with what is being done.

    Returns:
        What was written.

    Raises:
        DataError, OSError: for what cannot be used; then nothing is written.
    """
    on_update(Update(f"reading {config.run}", quiet=True))
    source = read_source(config.run)
    if config.format == "npz":
        return _continuous(config, source)
    trajectory, times, notes = _chosen(config, source)
    if not source.stamped and config.format in ("tum", "euroc"):
        raise DataError(
            f"{source.path}: expected timestamps for --format {config.format}, got a {source.what}"
        )
    config.out.parent.mkdir(parents=True, exist_ok=True)
    if config.format == "tum":
        trajectories.write_tum(config.out, trajectory)
    elif config.format == "euroc":
        trajectories.write_euroc(config.out, trajectory)
    elif config.format == "kitti":
        trajectories.write_kitti(config.out, trajectory.T)
        notes += ("the format has no timestamps: line i is pose i",)
    else:
        notes += _with_images(config, source, trajectory)
    return Result(str(source), config.out, config.format, len(trajectory.t), times, notes)


def main(args: Sequence[str] | None = None, prog: str = "jaxpose export") -> None:
    """The command `jaxpose export`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    execute(Command(prog, Config, __doc__, run, report), args)


def report(result: Result) -> str:
    """What was written, in a few lines."""
    poses = "the continuous trajectory" if result.poses is None else f"{result.poses} poses"
    lines = [("from", result.source), ("written", f"{result.out}  {result.format}, {poses}, {result.times}")]
    return "\n".join(f"  {name:<8} {text}" for name, text in (*lines, *(("note", n) for n in result.notes)))


def _chosen(config: Config, source: Source) -> tuple[trajectories.Trajectory, str, tuple[str, ...]]:
    """The poses that are asked for, which times these are, and notes."""
    t, T = source.trajectory
    if config.rate_hz is not None:
        pose = read_field(source)
        count = int(np.floor((t[-1] - t[0]) * config.rate_hz * (1 + 1e-12))) + 1
        asked = t[0] + np.arange(count) / config.rate_hz
        times = f"of the continuous trajectory at {config.rate_hz:g} Hz"
        return trajectories.Trajectory(asked, pose(asked)), times, ()
    if config.at is None:
        return source.trajectory, "those of the frames" if source.is_run else "those of the file", ()
    asked = trajectories.read_timestamps(config.at)
    if not source.is_run:
        rows = trajectories.nearest(asked, t)
        strange = np.flatnonzero(~(np.abs(t[rows] - asked) < _OWN)) if source.stamped else np.arange(1)
        if len(strange):
            raise DataError(
                f"{config.at}: expected timestamps of {source.path}, as its motion between them is not "
                f"known, "
                f"got {asked[strange[0]]:.6f} s"
            )
        return trajectories.Trajectory(asked, T[rows]), f"those of {config.at}", ()
    pose = read_field(source)
    inside = (asked >= t[0]) & (asked <= t[-1])
    if not inside.any():
        raise DataError(
            f"{config.at}: expected timestamps from {t[0]:.3f} to {t[-1]:.3f} s, as the run has, got "
            f"{asked[0]:.3f} to {asked[-1]:.3f} s"
        )
    left = len(asked) - int(inside.sum())
    notes = (f"{left} of {len(asked)} timestamps are beyond the ends of the run: left out",) if left else ()
    asked = asked[inside]
    return (
        trajectories.Trajectory(asked, pose(asked)),
        f"of the continuous trajectory at those of {config.at}",
        notes,
    )


def _continuous(config: Config, source: Source) -> Result:
    """The run's own file of its continuous trajectory, if it can be read."""
    first, last = source.trajectory.t[[0, -1]]
    read_field(source)
    config.out.parent.mkdir(parents=True, exist_ok=True)
    with atomic.atomic(config.out) as temporary:
        shutil.copyfile(source.path / FIELD, temporary)
    times = f"made for {first:.3f} to {last:.3f} s"
    return Result(str(source), config.out, config.format, None, times, ())


def _with_images(config: Config, source: Source, trajectory: trajectories.Trajectory) -> tuple[str, ...]:
    """Write the poses of the images by their names; notes on these and on the camera."""
    from jaxpose.datasets.photos.transforms_json import write_transforms
    from jaxpose.datasets.types import Photographs
    from jaxpose.files.camera_json import read_camera
    from jaxpose.files.colmap import write_colmap

    if not source.is_run:
        raise DataError(
            f"{source.path}: expected a run folder for --format {config.format}, got a {source.what}: it "
            "names neither camera nor images"
        )
    camera, images, folder = read_camera(source.path / "camera.json")
    t, T_world_cam = trajectory
    if images and len(images) != len(t):
        raise DataError(f"{source.path}: expected {len(images)} poses, one an image, got {len(t)}")
    found, notes = images_on_disk(folder, images), ()
    if found:
        camera, notes = _as_on_disk(camera, found[0])
        images = tuple(file.relative_to(folder).as_posix() for file in found)
    elif images:
        images = tuple(Path(name).as_posix() for name in images)
        notes = (f"not all images are in {folder}: names and camera are those that the run had",)
    else:
        images = tuple(f"frame-{number:06d}.png" for number in range(len(t)))
        notes = ("the images of the run are on no disk: their names are made up",)
    if config.format == "colmap":
        write_colmap(config.out, camera, images, T_world_cam)
        return *notes, "no points; image names are relative to " + (str(folder) if found else "their folder")
    if found:
        images = tuple(os.path.relpath(file.resolve(), config.out.parent.resolve()) for file in found)
    pixels = np.empty((len(t), 0, 0, 3), np.uint8)  # only names are written; depths are unknown
    name = source.path.name
    shots = Photographs(name, camera, t, pixels, T_world_cam, np.nan, np.nan, "disparity", images)
    write_transforms(config.out, shots)
    return *notes, "axes right, up, back, as these files have them"


def _as_on_disk(camera: "Camera", file: Path) -> tuple["Camera", tuple[str, ...]]:
    """The camera of the images as they are in their files, which a run may have made smaller."""
    from jaxpose.datasets.images import image_size
    from jaxpose.geometry.camera import resized

    width, height = image_size(file)
    if (width, height) == (camera.width, camera.height):
        return camera, ()
    note = f"the camera is that of the files, {width}x{height}; the run used {camera.width}x{camera.height}"
    return resized(camera, width, height), (note,)
