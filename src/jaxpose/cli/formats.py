"""Every format that is read or written, from the registries of the loaders and of the exports."""

from typing import NamedTuple, get_args

from jaxpose.cli.convert import Target
from jaxpose.cli.export import Format as Export
from jaxpose.datasets.events import registry as event_registry
from jaxpose.datasets.photos import registry as photo_registry
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.files.layouts import Format as Trajectory

# What `read_trajectory` tells apart, and what each is tested with.
_TRAJECTORIES: dict[Trajectory, tuple[str, str]] = {
    "TUM": ("TUM: t tx ty tz qx qy qz qw; ORB-SLAM3's ns", "evo, Open3D's file, made files"),
    "CSV": ("csv of the same, tables with a header (evo, rostopic)", "made files in their layouts"),
    "KITTI": ("KITTI: 3x4 matrices", "made files"),
    "EuRoC": ("EuRoC, TUM-VI, VINS: csv of ns, position, quaternion wxyz", "evo, V1_01, made files"),
    "4x4 list": ("lists of 4x4 matrices", "made files"),
}
# What each export is opened with in its test.
_EXPORTS: dict[Export, tuple[str, str]] = {
    "tum": ("TUM", "evo"),
    "csv": ("CSV", "own reader"),
    "kitti": ("KITTI", "own reader, numpy"),
    "euroc": ("EuRoC", "evo"),
    "transforms": ("transforms", "nerfstudio's documented keys, own readers"),
    "colmap": ("colmap", "pycolmap"),
    "colmap_binary": ("colmap", "pycolmap"),
    "mcap": ("MCAP of ROS 2: PoseStamped (with covariance), Path, tf", "rosbags"),
    "bag": ("bag of ROS 1: the same", "rosbags"),
    "rerun": ("rerun (.rrd): path, camera, points", "rerun-sdk"),
    "npz": ("continuous trajectory", "numpy"),
    "same": ("", ""),  # one of the others
}
_CONVERSIONS: dict[Target, str] = {"plain": "plain", "tum": "tum", "euroc": "euroc"}  # and who reads them
_IMU = (
    ("tables whose header names the columns, EuRoC's csv, t wx wy wz ax ay az", "made files"),
    ("mounting: sensor.yaml, Kalibr's camchain (written too), 4x4", "made files"),
)


class Row(NamedTuple):
    """A format."""

    kind: str  # of data
    title: str
    name: str  # as an option
    files: str  # it is known by
    read_by: str  # what its test reads; empty: not read
    written: str  # the command that writes it; empty: none
    written_by: str  # what its test opens it with


def all_formats() -> tuple[Row, ...]:
    """Every format.

    Returns:
        Recordings with depth, photographs, events, trajectories, IMU, in this order.
    """
    rows = []
    for name, layout in rgbd_registry.LAYOUTS.items():
        copied = [target for target, form in _CONVERSIONS.items() if form == name]
        files = ", ".join(f"`{rgbd_registry.words(part)}`" for part in layout.files)
        written = f"`convert --to {copied[0]}`" if copied else ""
        rows.append(
            Row("RGB-D", layout.title, name, files, layout.tested, written, "its loader" if copied else "")
        )
    for name, layout in photo_registry.LAYOUTS.items():
        rows.append(Row("photographs", layout.title, name, layout.files, layout.tested, *_written(name)))
    for name, layout in event_registry.LAYOUTS.items():
        rows.append(Row("events", layout.title, name, layout.files, layout.tested, "", ""))
    for name, (title, tested) in _TRAJECTORIES.items():
        rows.append(Row("trajectories", title, "", "", tested, *_written(name)))
    others = {about[0] for about in _EXPORTS.values()} - {*get_args(Trajectory), *photo_registry.LAYOUTS, ""}
    for title in (about[0] for about in _EXPORTS.values()):
        if title in others:
            rows.append(Row("trajectories", title, "", "", "", *_written(title)))
    rows += [Row("IMU", title, "", "", tested, "", "") for title, tested in _IMU]
    return tuple(rows)


def _written(title: str) -> tuple[str, str]:
    """The command that writes a format, and what its test opens it with."""
    named = [(str(name), tested) for name, (of, tested) in _EXPORTS.items() if of == title]
    if not named:
        return "", ""
    first, tested = named[0]
    commands = [f"export --format {first}", *(name for name, _ in named[1:])]
    return ", ".join(f"`{command}`" for command in commands), tested
