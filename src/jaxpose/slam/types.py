"""All that a run goes on from between two frames: what is saved is what is needed."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from jaxpose.fields import Params
from jaxpose.scenes import GridConfig
from jaxpose.slam.map.photometric import MapState


class Frames(NamedTuple):
    """What is known of every frame of a recording, one row a frame; of those to come NaN, False or 0."""

    T_world_body: Float[np.ndarray, "n 4 4"]
    T_inner: Float[np.ndarray, "n 4 4"]  # motion since the last frame, in the frame `intrinsic`
    lost: Bool[np.ndarray, " n"]  # tracking failed, the pose is the prediction
    appearance_outlier: Bool[np.ndarray, " n"]  # surfaces fit, but colours far worse than usual
    uncertain: Bool[np.ndarray, " n"]  # lost, unlike, reckoned from the IMU, or little to hold on to
    mapped: Bool[np.ndarray, " n"]  # the map was made from it
    keyframe: Bool[np.ndarray, " n"]
    iterations: Int[np.ndarray, " n"]
    loss: Float[np.ndarray, " n"]
    depth_error: Float[np.ndarray, " n"]  # [m] median
    colour_error: Float[np.ndarray, " n"]  # median, of colours in [0, 1]
    valid: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, "n 2"]  # [m, rad] of the pose, by what the image says of it
    seconds: Float[np.ndarray, " n"]  # wall time, compilation included

    def put(self, i: int | Int[np.ndarray, " k"], **values) -> "Frames":
        """The same with other values at a frame, or at some."""
        changed = {name: getattr(self, name).copy() for name in values}
        for name, value in values.items():
            changed[name][i] = value
        return self._replace(**changed)


class SlamState(NamedTuple):
    """A run after `done` frames: a pytree of arrays, but for `grid`, which says how large `map` is."""

    done: int
    frames: Frames
    twist: Float[np.ndarray, "6"]  # of the body over the last interval, per second
    velocity_body: Float[np.ndarray, "3"]  # [m/s] at the last frame
    gyro_bias: Float[np.ndarray, "3"]  # [rad/s] in the body (`predict.observe_gyro_bias`)
    gyro_bias_sigma: float
    accelerometer_bias_world: Float[np.ndarray, "3"]  # [m/s^2] in the world (`predict.observe_acceleration`)
    params: Params  # of the tracked field
    key: PRNGKeyArray
    exposure: Float[np.ndarray, "3"]  # of the last image that was tracked (`observe.Image`)
    far: float  # [m] how deep the map is
    grid: GridConfig
    map: MapState


def no_frames(count: int) -> Frames:
    """Frames of which nothing is known yet."""
    unknown, no = np.full(count, np.nan), np.zeros(count, bool)
    return Frames(
        T_world_body=np.full((count, 4, 4), np.nan),
        T_inner=np.full((count, 4, 4), np.nan),
        lost=no,
        appearance_outlier=no,
        uncertain=no,
        mapped=no,
        keyframe=no,
        iterations=np.zeros(count, int),
        loss=unknown,
        depth_error=unknown,
        colour_error=unknown,
        valid=unknown,
        sigma=np.full((count, 2), np.nan),
        seconds=unknown,
    )
