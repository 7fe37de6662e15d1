"""Checks of the EuRoC layout's IMU and truth, which need no images."""

from pathlib import Path
from typing import Literal

import numpy as np

from jaxpose.commands.check_findings import Checked, Fact, Finding, join, unusable
from jaxpose.commands.check_imu import check_imu
from jaxpose.commands.check_poses import Quaternions, check_poses
from jaxpose.commands.check_stamps import check_stamps, read_table
from jaxpose.data import euroc
from jaxpose.data.euroc_files import sensors
from jaxpose.errors import DataError

_FILES: dict[str, Literal["note", "warning"]] = {
    "imu0": "warning",
    "cam0": "warning",
    "state_groundtruth_estimate0": "note",
}


def has_depth(path: Path) -> bool:
    """Whether a sequence has images of cam0 and depth for them: then it is a recording."""
    mav0 = sensors(path)
    depths = (mav0 / "depth0", mav0 / "pointcloud0", mav0.resolve().parent / "data.ply", mav0 / "data.ply")
    return (mav0 / "cam0").is_dir() and any(depth.exists() for depth in depths)


def check_inertial(path: Path) -> Checked:
    """Stamps, readings and truth, by themselves and against each other."""
    mav0, parts = sensors(path), []
    for name, gaps in _FILES.items():
        file = mav0 / name / "data.csv"
        if file.is_file() and (table := read_table(file)).size:
            parts.append(check_stamps(name, table[:, 0] * 1e-9, "ns", gaps=gaps))
    log = truth = None
    try:
        if (mav0 / "imu0").is_dir():
            log = euroc.load_imu(path)
            parts.append(_readings(log))
        else:
            parts.append(Checked(notes=("no imu0: poses are not tested against readings",)))
        if (mav0 / "state_groundtruth_estimate0").is_dir() and log is not None:
            truth = euroc.load_truth(path)
            parts.append(_truth(mav0, log, truth))
        else:
            parts.append(
                Checked(notes=("no state_groundtruth_estimate0: there is no truth to compare with",))
            )
    except (DataError, OSError) as error:
        parts.append(unusable(error))
    if log is not None and truth is not None:
        parts.append(check_imu(log.imu, truth.t, truth.T_world_body, log.T_body_imu[:3, :3]))
    if log is None and not parts[0].facts:
        raise DataError(f"{mav0}: expected imu0/data.csv, cam0/data.csv or both, got neither")
    return join(parts)


def _readings(log: euroc.ImuLog) -> Checked:
    rates, forces = (np.asarray(x) for x in (log.imu.omega_body, log.imu.acceleration_body))
    rate, force = (float(np.median(np.linalg.norm(x, axis=1))) for x in (rates, forces))
    text = f"median {rate:.3g} rad/s and {force:.4g} m/s^2, as the units of the format are"
    return Checked((Fact("readings", text, {"omega": rate, "acceleration": force}),))


def _truth(mav0: Path, log: euroc.ImuLog, truth: euroc.Truth) -> Checked:
    end = float(np.asarray(log.imu.t)[-1])
    shared = max(0.0, min(end, truth.t[-1]) - max(0.0, truth.t[0]))
    text = f"from {truth.t[0]:.3g} to {truth.t[-1]:.4g} s, IMU from 0 to {end:.4g} s"
    fact = Fact("truth", text, {"first_s": float(truth.t[0]), "coverage": shared / end if end else 0.0})
    findings = []
    if shared <= 0:
        fix = "check that both are of one recording, by one clock"
        findings.append(Finding("warning", "truth", text, "truth while the IMU reads", fix))
    values = read_table(mav0 / "state_groundtruth_estimate0" / "data.csv")[:, 4:8]
    poses = check_poses(truth.t, truth.T_world_body, Quaternions(values, "wxyz"))
    return join([Checked((fact,), tuple(findings)), poses])
