"""Checks of the EuRoC layout's IMU and ground truth, which need no images, and of a file of readings."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.cli.check.findings import Checked, Fact, Finding, join, unusable
from jaxpose.cli.check.imu import check_imu
from jaxpose.cli.check.readings import check_readings
from jaxpose.cli.check.timestamps import check_stamps, stamps_of
from jaxpose.cli.check.trajectory import check_read
from jaxpose.datasets.images import found
from jaxpose.datasets.rgbd import euroc
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.datasets.rgbd.euroc_files import existing, read_camera_sheet, sensors
from jaxpose.datasets.rgbd.imu_csv import ImuFile, read_imu, read_mounting
from jaxpose.errors import DataError
from jaxpose.files.trajectories import Trajectory, TrajectoryFile, read_trajectory, since
from jaxpose.geometry import rigid
from jaxpose.imu import Imu

_TRUTHS = ("state_groundtruth_estimate0", "mocap0")  # of EuRoC, of TUM-VI
_NO_TRUTH = f"no {' or '.join(_TRUTHS)}: there is no ground truth to compare with"


def has_depth(path: Path) -> bool:
    """Whether a sequence has images of cam0 and depth for them: then it is a recording."""
    mav0 = sensors(path)
    depths = (mav0 / "depth0", mav0 / "pointcloud0", mav0.resolve().parent / "data.ply", mav0 / "data.ply")
    return (mav0 / "cam0").is_dir() and any(depth.exists() for depth in depths)


def check_inertial(path: Path) -> Checked:
    """Timestamps, readings and ground truth, by themselves and against each other."""
    mav0, parts = sensors(path), []
    if (mav0 / "cam0" / "data.csv").is_file():
        stamps = stamps_of(mav0 / "cam0" / "data.csv", gaps="warning")
        parts.append(stamps._replace(facts=tuple(fact._replace(name="cam0") for fact in stamps.facts)))
    try:
        file = next((f for name in _TRUTHS if (f := mav0 / name / "data.csv").is_file()), None)
        truth = None if file is None else read_trajectory(file)
        if (mav0 / "imu0").is_dir():
            readings = read_imu(existing(mav0 / "imu0" / "data.csv"))
            log = euroc.load_imu(path)
            parts.append(check_file(readings, "imu0", truth, log.T_body_imu[:3, :3], _cam0(mav0)))
        else:
            parts.append(Checked(notes=("no imu0: poses are not tested against readings",)))
        parts.append(Checked(notes=(_NO_TRUTH,)) if truth is None else check_read(truth, "ground_truth"))
    except (DataError, OSError) as error:
        parts.append(unusable(error))
    if not any(part.facts or part.findings for part in parts):
        raise DataError(f"{mav0}: expected imu0, cam0 or both, got {found(mav0)}")
    return join(parts)


def check_beside(file: Path, mounting: Path | None, truth: TrajectoryFile | None) -> Checked:
    """A file of readings, tested by itself and against poses of a camera, or of the body, on its clock."""
    try:
        T_body_cam = None if mounting is None else read_mounting(mounting).T_body_cam
        if truth is not None and T_body_cam is not None:
            T = truth.trajectory.T @ rigid.inverse(T_body_cam)
            truth = truth._replace(trajectory=truth.trajectory._replace(T=T))
        R = None if T_body_cam is None else np.eye(3)
        return check_file(read_imu(file), file.name, truth, R, T_body_cam)
    except (DataError, OSError) as error:
        return unusable(error)


def check_alone(file: Path) -> Checked | None:
    """A file of readings, tested by itself; None for what is none."""
    try:
        readings = read_imu(file)
    except DataError:
        return None
    return check_file(readings, file.name, None, None, None)


def poses_of(path: Path, columns: str | None) -> TrajectoryFile | None:
    """The poses of a trajectory file or of a recording, for readings beside it; None where there are none."""
    try:
        if path.is_file():
            return read_trajectory(path, columns)
        recording = rgbd_registry.load_recording(path)
    except (DataError, OSError):
        return None  # the check of the data says why
    if recording.T_world_cam is None:
        return None
    known = np.isfinite(recording.T_world_cam).all((1, 2))
    poses = Trajectory(recording.t[known], recording.T_world_cam[known], recording.t0_ns)
    return TrajectoryFile(poses, "TUM", True, (), 0, 0, int(known.sum()))


def check_file(
    readings: ImuFile,
    name: str,
    truth: TrajectoryFile | None,
    R_body_imu: Float[np.ndarray, "3 3"] | None,
    T_body_cam: Float[np.ndarray, "4 4"] | None,
) -> Checked:
    """Readings by themselves, and against poses of their body on their clock.

    `R_body_imu` and `T_body_cam` are None where nothing states them.
    """
    imu = readings.since(readings.ns[0])
    gaps = [Checked(notes=readings.notes)]
    if readings.gaps:
        text = f"{readings.gaps} of {readings.gaps + len(readings.ns)} lines that are left out"
        gaps.append(Checked((), (Finding("warning", "missing readings", text, "a reading in every line"),)))
    stamps = check_stamps(name, np.asarray(imu.t), readings.unit, gaps="warning", t0_ns=readings.ns[0])
    R_cam_imu = (
        None
        if T_body_cam is None
        else T_body_cam[:3, :3].T @ (np.eye(3) if R_body_imu is None else R_body_imu)
    )
    alone = check_readings(imu, R_cam_imu)
    parts = [stamps, *gaps, alone.checked]
    if truth is not None:
        if not truth.has_timestamps:
            return join(
                [*parts, Checked(notes=("poses without timestamps are not tested against readings",))]
            )
        t = since(truth.trajectory, readings.ns[0])
        parts.append(_coverage(imu, t))
        if not alone.swapped:
            order = truth.order or "xyzw"
            parts.append(check_imu(alone.si, t, truth.trajectory.T, R_body_imu, order, alone.gyroscope_named))
    return join(parts)


def _cam0(mav0: Path) -> Float[np.ndarray, "4 4"] | None:
    """Where cam0 is on the body, if its data sheet can be read."""
    try:
        return read_camera_sheet(mav0 / "cam0" / "sensor.yaml")[1]
    except (DataError, OSError):
        return None


def _coverage(imu: Imu, t: Float[np.ndarray, " n"]) -> Checked:
    """How much of the readings has ground truth, whose timestamps `t` are by the clock of the readings."""
    end = float(np.asarray(imu.t)[-1])
    shared = max(0.0, min(end, t[-1]) - max(0.0, t[0]))
    text = f"from {t[0]:.3f} to {t[-1]:.3f} s, IMU from 0 to {end:.3f} s"
    fact = Fact("overlap", text, {"first_s": float(t[0]), "coverage": shared / end if end else 0.0})
    if shared > 0:
        return Checked((fact,))
    fix = "check that both are of one recording, by one clock"
    return Checked((fact,), (Finding("warning", "overlap", text, "poses while the IMU reads", fix),))
