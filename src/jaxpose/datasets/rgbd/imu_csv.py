"""A real IMU's raw readings in a file of their own, for a recording whose layout has none."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.rgbd.euroc_files import IMU_COLUMNS, read_csv, read_extrinsics, seconds
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.tables import read_numbers
from jaxpose.files.trajectories import orthonormal
from jaxpose.geometry import rigid
from jaxpose.imu import Imu
from jaxpose.imu.gravity import gravity_note

_TEXT_COLUMNS = "7 numbers (t wx wy wz ax ay az)"


def read_imu(file: Path | str) -> Imu:
    """Read raw readings [rad/s, m/s^2, gravity in them] with timestamps [s] on the file's own clock.

    With commas a line is that of EuRoC's `imu0/data.csv`, its timestamp in whole ns; with blanks it is
    `t wx wy wz ax ay az`, t in seconds. DataError naming file and line for anything else, for text or NaN,
    for timestamps that repeat or go backwards, and for fewer than two readings; FileNotFoundError as usual.
    """
    file = Path(file)
    text = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    first = next((line for line in text if line.strip() and not line.lstrip().startswith("#")), "")
    if "," in first:
        timestamps, values, _ = read_csv(file, IMU_COLUMNS)
        t = seconds(timestamps, 0)
    else:
        lines, table = read_numbers(file, _TEXT_COLUMNS, (7,))
        t, values = table[:, 0], table[:, 1:]
        for row in np.flatnonzero(np.diff(t) <= 0) + 1:
            raise DataError(
                f"{file}:{lines[row]}: expected a timestamp after {t[row - 1]!s} s, got {t[row]!s} s"
            )
    if len(t) < 2:
        raise DataError(f"{file}: expected at least 2 readings, got {len(t)}")
    return Imu(t, values[:, :3], values[:, 3:])


def read_mounting(file: Path | str) -> Float[np.ndarray, "4 4"]:
    """Read `T_body_cam`, the camera's pose on the IMU: `T_BS` of EuRoC's `cam0/sensor.yaml`, or 16 numbers.

    DataError naming the file for another count, for NaN, and for what is no rigid transform.
    """
    file = Path(file)
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    if "T_BS" in text:
        T = read_extrinsics(file)
    else:
        text = " ".join(line.partition("#")[0] for line in text.splitlines())
        wanted = "T_BS, or the 16 numbers of a 4x4 T_body_cam"
        try:
            T = np.array([float(word) for word in text.replace(",", " ").split()])
        except ValueError:
            raise DataError(f"{file}: expected {wanted}, got {' '.join(text.split())[:60]!r}") from None
        if T.size != 16 or not np.isfinite(T).all():
            raise DataError(f"{file}: expected {wanted}, got {np.isfinite(T).sum()} finite numbers")
        T = T.reshape(4, 4)
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DataError(f"{file}: expected a last row 0 0 0 1, got {' '.join(f'{x:g}' for x in T[3])}")
    return orthonormal(T[None], lambda _: str(file))[0]


def with_imu(recording: Recording, readings: Path | str, mounting: Path | str) -> Recording:
    """The recording with the IMU of `readings` in place of any it has, at `mounting` from the camera.

    Timestamps count on the clock of the recording's own files; of one without timestamps, from its first
    frame.
    """
    imu = read_imu(readings)
    return recording._replace(
        imu=imu._replace(t=np.asarray(imu.t) - recording.t0), T_body_cam=read_mounting(mounting)
    )


def imu_notes(recording: Recording, name: Path | str) -> tuple[str, ...]:
    """Notes on readings that do not cover the frames, or whose mean force is not gravity's by the true poses.

    `name` is the readings' own, for errors: DataError if they and the frames have no time in common.
    """
    assert recording.imu is not None
    t, at = recording.t, np.asarray(recording.imu.t)
    spans = [
        f"{first + recording.t0:.3f} to {last + recording.t0:.3f} s"
        for first, last in (t[[0, -1]], at[[0, -1]])
    ]
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
