"""Readings of an inertial measurement unit and their noise."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

AnyArray = Array | np.ndarray  # recordings are numpy float64, training is jax


GRAVITY_WORLD = (0.0, 0.0, -9.80665)


Gravity = tuple[float, float, float] | Float[AnyArray, "3"]


class Imu(NamedTuple):
    """Readings: time [s], body rate [rad/s] and specific force R_world_body^T (a_world - g_world) [m/s^2]."""

    t: Float[AnyArray, "*n"]
    omega_body: Float[AnyArray, "*n 3"]
    acceleration_body: Float[AnyArray, "*n 3"]


class ImuNoise(NamedTuple):
    """A data sheet: white noise densities, and those of the random walk of the biases."""

    gyro_density: float  # rad/s/sqrt(Hz)
    accelerometer_density: float  # m/s^2/sqrt(Hz)
    gyro_walk: float  # rad/s^2/sqrt(Hz)
    accelerometer_walk: float  # m/s^3/sqrt(Hz)


QUIET = ImuNoise(0.0, 0.0, 0.0, 0.0)


ADIS16448 = ImuNoise(1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3)  # the sensor of EuRoC, as its sensor.yaml has it
