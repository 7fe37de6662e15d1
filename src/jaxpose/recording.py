"""What a loader returns: a camera recording with depth, images read lazily."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxpose.camera import Camera
from jaxpose.imu import Imu


class Frame(NamedTuple):
    """One image pair; depth is along the optical axis [m], 0 where there is none."""

    rgb: np.ndarray  # (height, width, 3) uint8
    depth: np.ndarray  # (height, width) float32


class Recording(NamedTuple):
    """A sequence of RGB-D frames with what is known beside them; all poses float64, camera axes OpenCV."""

    name: str
    camera: Camera
    t: np.ndarray  # (n,) seconds since the first frame
    read: Callable[[int], Frame]
    T_world_cam: np.ndarray | None = None  # (n, 4, 4) truth, rows of NaN where it is missing
    imu: Imu | None = None  # on the clock of `t`
    T_body_cam: np.ndarray = np.eye(4)  # body = IMU
    gravity_world: np.ndarray = np.array([0.0, 0.0, -9.80665])  # in the frame of `T_world_cam`
    notes: tuple[str, ...] = ()  # what the loader has to tell the user


def select(recording: Recording, indices: np.ndarray) -> Recording:
    """The recording reduced to some of its frames; the clock (and so the IMU) stays as it is."""
    poses = recording.T_world_cam
    return recording._replace(
        t=recording.t[indices],
        read=lambda i: recording.read(int(indices[i])),
        T_world_cam=None if poses is None else poses[indices],
    )


def thin(recording: Recording, rate_hz: float) -> Recording:
    """Keep frames so that their rate is at most `rate_hz`, the first of each period."""
    period = np.floor((recording.t - recording.t[0]) * rate_hz + 1e-6).astype(int)
    return select(recording, np.flatnonzero(np.diff(period, prepend=-1) > 0))
