"""Write the trajectory of a run in a format that other programs read.

RUN is the folder of a run, or a trajectory file (to change its format). Poses are camera-to-world with camera
axes right, down, forward, in the world of the run's trajectory.txt. They are those of the frames, or of the
run's continuous trajectory at --rate-hz or at the timestamps of a file (--at).
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float

from jaxpose.cli.source import FIELD, Source, read_covariance, read_field, read_source
from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_apart, check_positive
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import atomic, trajectories
from jaxpose.files.association import nearest
from jaxpose.files.tables import seconds
from jaxpose.files.timestamps import format_ns

Format = Literal[
    "tum",
    "csv",
    "kitti",
    "euroc",
    "transforms",
    "colmap",
    "colmap_binary",
    "mcap",
    "bag",
    "rerun",
    "npz",
    "same",
]
_SAME: dict[str, Format] = {"TUM": "tum", "CSV": "csv", "KITTI": "kitti", "EuRoC": "euroc"}
_OWN_NS = 1000  # timestamps closer than this are the same: others write float64 seconds since 1970, to 240 ns


@dataclass(frozen=True)
class Config:
    """What to take out of a run, and where to put it."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]  # run folder, or trajectory file
    # tum: `t tx ty tz qx qy qz qw`; csv: the same between commas; kitti: 3x4 matrices without timestamps;
    # euroc: csv with timestamps in ns, quaternion wxyz; same: the one of these that RUN is a file of;
    # transforms: transforms.json for nerfstudio and instant-ngp; colmap: a folder with the model in sparse/0,
    # in text or binary, and copies of the images; mcap, bag: poses, path and tf of ROS 2 or ROS 1 (extra
    # `ros`); rerun: .rrd (extra `rerun`); npz: the continuous trajectory itself, which
    # `jaxpose/fields/numpy_evaluator.py` evaluates with numpy alone.
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
    if not source.stamped and form in ("tum", "csv", "euroc", "mcap", "bag", "rerun"):
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
    elif form in ("mcap", "bag"):
        notes += _ros(config.out, form, source, trajectory)
    elif form == "rerun":
        notes += _rerun(config.out, source, trajectory)
    else:
        from jaxpose.cli import export_images  # here, as it loads jax

        if form == "transforms":
            notes += export_images.export_transforms(source, config.out)
        else:
            notes += export_images.export_colmap(source, config.out, binary=form == "colmap_binary")
    return Result(str(source), config.out, form, len(trajectory.t), times, notes)


def _kitti_times(config: Config, source: Source, trajectory: trajectories.Trajectory) -> tuple[str, ...]:
    """The timestamps of KITTI's lines, in a file of their own as KITTI has them; a note on it."""
    if not source.stamped:
        return ("the format has no timestamps: line i is pose i",)
    file = config.out.with_name(f"{config.out.stem}_times.txt")
    atomic.write_text(file, "".join(f"{t!r}\n" for t in np.asarray(trajectory.t, np.float64).tolist()))
    return (f"the format has no timestamps: those of its lines are in {file}",)


def _ros(
    out: Path, form: Literal["mcap", "bag"], source: Source, trajectory: trajectories.Trajectory
) -> tuple[str, ...]:
    """Poses as messages of ROS, with their covariances where the run knows them."""
    from jaxpose.files.ros_poses import CAMERA, WORLD, write_ros_poses

    covariance, sure = read_covariance(source, trajectory)
    write_ros_poses(out, trajectory, covariance, form=form)
    return (f"/pose {sure}, /path, and /tf of {CAMERA} in {WORLD}",)


def _rerun(out: Path, source: Source, trajectory: trajectories.Trajectory) -> tuple[str, ...]:
    """A recording of rerun, with the camera and the points of a run."""
    from jaxpose.cli.export_images import run_camera, run_points
    from jaxpose.files.rerun_file import write_rerun

    points, rgb, told = run_points(source.path / "points.ply") if source.is_run else (None, None, "no points")
    write_rerun(out, trajectory, run_camera(source), points=points, rgb=rgb)
    return (told,)


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
