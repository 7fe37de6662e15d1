"""Checks of trajectory files, alone or a folder of them."""

from pathlib import Path

from jaxpose.cli.check.findings import Checked, Fact, Finding, join, unusable
from jaxpose.cli.check.poses import Quaternions, check_poses
from jaxpose.cli.check.timestamps import check_stamps
from jaxpose.datasets.images import some
from jaxpose.errors import DataError
from jaxpose.files.trajectories import TrajectoryFile, read_trajectory

_SUFFIXES = (".txt", ".csv", ".tum", ".kitti")
_NONE = ": expected a trajectory, "  # in what the reader says of a file that is none


def check_trajectory(file: Path, columns: str | None = None) -> tuple[str, Checked]:
    """The format of a file of poses, and what is tested of it; DataError for what is no trajectory at all.

    `columns` are as `read_trajectory` has them.
    """
    try:
        found = read_trajectory(file, columns)
    except DataError as error:
        if _NONE in str(error):
            raise
        return "unreadable", unusable(error)
    return found.format, check_read(found)


def check_read(found: TrajectoryFile, what: str = "poses") -> Checked:
    """What is tested of poses as they were read."""
    t, T, t0_ns = found.trajectory
    missing = Checked(notes=found.notes)
    if found.missing:
        text = f"{found.missing} of {found.count} with NaN, infinity or a zero quaternion, which are left out"
        finding = Finding("warning", "missing poses", text, f"numbers in every line of {what}")
        missing = missing._replace(findings=(finding,))
    if not found.has_timestamps:
        fact = Fact(what, f"{len(t)}, no timestamps", {"count": len(t)})
        return join([Checked((fact,)), missing, check_poses(None, T)])
    assert found.unit is not None and found.order is not None and found.quaternion_xyzw is not None
    stamps = check_stamps(what, t, found.unit, gaps="note", t0_ns=t0_ns, repeated=found.repeated)
    written = found.quaternion_xyzw if found.order == "xyzw" else found.quaternion_xyzw[:, [3, 0, 1, 2]]
    return join([stamps, missing, check_poses(t, T, Quaternions(written, found.order))])


def check_trajectories(folder: Path) -> Checked | None:
    """All trajectory files of a folder, one after the other; None if there is none."""
    parts, others = [], []
    for file in sorted(folder.iterdir()):
        if file.suffix not in _SUFFIXES:
            others.append(file.name)
            continue
        try:
            form, checked = check_trajectory(file)
        except DataError:
            others.append(file.name)
            continue
        parts.append(
            Checked(
                tuple(
                    fact._replace(name=f"{file.name}: {fact.name}", text=f"{form}: {fact.text}")
                    for fact in checked.facts
                ),
                tuple(finding._replace(test=f"{file.name}: {finding.test}") for finding in checked.findings),
                tuple(f"{file.name}: {note}" for note in checked.notes),
            )
        )
    if not parts:
        return None
    note = (f"not looked at, as it is no trajectory: {some(others)}",) if others else ()
    return join([*parts, Checked(notes=note)])
