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
from jaxtyping import Float

from jaxpose.cli.source import FIELD, Source, images_on_disk, read_field, read_source
from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_apart, check_positive
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import atomic, trajectories
from jaxpose.files.association import nearest
from jaxpose.files.tables import seconds
from jaxpose.files.timestamps import format_ns

if TYPE_CHECKING:
    from jaxpose.geometry.camera import Camera

Format = Literal["tum", "csv", "kitti", "euroc", "transforms", "colmap", "colmap_binary", "npz", "same"]
_SAME: dict[str, Format] = {"TUM": "tum", "CSV": "csv", "KITTI": "kitti", "EuRoC": "euroc"}
_OWN_NS = 1000  # timestamps closer than this are the same: others write float64 seconds since 1970, to 240 ns


_MOST_POINTS = 200_000  # of a COLMAP model


@dataclass(frozen=True)
class Config:
    """What to take out of a run, and where to put it."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]  # run folder, or trajectory file
    # tum: `t tx ty tz qx qy qz qw`; csv: the same between commas; kitti: 3x4 matrices without timestamps;
    # euroc: csv with timestamps in ns, quaternion wxyz; same: the one of these that RUN is a file of;
    # transforms: transforms.json for nerfstudio and instant-ngp; colmap: a model in text or binary; npz: the
    # continuous trajectory itself, which `jaxpose/fields/numpy_evaluator.py` evaluates with numpy alone.
    format: Format
    out: Path  # file to write; colmap: folder
    rate_hz: float | None = None  # [Hz] poses at this rate from the first frame on; None: at the frames
    at: Path | None = None  # poses at the timestamps of this file, the first number of each line ([s], or ns)
    columns: str | None = None  # of a file that does not say what they hold: `t[us] tx ty tz qw qx qy qz`
    json: bool = False  # print what was written as JSON and nothing else

    def __post_init__(self):
        check_positive(self, "rate_hz")
        check_apart("--out", self.out, self.run, self.at)
        if self.rate_hz is not None and self.at is not None:
            raise ValueError("--at: expected no --rate-hz with it")
        if self.format in ("transforms", "colmap", "colmap_binary", "npz") and (self.rate_hz or self.at):
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
    source = read_source(config.run, config.columns)
    if config.format == "npz":
        return _continuous(config, source)
    form: Format = config.format
    if form == "same":
        form = "tum" if source.file is None else _SAME.get(source.file.format, "same")
    if form == "same":
        raise DataError(
            f"{source.path}: expected a {', '.join(_SAME)} file for --format same, got a {source.what}"
        )
    (trajectory, xyzw), times, notes = _chosen(config, source)
    if not source.stamped and form in ("tum", "csv", "euroc"):
        raise DataError(f"{source.path}: expected timestamps for --format {form}, got a {source.what}")
    if form == "kitti" and source.lines > len(source.trajectory.t) and not source.stamped:
        raise DataError(f"{source.path}: expected finite poses for --format kitti, got {source}")
    config.out.parent.mkdir(parents=True, exist_ok=True)
    if form == "tum":
        trajectories.write_tum(config.out, trajectory, xyzw)
    elif form == "csv":
        trajectories.write_csv(config.out, trajectory, xyzw)
    elif form == "euroc":
        trajectories.write_euroc(config.out, trajectory, xyzw)
    elif form == "kitti":
        trajectories.write_kitti(config.out, trajectory.T)
        notes += _kitti_times(config, source, trajectory)
    else:
        notes += _with_images(config, source, trajectory)
    return Result(str(source), config.out, form, len(trajectory.t), times, notes)


def _kitti_times(config: Config, source: Source, trajectory: trajectories.Trajectory) -> tuple[str, ...]:
    """The timestamps of KITTI's lines, in a file of their own as KITTI has them; a note on it."""
    if not source.stamped:
        return ("the format has no timestamps: line i is pose i",)
    file = config.out.with_name(f"{config.out.stem}_times.txt")
    atomic.write_text(file, "".join(f"{t!r}\n" for t in np.asarray(trajectory.t, np.float64).tolist()))
    return (f"the format has no timestamps: those of its lines are in {file}",)


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


class _Poses(NamedTuple):
    trajectory: trajectories.Trajectory
    quaternion_xyzw: Float[np.ndarray, "n 4"] | None = None  # as a file had them


def _chosen(config: Config, source: Source) -> tuple[_Poses, str, tuple[str, ...]]:
    """The poses that are asked for, which times these are, and notes."""
    t, T, t0_ns = source.trajectory
    if config.rate_hz is not None:
        pose = read_field(source)
        count = int(np.floor((t[-1] - t[0]) * config.rate_hz * (1 + 1e-12))) + 1
        asked = t[0] + np.arange(count) / config.rate_hz
        times = f"of the continuous trajectory at {config.rate_hz:g} Hz"
        return _Poses(trajectories.Trajectory(asked, pose(asked))), times, ()
    xyzw = None if source.file is None else source.file.quaternion_xyzw
    if config.at is None:
        return (
            _Poses(source.trajectory, xyzw),
            "those of the frames" if source.is_run else "those of the file",
            (),
        )
    asked_ns = trajectories.read_timestamps(config.at)
    asked = seconds(asked_ns, t0_ns)
    if not source.is_run:
        rows = nearest(asked, t)
        strange = (
            np.flatnonzero(~(np.abs(t[rows] - asked) < 1e-9 * _OWN_NS)) if source.stamped else np.arange(1)
        )
        if len(strange):
            k = strange[0]
            raise DataError(
                f"{config.at}: expected timestamps of {source.path}, as its motion between them is not "
                f"known, got {format_ns(asked_ns[k])} s, {abs(t[rows[k]] - asked[k]):.3g} s from the nearest"
            )
        xyzw = None if xyzw is None else xyzw[rows]
        return _Poses(trajectories.Trajectory(asked, T[rows], t0_ns), xyzw), f"those of {config.at}", ()
    pose = read_field(source)
    inside = (asked >= t[0]) & (asked <= t[-1])
    if not inside.any():
        raise DataError(
            f"{config.at}: expected timestamps from {source.span()}, as the run has, got {asked[0]:.3f} to "
            f"{asked[-1]:.3f} s"
        )
    left = len(asked) - int(inside.sum())
    notes = (f"{left} of {len(asked)} timestamps are beyond the ends of the run: left out",) if left else ()
    asked = asked[inside]
    times = f"of the continuous trajectory at those of {config.at}"
    return _Poses(trajectories.Trajectory(asked, pose(asked))), times, notes


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
    t, T_world_cam, _ = trajectory
    if images and len(images) != len(t):
        raise DataError(f"{source.path}: expected {len(images)} poses, one an image, got {len(t)}")
    if not images and (source.path / "transforms.json").is_file():
        raise DataError(
            f"{source.path}: expected images of one camera for --format {config.format}, got a run that "
            "brought them to one: its transforms.json has the poses with the lens of each"
        )
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
    cloud = source.path / "points.ply"
    if config.format != "transforms":
        points, rgb, told = _points(cloud)
        binary = config.format == "colmap_binary"
        write_colmap(config.out, camera, images, T_world_cam, points=points, rgb=rgb, binary=binary)
        return *notes, f"{told}; image names are relative to {folder if found else 'their folder'}"
    if found:
        images = tuple(os.path.relpath(file.resolve(), config.out.parent.resolve()) for file in found)
    pixels = np.empty((len(t), 0, 0, 3), np.uint8)  # only names are written; depths are unknown
    name = source.path.name
    shots = Photographs(name, camera, t, pixels, T_world_cam, np.nan, np.nan, "disparity", images)
    here = config.out.parent.resolve()
    write_transforms(
        config.out, shots, points=os.path.relpath(cloud.resolve(), here) if cloud.is_file() else None
    )
    return *notes, "axes right, up, back, as these files have them"


def _points(file: Path) -> tuple[np.ndarray | None, np.ndarray | None, str]:
    """The points of a run with their colours, not more than trainers begin with, and what there is to say."""
    from jaxpose.files.ply import read_coloured_points

    if not file.is_file():
        return None, None, "no points"
    points, rgb = read_coloured_points(file)
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).round().astype(int))
    share = "" if len(chosen) == len(points) else f" of {len(points)}"
    return points[chosen], rgb[chosen], f"{len(chosen)}{share} points of {file.name}, without their matches"


def _as_on_disk(camera: "Camera", file: Path) -> tuple["Camera", tuple[str, ...]]:
    """The camera of the images as they are in their files, which a run may have made smaller."""
    from jaxpose.datasets.images import image_size
    from jaxpose.geometry.camera import resized

    width, height = image_size(file)
    if (width, height) == (camera.width, camera.height):
        return camera, ()
    note = f"the camera is that of the files, {width}x{height}; the run used {camera.width}x{camera.height}"
    return resized(camera, width, height), (note,)
