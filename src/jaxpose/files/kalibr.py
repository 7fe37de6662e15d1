"""Kalibr's `camchain-imucam`: where a camera is on an IMU, and how far their clocks are apart."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files import atomic
from jaxpose.files.schema import numbers
from jaxpose.files.texts import read_text
from jaxpose.files.untrusted import read_yaml
from jaxpose.geometry import rigid

_MOST_S = 1e6  # [s] between two clocks


class CameraImu(NamedTuple):
    """A camera's place on an IMU and in its time."""

    T_body_cam: Float[np.ndarray, "4 4"]
    offset_s: float  # t_imu = t_cam + offset


def write_camchain(path: Path | str, found: CameraImu) -> None:
    """Write the two keys of `cam0` that say how a camera and an IMU go together.

    Args:
        path: of the file.
        found: mounting and time offset.
    """
    rows = [", ".join(f"{x:.12g}" for x in row) for row in rigid.inverse(found.T_body_cam)]
    lines = ["cam0:", "  T_cam_imu:", *(f"  - [{row}]" for row in rows)]
    lines.append(f"  timeshift_cam_imu: {found.offset_s:.12g}")
    atomic.write_text(path, "\n".join(lines) + "\n")


def is_camchain(path: Path | str) -> bool:
    """Whether a file names `T_cam_imu`."""
    return "T_cam_imu" in read_text(Path(path))


def read_camchain(path: Path | str) -> CameraImu:
    """Read the first camera of a `camchain-imucam` file.

    Args:
        path: of the file.

    Returns:
        Mounting and time offset, 0 where the file has none.

    Raises:
        DataError: no rigid `T_cam_imu` in it, or an offset that is no number.
    """
    content = read_yaml(path, "a camchain").get("cam0")
    T = numbers(path, content, "T_cam_imu", (4, 4))
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6 or not rigid.is_rotation(T[:3, :3], 1e-3):
        raise DataError(f"{path}: expected T_cam_imu to be a rigid transform, got {T.round(4).tolist()}")
    T[:3, :3] = rigid.nearest_rotation(T[:3, :3])
    offset = 0.0
    if content and "timeshift_cam_imu" in content:
        offset = float(numbers(path, content, "timeshift_cam_imu", least=-_MOST_S, most=_MOST_S))
    return CameraImu(rigid.inverse(T), offset)
