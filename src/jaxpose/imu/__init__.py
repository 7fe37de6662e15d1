"""Inertial sensors: types and noise, integration, residuals on a pose function, simulation, filtering."""

from jaxpose.imu.preintegration import integrate_gyro as integrate_gyro
from jaxpose.imu.preintegration import remove_gravity as remove_gravity
from jaxpose.imu.residuals import ImuResiduals as ImuResiduals
from jaxpose.imu.residuals import ResidualSigmas as ResidualSigmas
from jaxpose.imu.residuals import accelerometer_residual as accelerometer_residual
from jaxpose.imu.residuals import gyro_loose_residual as gyro_loose_residual
from jaxpose.imu.residuals import gyro_tight_residual as gyro_tight_residual
from jaxpose.imu.residuals import imu_residuals as imu_residuals
from jaxpose.imu.residuals import residual_sigmas as residual_sigmas
from jaxpose.imu.residuals import windows as windows
from jaxpose.imu.types import ADIS16448 as ADIS16448
from jaxpose.imu.types import GRAVITY_WORLD as GRAVITY_WORLD
from jaxpose.imu.types import QUIET as QUIET
from jaxpose.imu.types import AnyArray as AnyArray
from jaxpose.imu.types import Gravity as Gravity
from jaxpose.imu.types import Imu as Imu
from jaxpose.imu.types import ImuNoise as ImuNoise
