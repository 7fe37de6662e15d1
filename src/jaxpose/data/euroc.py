"""EuRoC recordings in the ASL layout: the IMU, its data sheet and the motion-capture truth."""

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.imu import Imu, ImuNoise

_IMU_COLUMNS = "7 columns (stamp, 3 rates, 3 accelerations)"
_TRUTH_COLUMNS = "17 columns (stamp, 3 position, 4 quaternion, 3 velocity, 3 gyro bias, 3 accelerometer bias)"


class ImuLog(NamedTuple):
    """Readings in seconds since the first, the noise of `sensor.yaml`, and where the sensor sits."""

    imu: Imu
    noise: ImuNoise
    t0_ns: int
    T_body_imu: Float[np.ndarray, "4 4"]


class Truth(NamedTuple):
    """Motion capture fused with the IMU; seconds on the clock of `load_imu`, SI units, body = IMU."""

    t: Float[np.ndarray, " n"]
    T_world_body: Float[np.ndarray, "n 4 4"]
    velocity_world: Float[np.ndarray, "n 3"]
    gyro_bias: Float[np.ndarray, "n 3"]
    accelerometer_bias: Float[np.ndarray, "n 3"]


def load_imu(path: Path | str) -> ImuLog:
    """Read `mav0/imu0` of the sequence folder `path`; DataError for files that cannot be used."""
    folder = _mav0(path) / "imu0"
    stamps, values, _ = _read_csv(folder / "data.csv", _IMU_COLUMNS)
    noise, T_body_imu = _read_sensor(folder / "sensor.yaml")
    imu = Imu(_seconds(stamps, stamps[0]), values[:, :3], values[:, 3:])
    return ImuLog(imu, noise, stamps[0], T_body_imu)


def load_truth(path: Path | str) -> Truth:
    """Read `mav0/state_groundtruth_estimate0` of the folder `path`; DataError as `load_imu`.

    Its time starts at the first IMU stamp, hence the IMU's file has to be there too.
    """
    file = _mav0(path) / "state_groundtruth_estimate0" / "data.csv"
    stamps, values, lines = _read_csv(file, _TRUTH_COLUMNS)
    t0_ns = _read_csv(_mav0(path) / "imu0" / "data.csv", _IMU_COLUMNS, rows=1)[0][0]
    norm = np.linalg.norm(values[:, 3:7], axis=1)
    if abs(norm - 1).max() > 1e-2:
        row = int(abs(norm - 1).argmax())
        raise DataError(f"{file}:{lines[row]}: expected a unit quaternion, got norm {norm[row]:.4g}")
    T_world_body = np.tile(np.eye(4), (len(stamps), 1, 1))
    T_world_body[:, :3, :3] = Rotation.from_quat(values[:, [4, 5, 6, 3]]).as_matrix()
    T_world_body[:, :3, 3] = values[:, :3]
    return Truth(_seconds(stamps, t0_ns), T_world_body, values[:, 7:10], values[:, 10:13], values[:, 13:16])


def _mav0(path: Path | str) -> Path:
    """The folder of the sensors, whether the sequence or `mav0` itself was named."""
    path = Path(path)
    if not path.is_dir():
        raise DataError(f"{path}: expected a folder in the EuRoC (ASL) layout, got none")
    return path / "mav0" if (path / "mav0").is_dir() else path


def _seconds(stamps: list[int], t0_ns: int) -> Float[np.ndarray, " n"]:
    """Nanoseconds since 1970 need 61 bits, a float has 53: subtract as integers, then convert."""
    return np.array([stamp - t0_ns for stamp in stamps]) * 1e-9


def _read_text(file: Path) -> str:
    if not file.is_file():
        raise DataError(f"{file}: expected a file, got none")
    return file.read_text(encoding="utf-8-sig", errors="replace")


def _read_csv(
    file: Path, columns: str, rows: int | None = None
) -> tuple[list[int], Float[np.ndarray, "n c"], list[int]]:
    """Stamps [ns], other columns and line numbers of the first `rows` rows; errors name `columns`."""
    count = int(columns.split()[0])
    stamps, values, lines = [], [], []
    for number, line in enumerate(_read_text(file).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(",")
        if len(fields) != count:
            raise DataError(f"{file}:{number}: expected {columns}, got {len(fields)}")
        try:
            stamp, row = int(fields[0]), [float(field) for field in fields[1:]]
        except ValueError:
            raise DataError(
                f"{file}:{number}: expected a stamp in ns and numbers, got {line[:60]!r}"
            ) from None
        if not all(map(math.isfinite, row)):
            raise DataError(f"{file}:{number}: expected finite numbers, got {line[:60]!r}")
        if stamps and stamp <= stamps[-1]:
            raise DataError(f"{file}:{number}: expected a stamp after {stamps[-1]}, got {stamp}")
        stamps.append(stamp)
        values.append(row)
        lines.append(number)
        if len(stamps) == rows:
            break
    if not stamps:
        raise DataError(f"{file}: expected lines of {columns}, got none")
    return stamps, np.array(values), lines


def _read_sensor(file: Path) -> tuple[ImuNoise, Float[np.ndarray, "4 4"]]:
    """Noise densities and the pose of the sensor on the body (`T_BS`)."""
    # Five keys of a fixed layout do not need a YAML package.
    text = re.sub("#.*", "", _read_text(file))
    scalar = lambda key: _numbers(file, text, rf"^{key}[ \t]*:(.*)$", key, 1)[0]
    noise = ImuNoise(
        gyro_density=scalar("gyroscope_noise_density"),
        accelerometer_density=scalar("accelerometer_noise_density"),
        gyro_walk=scalar("gyroscope_random_walk"),
        accelerometer_walk=scalar("accelerometer_random_walk"),
    )
    pose = _numbers(file, text, r"^T_BS[ \t]*:[^\[]*\[([^\]]*)\]", "T_BS", 16)
    return noise, np.array(pose).reshape(4, 4)


def _numbers(file: Path, text: str, pattern: str, key: str, count: int) -> list[float]:
    """The `count` finite numbers that `pattern` captures behind `key`."""
    wanted = f"{key} with {count} {'number' if count == 1 else 'numbers'}"
    match = re.search(pattern, text, re.MULTILINE)
    if match is None:
        raise DataError(f"{file}: expected {wanted}, got no such key")
    try:
        numbers = [float(word) for word in match[1].replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        line = text[: match.start()].count("\n") + 1
        raise DataError(f"{file}:{line}: expected {wanted}, got {' '.join(match[1].split())[:60]!r}")
    return numbers
