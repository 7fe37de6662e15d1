"""What `jaxpose fit` finds of each field."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.evaluation.trajectory_error import Statistics

FEWEST = 20  # poses, inertial readings


class Inertial(NamedTuple):
    """How far a field's derivatives are from readings, after constant biases and gravity are fitted."""

    omega_rms: float  # rad/s, per axis
    acceleration_rms: float  # m/s^2, per axis
    gyro_bias: Float[np.ndarray, "3"]
    gravity_world: Float[np.ndarray, "3"]  # m/s^2, in the trajectory's world
    samples: int


class Fitted(NamedTuple):
    """A field and what is left of the poses that it has not seen."""

    name: str
    highest_hz: float
    parameters: int
    seconds: float
    translation_m: Statistics
    rotation_deg: Statistics
    inertial: Inertial | None


class Sensor(NamedTuple):
    """What an IMU's readings are worth, one sigma a reading: by its data sheet, and by themselves."""

    readings: int
    rate_hz: float
    stated: tuple[float, float]  # rad/s, m/s^2
    measured: tuple[float, float]  # RMS of second differences / sqrt 6: sensor and vibration
