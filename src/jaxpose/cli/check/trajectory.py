"""Checks of trajectory files, alone or a folder of them."""

from pathlib import Path

import numpy as np

from jaxpose.cli.check.findings import Checked, Fact, join, unusable
from jaxpose.cli.check.poses import Quaternions, check_poses
from jaxpose.cli.check.timestamps import check_stamps
from jaxpose.datasets.images import some
from jaxpose.errors import DataError
from jaxpose.files import trajectories
from jaxpose.files.tables import read_unchecked

_SUFFIXES = (".txt", ".csv", ".tum", ".kitti")


def check_trajectory(file: Path) -> tuple[str, Checked]:
    """The format of a file of poses, and what is tested of it; DataError for what is no trajectory at all."""
    table = read_unchecked(file)
    form, stamped, parts = "", False, []
    if table.size and table.shape[1] in (8, 17):
        commas = any("," in line for line in _head(file))
        form, stamped, unit = ("EuRoC", True, "ns") if commas else ("TUM", True, "s")
        parts.append(check_stamps("poses", table[:, 0] * (1e-9 if commas else 1.0), unit, gaps="note"))
    try:
        found = trajectories.read_trajectory(file)
    except DataError as error:
        if not form:
            raise
        return form, join([*parts, unusable(error)])
    t, T = found.trajectory
    if not found.has_timestamps:
        fact = Fact("poses", f"{len(t)}, no timestamps", {"count": len(t)})
        return found.format, join([Checked((fact,)), check_poses(None, T)])
    order = "wxyz" if found.format == "EuRoC" else "xyzw"
    # Of poses with the same timestamp the reader keeps the first.
    kept = np.append(True, np.diff(table[:, 0]) != 0)
    notes = ()
    if found.repeated:
        notes = (f"{found.repeated} poses left out, as they repeat the timestamp before them",)
    poses = check_poses(t, T, Quaternions(table[kept][: len(T), 4:8], order))
    return found.format, join([*parts, poses, Checked(notes=notes)])


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


def _head(file: Path) -> list[str]:
    lines = file.read_text("utf-8-sig", "replace").splitlines()
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")][:1]
