"""What does not change from frame to frame of a run."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxpose import imu as inertial
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.geometry.camera import angle_of_view
from jaxpose.imu import ResidualSigmas
from jaxpose.scenes import GridConfig
from jaxpose.slam.config import IMU_WEIGHTS, SlamConfig
from jaxpose.slam.keyframes import look
from jaxpose.slam.map.world import World, make_world
from jaxpose.slam.tracking.intrinsic_frame import Refit, make_refit
from jaxpose.slam.tracking.predict import PreintegratedImu, no_imu, preintegrate
from jaxpose.slam.tracking.reference_frames import FramedField, make_field
from jaxpose.slam.tracking.steps import make_field_update

# How well a PoseNet over a few frames follows a hand's motion between them: added to the sensor's own noise.
FIELD_SIGMAS = ResidualSigmas(loose=0.004, tight=0.1, accelerometer=1.0)


class System(NamedTuple):
    """What does not change from frame to frame; `world` compiles for a size of the map."""

    recording: Recording
    config: SlamConfig
    framed: FramedField
    readings: Callable[[int, np.ndarray, np.ndarray, np.ndarray], PreintegratedImu]
    world: Callable[[GridConfig], World]
    look: Callable[[int], np.ndarray]  # of a keyframe (`keyframes.look`)
    refit: Refit | None  # of the frame `intrinsic`


def make_system(recording: Recording, config: SlamConfig) -> System:
    """The compiled parts of a run; checks what can be checked beforehand."""
    readings = _readings(recording, config)
    t = recording.t
    framed = make_field(config.frame, config.field, float(np.median(np.diff(t))), float(t[-1] - t[0]))
    view = angle_of_view(recording.camera)[0]
    field_update = make_field_update(
        framed, config.track, IMU_WEIGHTS[config.imu], _sigmas(recording, config), view
    )
    refit = None if framed.parts is None else make_refit(*framed.parts, view)
    world = lru_cache(maxsize=1)(partial(make_world, recording, config, field_update))
    keyframe_look = lru_cache(None)(lambda i: look(recording.read(i)))
    return System(recording, config, framed, readings, world, keyframe_look, refit)


def _readings(
    recording: Recording, config: SlamConfig
) -> Callable[[int, np.ndarray, np.ndarray, np.ndarray], PreintegratedImu]:
    """The readings after each frame, given the body's pose, its gyro bias and false acceleration then."""
    if len(recording.t) < 2:
        raise DataError(f"{recording.name}: expected at least 2 frames, got {len(recording.t)}")
    if config.imu == "none":
        empty = no_imu()
        return lambda i, T_world_ref, gyro_bias, accelerometer_bias_world: empty
    if recording.imu is None:
        raise DataError(f"{recording.name}: --imu {config.imu} needs inertial readings, and there are none")
    readings, mask = inertial.windows(recording.imu, recording.t)

    def window(i, T_world_ref, gyro_bias, accelerometer_bias_world):
        gravity = jnp.asarray(recording.gravity_world + accelerometer_bias_world, jnp.float32)
        local = inertial.Imu(*(jnp.asarray(x, jnp.float32) for x in (
            readings.t[i] - recording.t[i], readings.omega_body[i] - gyro_bias, readings.acceleration_body[i]
        )))  # fmt: skip
        return preintegrate(
            local, jnp.asarray(mask[i]), jnp.asarray(T_world_ref[:3, :3], jnp.float32), gravity
        )

    return window


def _sigmas(recording: Recording, config: SlamConfig) -> ResidualSigmas:
    """The sensor's noise and the field's own stiffness together."""
    if config.imu == "none" or recording.imu is None:
        return FIELD_SIGMAS
    rate_hz = 1 / float(np.median(np.diff(recording.imu.t)))
    sensor = inertial.residual_sigmas(config.imu_noise, rate_hz, float(np.median(np.diff(recording.t))))
    return ResidualSigmas(*(float(np.hypot(a, b)) for a, b in zip(sensor, FIELD_SIGMAS, strict=True)))
