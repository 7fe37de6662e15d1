"""A real IMU's raw readings in a file of their own, for a recording whose layout has none."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.rgbd.euroc_files import read_extrinsics
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.columns import POSE, Named, joined_clock, named_columns, named_parts
from jaxpose.files.kalibr import CameraImu, is_camchain, read_camchain
from jaxpose.files.matrices import orthonormal
from jaxpose.files.tables import (
    Table,
    left_out_notes,
    numbered_lines,
    read_all_numbers,
    read_table,
    seconds,
    stamped_rows,
)
from jaxpose.files.timestamps import READINGS, Unit
from jaxpose.geometry import rigid
from jaxpose.imu import Imu
from jaxpose.imu.gravity import gravity_note

_COLUMNS = "7 columns (t wx wy wz ax ay az)"
_RATE = r"(w|omega|g|gyro?|gyroscope|angular_velocity|ang_?vel|rotation_?rate|w_rs_s|alpha)"
_FORCE = r"(a|acc|accel|accelerometer|acceleration|linear_acceleration|lin_?acc|f|force|a_rs_s)"
_NAMES = {
    "t": POSE["t"],
    **{f"w{axis}": rf"{_RATE}_?{axis}" for axis in "xyz"},
    **{f"a{axis}": rf"{_FORCE}_?{axis}" for axis in "xyz"},
}
_ORDER = tuple(_NAMES)
_DEGREE, _STANDARD = np.pi / 180, 9.80665
_TO_SI = {
    **dict.fromkeys(("", "rad/s", "rads^-1", "rads-1", "rad/sec", "m/s^2", "ms^-2", "ms-2", "m/s2"), 1.0),
    **dict.fromkeys(("deg/s", "degs^-1", "degs-1", "dps", "deg/sec"), _DEGREE),
    "g": _STANDARD,
    "mg": 1e-3 * _STANDARD,
}


class ImuFile(NamedTuple):
    """Readings [rad/s, m/s^2, gravity in them] as a file has them, at whole ns on its own clock."""

    ns: list[int]
    omega_body: Float[np.ndarray, "n 3"]
    acceleration_body: Float[np.ndarray, "n 3"]
    notes: tuple[str, ...]  # what was left out, with counts, and what is unusual
    unit: Unit  # of its timestamps
    gaps: int  # lines left out, as they have no numbers or repeat a timestamp

    def since(self, t0_ns: int) -> Imu:
        """The readings with float64 seconds since `t0_ns`."""
        return Imu(seconds(self.ns, t0_ns), self.omega_body, self.acceleration_body)


def read_imu(file: Path | str) -> ImuFile:
    """Read raw readings: a table whose header names them, or lines of `t wx wy wz ax ay az`.

    Timestamps are whole ns where lines have commas, as in EuRoC's `imu0/data.csv`, else decimal seconds;
    another unit is found by their size and steps. A unit in brackets in the header is brought to SI. Lines
    with NaN, and those that repeat a timestamp, are left out and counted.

    Args:
        file: The table.

    Returns:
        The readings.

    Raises:
        DataError: Naming file and line for anything else, for text, for timestamps that go backwards or may
            be of two units, and for fewer than two readings.
    """
    file = Path(file)
    table = joined_clock(read_table(file))
    if not table.lines:
        raise DataError(f"{file}: expected lines of {_COLUMNS}, got none")
    named, width = named_columns(table, _NAMES), len(table.words(0))
    if named is None and (lacking := _lacking(table)):
        wanted = f"a header that names {' '.join(_ORDER)}"
        raise DataError(f"{file}: expected {wanted}, got one without {' '.join(lacking)}")
    if named is None and width != 7:
        raise DataError(
            f"{file}:{table.lines[0]}: expected {_COLUMNS}, or a header that names them, got {width} columns"
        )
    at = tuple(range(7)) if named is None else tuple(named.at[name] for name in _ORDER)
    usual: Unit = "s" if table.separator is None else "ns"
    stated = None if named is None else named.unit
    rows = stamped_rows(
        file, table, _COLUMNS, at, unit=stated or usual, exact=stated is not None, steps=READINGS
    )
    if len(rows.ns) < 2:
        raise DataError(f"{file}: expected at least 2 readings, got {len(rows.ns)}")
    notes = left_out_notes(file, rows)
    if rows.unit != (stated or usual):
        notes += (f"{file.name}: timestamps are in {rows.unit}, by their size and steps",)
    (rate, force), brought = _to_si(file, named)
    gaps = len(rows.missing) + len(rows.repeated)
    return ImuFile(
        rows.ns, rate * rows.values[:, :3], force * rows.values[:, 3:], notes + brought, rows.unit, gaps
    )


class Rates(NamedTuple):
    """What a gyroscope read, as a file has it, at whole ns on its own clock."""

    ns: list[int]
    omega: Float[np.ndarray, "n 3"]  # [rad/s] where the header states a unit, else as they are
    unit: str | None  # that the header states


def read_rates(file: Path | str) -> Rates:
    """Read the readings of a gyroscope: a table whose header names them, whatever else is in it.

    In a file whose name has "gyro" the columns may be x, y and z alone.

    Args:
        file: The table.

    Returns:
        The readings.

    Raises:
        DataError: As `read_imu`, and for a header without a gyroscope.
    """
    file = Path(file)
    table = joined_clock(read_table(file))
    alone = "gyro" in file.stem.lower()
    names = {"t": _NAMES["t"]} | {
        f"w{axis}": rf"({_NAMES[f'w{axis}']}|{axis})" if alone else _NAMES[f"w{axis}"] for axis in "xyz"
    }
    named = named_columns(table, names) if table.rows else None
    if named is None:
        raise DataError(f"{file}: expected a header that names {' '.join(names)}, got none")
    unit: Unit = "s" if table.separator is None else "ns"
    at, stated = tuple(named.at[name] for name in names), named.unit
    rows = stamped_rows(
        file, table, "a gyroscope", at, unit=stated or unit, exact=stated is not None, steps=READINGS
    )
    if len(rows.ns) < 2:
        raise DataError(f"{file}: expected at least 2 readings, got {len(rows.ns)}")
    text = named.stated["wx"]
    factor = _factor(text) if text else None
    return Rates(rows.ns, (factor or 1.0) * rows.values, text if factor else None)


def names_readings(file: Path) -> bool:
    """Whether the header of a table names some quantities of an IMU, though it may lack others.

    Args:
        file: A table.

    Returns:
        Whether an error of `read_imu` says more of it than that of a reader of poses.
    """
    return bool(_lacking(joined_clock(read_table(file))))


def _lacking(table: Table) -> list[str]:
    """What the first header that names three quantities of an IMU has no name for; nothing without one."""
    for header in table.headers:
        there = named_parts(header, table, _NAMES)
        if len(there) >= 3:
            return [name for name in _ORDER if name not in there]
    return []


def _to_si(file: Path, named: Named | None) -> tuple[tuple[float, float], tuple[str, ...]]:
    """What brings rates to rad/s and forces to m/s^2 by the units of the header, and what to say of it."""
    factors, notes = [], []
    for name, quantity in (("wx", "the gyroscope"), ("ax", "the accelerometer")):
        stated = "" if named is None else named.stated[name]
        factor = _factor(stated)
        if factor is None:
            notes.append(f"{file.name}: unit {stated!r} of {quantity} is not known: taken as SI")
        elif factor != 1:
            notes.append(f"{file.name}: {quantity} is in {stated}, by the header: multiplied by {factor:.6g}")
        factors.append(factor or 1.0)
    return (factors[0], factors[1]), tuple(notes)


def _factor(unit: str) -> float | None:
    """What brings a unit as headers write it to SI; None for one that is not known."""
    return _TO_SI.get(unit.lower().replace(" ", "").replace("\u00b0", "deg").replace("*", ""))


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
    file, (T_body_cam, offset_s) = read_imu(readings), read_mounting(mounting)
    imu = file.since(recording.t0_ns)
    return recording._replace(
        imu=imu._replace(t=imu.t - offset_s), T_body_cam=T_body_cam, notes=(*recording.notes, *file.notes)
    )


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
