"""What a set of data is, and its faults: timestamps, poses, camera, depth, IMU, and how they agree.

DATA is a folder of an RGB-D recording (7-Scenes, TUM, ICL-NUIM, Replica, ScanNet, EuRoC, plain), of
photographs with poses (Blender, nerfstudio, LLFF), of an IMU with ground truth (EuRoC), or of events (DAVIS
text, EventNeRF, npz, DSEC's HDF5); a trajectory file (TUM, KITTI, EuRoC, 4x4), or a folder of such files. The
format is found by the files. Ends with 0 if no fault is found, with 2 for warnings, and with 1 for data that
cannot be used.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import tyro

from jaxpose.cli.check.findings import Checked, Fact, Finding, join
from jaxpose.errors import DataError
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.outcome import markdown_table
from jaxpose.experiments.progress import OnUpdate, Update, silent

if TYPE_CHECKING:
    from jaxpose.cli.formats import Row

_KNOWN = (
    "an RGB-D recording (7-Scenes, TUM, ICL-NUIM, Replica, ScanNet, EuRoC, or color/ and depth/ with "
    "intrinsics), photographs (transforms.json, transforms_train.json or poses_bounds.npy), mav0/imu0 with "
    "ground truth, events (events*.txt, *.npz, *.h5, or EventNeRF's folders), or trajectories"
)


@dataclass(frozen=True)
class Config:
    """What to check."""

    # folder, bag, or trajectory file; nothing with --formats
    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")] = None
    topics: tuple[str, ...] = ()  # of a ROS bag, those to use before others of their kind
    formats: bool = False  # print what is read and written, and what each is tested with, as a table
    imu_file: Path | None = None  # readings to test by themselves and against the poses of DATA
    imu_extrinsics: Path | None = None  # of --imu-file: T_body_cam, as in `jaxpose slam`
    columns: str | None = None  # of a trajectory file that does not say: `t[us] tx ty tz qw qx qy qz`
    json: bool = False  # print all that was found as JSON and nothing else

    def __post_init__(self):
        if self.imu_extrinsics is not None and self.imu_file is None:
            raise ValueError("--imu-extrinsics: expected --imu-file FILE with it")


class Formats(NamedTuple):
    """What is read and written, and what each is tested with."""

    rows: tuple["Row", ...]


class Result(NamedTuple):
    """What the data are, what was measured, and the outcome of every test."""

    path: Path
    format: str
    facts: tuple[Fact, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]  # what loaders skipped or assumed, and what could not be tested


def run(config: Config, on_update: OnUpdate = silent) -> Result | Formats:
    """Find the format of the data and test them.

    Args:
        config: the data.
        on_update: called with what is being done.

    Returns:
        What they are, and the outcome of every test; with `formats` what is read.

    Raises:
        DataError, OSError: for what cannot be used.
    """
    if config.formats:
        from jaxpose.cli.formats import all_formats  # here, as the loaders load jax

        return Formats(all_formats())
    path = config.data
    if path is None:
        raise DataError("expected DATA to check, or --formats for what is read, got neither")
    on_update(Update(f"checking {path}", quiet=True))
    form, checked = _of_data(path, config)
    if config.imu_file is not None:
        from jaxpose.cli.check.inertial import check_beside, poses_of

        truth = poses_of(path, config.columns)
        checked = join([checked, check_beside(config.imu_file, config.imu_extrinsics, truth)])
    return Result(path, form, *checked)


def _of_data(path: Path, config: Config) -> tuple[str, Checked]:
    """The format of the data, in words, and what is found in them."""
    if path.is_file() and path.suffix not in (".json", ".npz", ".h5", ".hdf5") and not _is_recording(path):
        return _file(path, config.columns)
    if not path.exists():
        raise DataError(f"{path}: expected {_KNOWN}, got nothing")
    return _folder(path, config.topics)


def _file(path: Path, columns: str | None) -> tuple[str, Checked]:
    """A file of poses, or of an IMU's readings."""
    from jaxpose.cli.check.inertial import check_alone
    from jaxpose.cli.check.trajectory import check_trajectory
    from jaxpose.datasets.rgbd.imu_csv import names_readings, read_imu

    error, form, checked = None, "unreadable", Checked()
    try:
        form, checked = check_trajectory(path, columns)
    except DataError as told:
        error = told
    if form == "unreadable":
        if (alone := check_alone(path)) is not None:
            return "IMU readings", alone
        if names_readings(path):
            read_imu(path)  # whose error says what is wrong with readings
        if error is not None:
            raise error
    return f"{form} trajectory", checked


def main(args: Sequence[str] | None = None, prog: str = "jaxpose check") -> None:
    """The command `jaxpose check`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    if code := exit_code(execute(Command(prog, Config, __doc__, run, report), args)):
        sys.exit(code)


def report(result: Result | Formats) -> str:
    """What was found, a line each, warnings and errors last."""
    if isinstance(result, Formats):
        head = ("data", "format", "`--format`, files", "read: tested with", "written by", "tested with")
        name = lambda row: f"{row.name}: {row.files}" if row.name else row.files
        rows = [(r.kind, r.title, name(r), r.read_by, r.written, r.written_by) for r in result.rows]
        return markdown_table([head, *rows])
    width = max(10, *(len(name) for name, *_ in result.facts), *(len(f.test) for f in result.findings)) + 9
    lines = [("format", f"{result.path}  {result.format}")]
    lines += [(fact.name, fact.text) for fact in result.facts]
    lines += [("note", note) for note in result.notes]
    ranked = sorted(result.findings, key=lambda f: ("ok", "warning", "error").index(f.severity))
    lines += [(f"{finding.severity:<8} {finding.test}", str(finding)) for finding in ranked]
    told = [f"  {name:<{width}} {text}" for name, text in lines]
    return "\n".join([*told, "", f"  {_verdict(result)}"])


def exit_code(result: Result | Formats) -> int:
    """0: no fault found; 2: warnings; 1: unusable."""
    if isinstance(result, Formats):
        return 0
    severities = {finding.severity for finding in result.findings}
    return 1 if "error" in severities else 2 if "warning" in severities else 0


def _verdict(result: Result) -> str:
    counts = {s: sum(finding.severity == s for finding in result.findings) for s in ("error", "warning")}
    if counts["error"]:
        return "unusable as it is"
    plural = "s" if counts["warning"] > 1 else ""
    return f"{counts['warning']} warning{plural}" if counts["warning"] else "no fault found"


def _is_recording(path: Path) -> bool:
    from jaxpose.datasets.events.single_file import is_events
    from jaxpose.datasets.rgbd import registry as rgbd_registry

    return is_events(path) or rgbd_registry.detect(path) is not None


def _folder(path: Path, topics: Sequence[str]) -> tuple[str, Checked]:
    """The format of a folder (or of a file that is no trajectory), in words, and what is found in it."""
    # Here, as the loaders load jax, which --help does without.
    from jaxpose.cli.check import events as check_events
    from jaxpose.cli.check import inertial as check_inertial
    from jaxpose.cli.check import photographs as check_photographs
    from jaxpose.cli.check import recording as check_recording
    from jaxpose.cli.check.trajectory import check_trajectories
    from jaxpose.datasets.rgbd import euroc
    from jaxpose.datasets.rgbd import registry as rgbd_registry

    form = rgbd_registry.detect(path)
    photos = check_photographs.find_photographs(path)
    if events := check_events.find_events(path):
        return check_events.check_events(path, events)
    if photos not in (None, "plain") and form is None:
        return check_photographs.check_photographs(path, photos)
    if euroc.detect(path) and not check_inertial.has_depth(path):
        return "EuRoC, IMU and ground truth without depth", check_inertial.check_inertial(path)
    if form is not None:
        return f"RGB-D recording ({form})", check_recording.check_recording(path, form, topics)
    checked: Checked | None = check_trajectories(path)
    if checked is None and photos is not None:
        return check_photographs.check_photographs(path, photos)
    if checked is None:
        raise DataError(f"{path}: expected {_KNOWN}, got {rgbd_registry.nearest(path)}")
    return "folder of trajectories", checked
