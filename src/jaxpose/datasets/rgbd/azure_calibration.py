"""The calibration that an Azure Kinect has written into its recordings (`calibration.json`)."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files.matrices import orthonormal
from jaxpose.files.schema import choice, numbers
from jaxpose.files.untrusted import json_object
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

_CAMERAS = {"color": "CALIBRATION_CameraLocationPV0", "depth": "CALIBRATION_CameraLocationD0"}
_SENSORS = ("CALIBRATION_InertialSensorType_Accelerometer", "CALIBRATION_InertialSensorType_Gyro")
_MODEL = "CALIBRATION_LensDistortionModelBrownConrady"
_OLDER = "CALIBRATION_LensDistortionModelRational6KT"  # the same where nothing is tangential
# Of depth's modes, by the size of their images: how large the sensor's grid is, and where they begin in it.
_DEPTH_MODES = {
    (320, 288): ((512, 512), (96, 90)),
    (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}
_COLOR_SHAPES = (4 / 3, 16 / 9)  # of its modes, which are all of the sensor's 4:3, or its middle


class Lens(NamedTuple):
    """A camera and what it takes to undo its lens."""

    camera: Camera  # without distortion
    coefficients: Float[np.ndarray, "8"]  # OpenCV's k1 k2 p1 p2 k3 k4 k5 k6


class Calibration(NamedTuple):
    """The cameras of a recording, and how they and the IMU belong together."""

    color: Lens
    depth: Lens
    T_color_depth: Float[np.ndarray, "4 4"]
    T_accelerometer_color: Float[np.ndarray, "4 4"] | None  # None: without an IMU
    R_accelerometer_gyro: Float[np.ndarray, "3 3"]


def read_calibration(file: Path, text: bytes, color: tuple[int, int], depth: tuple[int, int]) -> Calibration:
    """Read a calibration.

    Args:
        file: The recording, for errors.
        text: The JSON attached to it.
        color: Width and height of its colour images.
        depth: Likewise of depth, which say the mode.

    Returns:
        The calibration in metres, for images of these sizes.

    Raises:
        DataError: Naming the file and the entry for what cannot be used.
    """
    where = f"{file}: calibration.json"
    content = json_object(text.rstrip(b"\0"), where, "a calibration").get("CalibrationInformation")
    if not isinstance(content, dict):
        raise DataError(f"{where}: expected CalibrationInformation, got none")
    cameras = {name: _entry(where, content, "Cameras", "Location", at) for name, at in _CAMERAS.items()}
    for name, entry in cameras.items():
        if entry is None:
            raise DataError(f"{where}: expected a camera {_CAMERAS[name]}, got none")
    if depth not in _DEPTH_MODES:
        known = ", ".join(f"{w}x{h}" for w, h in _DEPTH_MODES)
        raise DataError(f"{file}: expected depth of {known}, got {depth[0]}x{depth[1]}")
    width, height = color
    if not any(abs(width / height / shape - 1) < 1e-2 for shape in _COLOR_SHAPES):
        raise DataError(f"{file}: expected colour of 4:3 or 16:9, got {width}x{height}")
    of_color, of_depth = cameras["color"], cameras["depth"]
    grid = (width, width * 3 / 4)
    T_color, T_depth = _pose(where, of_color), _pose(where, of_depth)
    sensors = [_entry(where, content, "InertialSensors", "SensorType", kind) for kind in _SENSORS]
    T_force, turn = None, np.eye(3)
    if all(sensor is not None for sensor in sensors):
        T_force, T_gyro = (_pose(where, sensor) for sensor in sensors)
        turn = (T_force @ rigid.inverse(T_gyro))[:3, :3]
    return Calibration(
        _lens(where, of_color, grid, (0.0, (grid[1] - height) / 2), color),
        _lens(where, of_depth, *_DEPTH_MODES[depth], depth),
        T_color @ rigid.inverse(T_depth),
        None if T_force is None else T_force @ rigid.inverse(T_color),
        turn,
    )


def _entry(where: str, content: dict[str, Any], key: str, name: str, wanted: str) -> dict[str, Any] | None:
    """The entry of a list that has a certain name."""
    entries = content.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{where}: {key}: expected a list of objects, got {str(entries)[:60]}")
    return next((entry for entry in entries if entry.get(name) == wanted), None)


def _pose(where: str, entry: Any) -> Float[np.ndarray, "4 4"]:
    """T_sensor_device; rotations are row by row."""
    stated = entry.get("Rt")
    if not isinstance(stated, dict):
        raise DataError(f"{where}: Rt: expected Rotation and Translation, got {str(stated)[:60]}")
    T = rigid.make(
        numbers(where, stated, "Rotation", (9,)).reshape(3, 3), numbers(where, stated, "Translation", (3,))
    )
    return orthonormal(T[None], lambda _: f"{where}: Rt")[0]


def _lens(
    where: str,
    entry: Any,
    grid: tuple[int | float, int | float],
    crop: tuple[int | float, int | float],
    size: tuple[int, int],
) -> Lens:
    """A camera's intrinsics, stated in shares of the sensor's grid, for images that are a part of it."""
    stated = entry.get("Intrinsics")
    if not isinstance(stated, dict):
        raise DataError(f"{where}: Intrinsics: expected an object, got {str(stated)[:60]}")
    model = choice(where, stated, "ModelType", (_MODEL, _OLDER))
    parameters = numbers(where, stated, "ModelParameters", (None,)).tolist()
    if len(parameters) < 14:
        raise DataError(f"{where}: ModelParameters: expected 14 numbers, got {len(parameters)}")
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = parameters[:14]
    if codx or cody or (model == _OLDER and (p1 or p2)):
        raise DataError(f"{where}: expected a lens of {_MODEL} with its centre of distortion 0, got {model}")
    columns, rows = (
        int(numbers(where, entry, f"Sensor{side}", whole=True, least=1)) for side in ("Width", "Height")
    )
    if columns * 9 == rows * 16:
        fy, cy = fy * 3 / 4, (cy * 2304 + 384) / 3072  # of first devices: shares of the middle 16:9
    camera = Camera(
        fx * grid[0], fy * grid[1], cx * grid[0] - crop[0] - 0.5, cy * grid[1] - crop[1] - 0.5, *size
    )
    if not (camera.fx > 0 and camera.fy > 0):
        raise DataError(f"{where}: expected positive focal lengths, got {camera.fx:g} and {camera.fy:g}")
    return Lens(camera, np.array([k1, k2, p1, p2, k3, k4, k5, k6]))
