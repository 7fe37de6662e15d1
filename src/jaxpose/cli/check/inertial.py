"""Checks of the EuRoC layout's IMU and ground truth, which need no images."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxpose.cli.check.findings import Checked, Fact, Finding, join, unusable
from jaxpose.cli.check.imu import check_imu
from jaxpose.cli.check.poses import Quaternions, check_poses
from jaxpose.cli.check.timestamps import check_stamps
from jaxpose.datasets.images import found
from jaxpose.datasets.rgbd import euroc
from jaxpose.datasets.rgbd.euroc_files import sensors
from jaxpose.errors import DataError
from jaxpose.files import trajectories
from jaxpose.files.tables import read_unchecked

_TRUTHS = ("state_groundtruth_estimate0", "mocap0")  # of EuRoC, of TUM-VI
_FILES: dict[str, Literal["note", "warning"]] = {
    "imu0": "warning",
    "cam0": "warning",
    **dict.fromkeys(_TRUTHS, "note"),
}


def has_depth(path: Path) -> bool:
    """Whether a sequence has images of cam0 and depth for them: then it is a recording."""
    mav0 = sensors(path)
    depths = (mav0 / "depth0", mav0 / "pointcloud0", mav0.resolve().parent / "data.ply", mav0 / "data.ply")
    return (mav0 / "cam0").is_dir() and any(depth.exists() for depth in depths)


def check_inertial(path: Path) -> Checked:
    """Timestamps, readings and ground truth, by themselves and against each other."""
    mav0, parts = sensors(path), []
    for name, gaps in _FILES.items():
        file = mav0 / name / "data.csv"
        if file.is_file() and (table := read_unchecked(file)).size:
            parts.append(check_stamps(name, table[:, 0] * 1e-9, "ns", gaps=gaps))
    log = None
    try:
        if (mav0 / "imu0").is_dir():
            log = euroc.load_imu(path)
            parts.append(_readings(log))
        else:
            parts.append(Checked(notes=("no imu0: poses are not tested against readings",)))
        file = next((f for name in _TRUTHS if (f := mav0 / name / "data.csv").is_file()), None)
        if file is not None and log is not None:
            trajectory = trajectories.read_euroc(file, first_of_repeated=True)
            t, T = trajectory.t - 1e-9 * log.t0_ns, trajectory.T
            parts += [_truth(file, log, t, T), check_imu(log.imu, t, T, log.T_body_imu[:3, :3])]
        elif file is None:
            parts.append(
                Checked(notes=(f"no {' or '.join(_TRUTHS)}: there is no ground truth to compare with",))
            )
    except (DataError, OSError) as error:
        parts.append(unusable(error))
    if not any(part.facts or part.findings for part in parts):
        raise DataError(f"{mav0}: expected imu0, cam0 or both, got {found(mav0)}")
    return join(parts)


def _readings(log: euroc.ImuLog) -> Checked:
    rates, forces = (np.asarray(x) for x in (log.imu.omega_body, log.imu.acceleration_body))
    rate, force = (float(np.median(np.linalg.norm(x, axis=1))) for x in (rates, forces))
    text = f"median {rate:.3g} rad/s and {force:.4g} m/s^2, as the units of the format are"
    return Checked((Fact("readings", text, {"omega": rate, "acceleration": force}),))


def _truth(
    file: Path, log: euroc.ImuLog, t: Float[np.ndarray, " n"], T: Float[np.ndarray, "n 4 4"]
) -> Checked:
    """How much of the readings has ground truth, and ground truth by itself.

    `t` is by the clock of the readings.
    """
    end = float(np.asarray(log.imu.t)[-1])
    shared = max(0.0, min(end, t[-1]) - max(0.0, t[0]))
    text = f"from {t[0]:.3f} to {t[-1]:.3f} s, IMU from 0 to {end:.3f} s"
    fact = Fact("ground_truth", text, {"first_s": float(t[0]), "coverage": shared / end if end else 0.0})
    findings = ()
    if shared <= 0:
        fix = "check that both are of one recording, by one clock"
        findings = (Finding("warning", "ground_truth", text, "ground truth while the IMU reads", fix),)
    table = read_unchecked(file)
    values = table[np.append(True, np.diff(table[:, 0]) != 0), 4:8]
    return join([Checked((fact,), findings), check_poses(t, T, Quaternions(values, "wxyz"))])
