"""Readings of an inertial measurement unit and their noise."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jaxpose._checks import check_shapes

AnyArray = Array | np.ndarray  # recordings are numpy float64, training is jax

GRAVITY_WORLD = (0.0, 0.0, -9.80665)  # [m/s^2]

Gravity = tuple[float, float, float] | Float[AnyArray, "3"]


class Imu(NamedTuple):
    """Readings of a gyroscope and an accelerometer.

    Attributes:
        t: Timestamps (n,) [s], increasing.
        omega_body: Body rates (n, 3) [rad/s].
        acceleration_body: Specific forces (n, 3) [m/s^2], R_world_body^T (a_world - g_world): 9.81 m/s^2
            upwards at rest.
    """

    t: Float[AnyArray, "*n"]
    omega_body: Float[AnyArray, "*n 3"]
    acceleration_body: Float[AnyArray, "*n 3"]


class ImuNoise(NamedTuple):
    """A data sheet: densities of white noise, and those of the random walk of the biases."""

    gyro_density: float  # rad/s/sqrt(Hz)
    accelerometer_density: float  # m/s^2/sqrt(Hz)
    gyro_walk: float  # rad/s^2/sqrt(Hz)
    accelerometer_walk: float  # m/s^3/sqrt(Hz)


QUIET = ImuNoise(0.0, 0.0, 0.0, 0.0)


ADIS16448 = ImuNoise(1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3)  # the sensor of EuRoC, as its sensor.yaml has it


def check_readings(imu: Imu) -> None:
    """ValueError naming the column of readings that has another shape."""
    check_shapes(
        **{
            "imu.t": (imu.t, "n"),
            "imu.omega_body": (imu.omega_body, "n 3"),
            "imu.acceleration_body": (imu.acceleration_body, "n 3"),
        }
    )
