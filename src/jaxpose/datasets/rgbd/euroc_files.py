"""Files of the ASL layout: tables of stamped values or images, and the data sheets in `sensor.yaml`."""

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files.tables import StampedRows, read_stamped, read_stamped_names
from jaxpose.geometry.camera import Camera
from jaxpose.imu import ImuNoise

IMU_COLUMNS = "7 columns (timestamp, 3 rates, 3 accelerations)"


def sensors(path: Path | str) -> Path:
    """The folder of the sensors, whether the sequence or `mav0` itself was named."""
    path = Path(path)
    if not path.is_dir():
        raise DataError(f"{path}: expected a folder in the EuRoC (ASL) layout, got none")
    return path / "mav0" if (path / "mav0").is_dir() else path


def _existing(file: Path) -> Path:
    if not file.is_file():
        raise DataError(f"{file}: expected a file, got none")
    return file


def read_csv(file: Path, columns: str, rows: int | None = None) -> StampedRows:
    """Timestamps, other columns and line numbers of the first `rows` rows; errors name `columns`."""
    count = int(columns.split()[0])
    return read_stamped(_existing(file), columns, count, unit="ns", separator=",", rows=rows)


def read_listing(folder: Path) -> tuple[list[int], list[Path]]:
    """Timestamps [ns] and image files of `data.csv`, lines of timestamp and file name."""
    timestamps, names = read_stamped_names(_existing(folder / "data.csv"), unit="ns", separator=",")
    return timestamps, [folder / "data" / name for name in names]


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
    return re.sub("#.*", "", _existing(file).read_text(encoding="utf-8-sig", errors="replace"))


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
