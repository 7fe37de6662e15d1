"""Copy a recording with depth, of any format that is read, into a folder of image files.

DATA is what `jaxpose slam --data` takes: a bag, a video, a folder. Frames keep their timestamps, poses and
readings their digits; images that are files of the same pixels already are copied as they are. Lenses that
the format has no place for are undone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import tyro

from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_apart, check_positive
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.progress import OnUpdate, Update, silent

Target = Literal["plain", "tum", "euroc"]


@dataclass(frozen=True)
class Config:
    """What to copy, and to where."""

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]  # recording to copy
    # plain: color/, depth/, intrinsics.json, times.txt, poses.txt; tum: the layout of TUM RGB-D; euroc: mav0/
    # with cam0, depth0, imu0 and ground truth. An IMU is in imu.csv with sensor.yaml, but for euroc.
    to: Target
    out: Path  # folder to make
    topics: tuple[str, ...] = ()  # of a ROS bag, those to use before others of their kind
    recorded_hz: float | None = None  # [Hz] frame rate of recordings without timestamps
    json: bool = False  # print what was written as JSON and nothing else

    def __post_init__(self):
        check_positive(self, "recorded_hz")
        check_apart("--out", self.out, self.data)


class Result(NamedTuple):
    """What was written."""

    source: str  # in words
    out: Path
    to: Target
    frames: int
    poses: int  # of frames that have one
    readings: int  # of the IMU
    notes: tuple[str, ...]


def run(config: Config, on_update: OnUpdate = silent) -> Result:
    """Copy the recording.

    Args:
        config: What to copy, and to where.
        on_update: Called with what is being done.

    Returns:
        What was written.

    Raises:
        DataError, OSError: For what cannot be used; then nothing is left of the folder.
    """
    on_update(Update(f"reading {config.data}", quiet=True))
    from jaxpose.cli.converted import write_recording  # here, as it loads jax
    from jaxpose.datasets.rgbd import registry

    form = registry.find_format(config.data)
    stamped = registry.has_timestamps(config.data, form)
    if stamped and config.recorded_hz is not None:
        raise DataError(f"{config.data}: expected no --recorded-hz, as its frames have timestamps")
    rate = {} if config.recorded_hz is None else {"rate_hz": config.recorded_hz}
    recording = registry.load_recording(config.data, form, topics=config.topics, **rate)
    notes = recording.notes
    if not stamped and config.recorded_hz is None:
        notes += ("no timestamps: frames taken to be at 30 Hz; --recorded-hz",)
    counts, told = write_recording(config.out, recording, config.data, config.to, on_update)
    return Result(f"{config.data}  {form}", config.out, config.to, *counts, (*notes, *told))


def main(args: Sequence[str] | None = None, prog: str = "jaxpose convert") -> None:
    """The command `jaxpose convert`.

    Args:
        args: The command line; None is that of this process.
        prog: The command as it is typed.
    """
    execute(Command(prog, Config, __doc__, run, report), args)


def report(result: Result) -> str:
    """What was written, in a few lines."""
    what = f"{result.frames} frames, {result.poses} poses, {result.readings} readings of an IMU"
    lines = [("from", result.source), ("written", f"{result.out}  {result.to}: {what}")]
    return "\n".join(f"  {name:<8} {text}" for name, text in (*lines, *(("note", n) for n in result.notes)))
