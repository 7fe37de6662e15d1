"""A real IMU's raw readings in a file of their own, for a recording whose layout has none."""

from pathlib import Path

import numpy as np

from jaxpose.datasets.rgbd.euroc_files import IMU_COLUMNS, read_csv, read_extrinsics
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.kalibr import CameraImu, is_camchain, read_camchain
from jaxpose.files.tables import numbered_lines, read_all_numbers, read_stamped, seconds
from jaxpose.files.trajectories import orthonormal
from jaxpose.geometry import rigid
from jaxpose.imu import Imu
from jaxpose.imu.gravity import gravity_note

_TEXT_COLUMNS = "7 numbers (t wx wy wz ax ay az)"


def read_imu(file: Path | str, t0_ns: int = 0) -> Imu:
    """Read raw readings: with commas lines of EuRoC's `imu0/data.csv`, with blanks `t wx wy wz ax ay az`.

    Args:
        file: Its timestamps are whole ns where lines have commas, else decimal seconds.
        t0_ns: Where time is 0 [ns] on the file's own clock.

    Returns:
        Readings [rad/s, m/s^2, gravity in them] with float64 seconds since `t0_ns`.

    Raises:
        DataError: Naming file and line for anything else, for text or NaN, for timestamps that repeat or go
            backwards, and for fewer than two readings.
    """
    file = Path(file)
    if "," in next((line for _, line in numbered_lines(file)), ""):
        _, ns, values = read_csv(file, IMU_COLUMNS)
    else:
        _, ns, values = read_stamped(file, _TEXT_COLUMNS, 7, unit="s")
    if len(ns) < 2:
        raise DataError(f"{file}: expected at least 2 readings, got {len(ns)}")
    return Imu(seconds(ns, t0_ns), values[:, :3], values[:, 3:])


def read_mounting(file: Path | str) -> CameraImu:
    """Read where the camera is on the IMU: EuRoC's `cam0/sensor.yaml`, Kalibr's camchain, or 16 numbers.

    Args:
        file: A data sheet with `T_BS`, a camchain with `T_cam_imu`, or the numbers of a 4x4 matrix.

    Returns:
        `T_body_cam`, its rotation orthonormal, and the time offset of a camchain, else 0.

    Raises:
        DataError: Naming the file for another count, for NaN, and for what is no rigid transform.
    """
    file = Path(file)
    if is_camchain(file):
        return read_camchain(file)
    if any(line.startswith("T_BS") for _, line in numbered_lines(file)):
        T = read_extrinsics(file)
    else:
        T = read_all_numbers(file, (16,), "T_BS, or the 16 numbers of a 4x4 T_body_cam").reshape(4, 4)
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DataError(f"{file}: expected a last row 0 0 0 1, got {' '.join(f'{x:g}' for x in T[3])}")
    return CameraImu(orthonormal(T[None], lambda _: str(file))[0], 0.0)


def with_imu(recording: Recording, readings: Path | str, mounting: Path | str) -> Recording:
    """The recording with the IMU of a file in place of any it has.

    Args:
        recording: Its `t0_ns` is on the clock of the readings; 0 for one without timestamps, whose readings
            then count from its first frame.
        readings: A file for `read_imu`.
        mounting: A file for `read_mounting`; the time offset of a camchain is taken off the readings' clock.

    Returns:
        The recording with `imu` and `T_body_cam`.

    Raises:
        DataError: As the two.
    """
    imu, (T_body_cam, offset_s) = read_imu(readings, recording.t0_ns), read_mounting(mounting)
    return recording._replace(imu=imu._replace(t=imu.t - offset_s), T_body_cam=T_body_cam)


def imu_notes(recording: Recording, name: Path | str) -> tuple[str, ...]:
    """Notes on readings that do not cover the frames, or whose mean force is not gravity's by the true poses.

    `name` is the readings' own, for errors: DataError if they and the frames have no time in common.
    """
    assert recording.imu is not None
    t, at = recording.t, np.asarray(recording.imu.t)
    t0 = recording.t0_ns * 1e-9
    spans = [f"{first + t0:.3f} to {last + t0:.3f} s" for first, last in (t[[0, -1]], at[[0, -1]])]
    inside = (t >= at[0]) & (t <= at[-1])
    if not inside.any():
        raise DataError(f"{name}: expected readings at the frames, {spans[0]}, got {spans[1]}")
    notes = []
    if not inside.all():
        notes.append(f"the IMU covers {inside.sum()} of {len(t)} frames: {spans[1]} of {spans[0]}")
    if recording.T_world_cam is not None:
        T_world_body = recording.T_world_cam @ rigid.inverse(recording.T_body_cam)
        force = np.asarray(recording.imu.acceleration_body)
        notes += gravity_note(at, force, t, T_world_body, recording.gravity_world, "the IMU")
    return tuple(notes)
