"""Files of the ASL layout: tables of stamped values or images, and the data sheets in `sensor.yaml`."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files.camera_json import MOST_PIXELS
from jaxpose.files.schema import choice, numbers, rigid_transforms
from jaxpose.files.tables import StampedRows, read_stamped, read_stamped_names
from jaxpose.files.untrusted import read_yaml
from jaxpose.geometry.camera import Camera
from jaxpose.imu import ImuNoise

_LOUDEST = 1e3  # of noise densities
_BROWN = ("radial-tangential", "radial_tangential", "radtan", "plumb_bob")  # of EuRoC, ASL, Kalibr and ROS
_MOST = 1e9  # [px] and coefficients of distortion
IMU_COLUMNS = "7 columns (timestamp, 3 rates, 3 accelerations)"


def sensors(path: Path | str) -> Path:
    """The folder of the sensors, whether the sequence or `mav0` itself was named."""
    path = Path(path)
    if not path.is_dir():
        raise DataError(f"{path}: expected a folder in the EuRoC (ASL) layout, got none")
    return path / "mav0" if (path / "mav0").is_dir() else path


def existing(file: Path) -> Path:
    """The file itself; DataError where there is none."""
    if not file.is_file():
        raise DataError(f"{file}: expected a file, got none")
    return file


def read_csv(file: Path, columns: str, rows: int | None = None) -> StampedRows:
    """Timestamps, other columns and line numbers of the first `rows` rows; errors name `columns`."""
    count = int(columns.split()[0])
    return read_stamped(existing(file), columns, count, unit="ns", separator=",", rows=rows)


def read_listing(folder: Path) -> tuple[list[int], list[Path]]:
    """Timestamps [ns] and image files of `data.csv`, lines of timestamp and file name."""
    timestamps, names = read_stamped_names(existing(folder / "data.csv"), unit="ns", separator=",")
    return timestamps, [folder / "data" / name for name in names]


def read_imu_sheet(file: Path) -> tuple[ImuNoise, Float[np.ndarray, "4 4"]]:
    """Noise densities and the pose of the IMU on the body."""
    content = _sheet(file)
    scalar = lambda key: float(numbers(file, content, key, least=0, most=_LOUDEST))
    noise = ImuNoise(
        gyro_density=scalar("gyroscope_noise_density"),
        accelerometer_density=scalar("accelerometer_noise_density"),
        gyro_walk=scalar("gyroscope_random_walk"),
        accelerometer_walk=scalar("accelerometer_random_walk"),
    )
    return noise, _extrinsics(file, content)


def read_camera_sheet(file: Path) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
    """Intrinsics, lens and the pose of a camera on the body."""
    content = _sheet(file)
    choice(file, content, "distortion_model", _BROWN)
    lens = numbers(file, content, "distortion_coefficients", (None,), least=-_MOST, most=_MOST).tolist()
    if len(lens) not in (4, 5):
        raise DataError(
            f"{file}: distortion_coefficients: expected k1 k2 p1 p2 [k3], got {len(lens)} numbers"
        )
    width, height = numbers(file, content, "resolution", (2,), whole=True, least=1, most=MOST_PIXELS).tolist()
    fx, fy, cx, cy = numbers(file, content, "intrinsics", (4,), least=-_MOST, most=_MOST).tolist()
    if not (fx > 0 and fy > 0 and 0 <= cx < width and 0 <= cy < height):
        raise DataError(
            f"{file}: intrinsics: expected fx, fy above 0 and cx, cy in {width}x{height}, got "
            f"{fx:g} {fy:g} {cx:g} {cy:g}"
        )
    camera = Camera(fx, fy, cx, cy, width, height, tuple(lens) if any(lens) else ())
    return camera, _extrinsics(file, content)


def read_extrinsics(file: Path) -> Float[np.ndarray, "4 4"]:
    """The pose of the sensor on the body (`T_BS`)."""
    return _extrinsics(file, _sheet(file))


def _sheet(file: Path) -> dict[str, Any]:
    return read_yaml(existing(file), "a data sheet")


def _extrinsics(file: Path, content: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    matrix = content.get("T_BS")  # OpenCV's rows, cols and data
    matrix = matrix.get("data") if isinstance(matrix, dict) else matrix
    if isinstance(matrix, list) and matrix and all(isinstance(row, list) for row in matrix):
        matrix = [entry for row in matrix for entry in row]
    found = {"T_BS": matrix} if "T_BS" in content else {}
    T = numbers(file, found, "T_BS", (16,)).reshape(4, 4)
    rigid_transforms(file, "T_BS", T[None])
    return T
