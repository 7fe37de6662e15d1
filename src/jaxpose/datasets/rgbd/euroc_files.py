"""Files of the ASL layout: tables of stamped values or images, and the data sheets in `sensor.yaml`."""

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera
from jaxpose.imu import ImuNoise

IMU_COLUMNS = "7 columns (timestamp, 3 rates, 3 accelerations)"


def sensors(path: Path | str) -> Path:
    """The folder of the sensors, whether the sequence or `mav0` itself was named."""
    path = Path(path)
    if not path.is_dir():
        raise DataError(f"{path}: expected a folder in the EuRoC (ASL) layout, got none")
    return path / "mav0" if (path / "mav0").is_dir() else path


def seconds(timestamps: list[int], t0_ns: int) -> Float[np.ndarray, " n"]:
    """Nanoseconds since 1970 need 61 bits, a float has 53: subtract as integers, then convert."""
    return np.array([timestamp - t0_ns for timestamp in timestamps]) * 1e-9


def _read_text(file: Path) -> str:
    if not file.is_file():
        raise DataError(f"{file}: expected a file, got none")
    return file.read_text(encoding="utf-8-sig", errors="replace")


def read_csv(
    file: Path, columns: str, rows: int | None = None
) -> tuple[list[int], Float[np.ndarray, "n c"], list[int]]:
    """Timestamps [ns], other columns and line numbers of the first `rows` rows; errors name `columns`."""
    count = int(columns.split()[0])
    timestamps, values, lines = [], [], []
    for number, line in enumerate(_read_text(file).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(",")
        if len(fields) != count:
            raise DataError(f"{file}:{number}: expected {columns}, got {len(fields)}")
        try:
            timestamp, row = int(fields[0]), [float(field) for field in fields[1:]]
        except ValueError:
            raise DataError(
                f"{file}:{number}: expected a timestamp in ns and numbers, got {line[:60]!r}"
            ) from None
        if not all(map(math.isfinite, row)):
            raise DataError(f"{file}:{number}: expected finite numbers, got {line[:60]!r}")
        if timestamps and timestamp <= timestamps[-1]:
            raise DataError(f"{file}:{number}: expected a timestamp after {timestamps[-1]}, got {timestamp}")
        timestamps.append(timestamp)
        values.append(row)
        lines.append(number)
        if len(timestamps) == rows:
            break
    if not timestamps:
        raise DataError(f"{file}: expected lines of {columns}, got none")
    return timestamps, np.array(values), lines


def read_listing(folder: Path) -> tuple[list[int], list[Path]]:
    """Timestamps [ns] and image files of `data.csv`, lines of timestamp and file name."""
    file = folder / "data.csv"
    timestamps, files = [], []
    for number, line in enumerate(_read_text(file).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        timestamp, _, name = (field.strip() for field in line.partition(","))
        if not (timestamp.isdecimal() and name):
            raise DataError(f"{file}:{number}: expected a timestamp in ns and a file name, got {line[:60]!r}")
        if timestamps and int(timestamp) <= timestamps[-1]:
            raise DataError(f"{file}:{number}: expected a timestamp after {timestamps[-1]}, got {timestamp}")
        timestamps.append(int(timestamp))
        files.append(folder / "data" / name)
    if not timestamps:
        raise DataError(f"{file}: expected lines of a timestamp and a file name, got none")
    return timestamps, files


def read_imu_sheet(file: Path) -> tuple[ImuNoise, Float[np.ndarray, "4 4"]]:
    """Noise densities and the pose of the IMU on the body."""
    text = _read_yaml(file)
    scalar = lambda key: _numbers(file, text, rf"^{key}[ \t]*:(.*)$", key, 1)[0]
    noise = ImuNoise(
        gyro_density=scalar("gyroscope_noise_density"),
        accelerometer_density=scalar("accelerometer_noise_density"),
        gyro_walk=scalar("gyroscope_random_walk"),
        accelerometer_walk=scalar("accelerometer_random_walk"),
    )
    return noise, read_extrinsics(file)


def read_camera_sheet(file: Path) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
    """Intrinsics, lens and the pose of a camera on the body."""
    text = _read_yaml(file)
    model = re.search(r"^distortion_model[ \t]*:[ \t]*(\S*)", text, re.MULTILINE)
    if model is None or model[1] != "radial-tangential":
        got = "no such key" if model is None else repr(model[1])
        raise DataError(f"{file}: expected distortion_model radial-tangential, got {got}")
    row = lambda key, count: _numbers(file, text, rf"^{key}[ \t]*:[^\[\n]*\[([^\]]*)\]", key, count)
    lens, size = row("distortion_coefficients", 4), row("resolution", 2)
    fx, fy, cx, cy = row("intrinsics", 4)
    camera = Camera(fx, fy, cx, cy, int(size[0]), int(size[1]), tuple(lens) if any(lens) else ())
    return camera, read_extrinsics(file)


def _read_yaml(file: Path) -> str:
    """The text without comments: a few keys of a fixed layout do not need a YAML package."""
    return re.sub("#.*", "", _read_text(file))


def read_extrinsics(file: Path) -> Float[np.ndarray, "4 4"]:
    """The pose of the sensor on the body (`T_BS`)."""
    return np.array(_numbers(file, _read_yaml(file), r"^T_BS[ \t]*:[^\[]*\[([^\]]*)\]", "T_BS", 16)).reshape(
        4, 4
    )


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
