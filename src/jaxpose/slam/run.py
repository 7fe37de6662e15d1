"""The SLAM loop: predict, track, map, keep keyframes; at the end one field for the whole trajectory."""

import time
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from jaxpose import imu as inertial
from jaxpose import se3
from jaxpose.errors import DataError
from jaxpose.fields import PoseField, bspline, control_points, fit, stamped
from jaxpose.imu import ResidualSigmas
from jaxpose.metrics import nearest_rotation
from jaxpose.recording import Frame, Recording
from jaxpose.scenes import GridConfig, SceneField
from jaxpose.slam.config import IMU_WEIGHTS, ImuMode, SlamConfig
from jaxpose.slam.frames import Framed, gauge, make_field
from jaxpose.slam.observe import Image
from jaxpose.slam.predict import (
    BEHIND,
    Interval,
    Readings,
    end_velocity,
    integrate,
    no_readings,
    observe_acceleration,
    predict,
    prediction_sigma,
)
from jaxpose.slam.state import SlamState, no_frames
from jaxpose.slam.track import Tracked, make_settle
from jaxpose.slam.world import World, first_grid, make_world, map_frame, room_for, scene_params, seen_points

__all__ = ["ImuMode", "Progress", "SlamConfig", "SlamResult", "run"]

# How well a PoseNet over a few frames follows a hand's motion between them: added to the sensor's own noise.
FIELD_SIGMAS = ResidualSigmas(loose=0.004, tight=0.1, accelerometer=1.0)


_DEFAULT = SlamConfig()


class Progress(NamedTuple):
    """One frame done; `truth_error` [m] is the distance to the truth with the first poses put together."""

    index: int
    count: int
    state: SlamState  # valid until the next frame, which writes over its map
    truth_error: float


class SlamResult(NamedTuple):
    """A tracked recording."""

    T_world_cam: np.ndarray  # (n, 4, 4)
    lost: np.ndarray  # (n,) bool: tracking failed, the pose is the prediction
    mapped: np.ndarray  # (n,) bool: the map was made from it
    iterations: np.ndarray  # (n,)
    loss: np.ndarray  # (n,)
    depth_error: np.ndarray  # (n,) [m] median
    valid: np.ndarray  # (n,)
    seconds: np.ndarray  # (n,) wall time, compilation included
    scene: SceneField
    grid: GridConfig
    scene_params: Any
    keyframes: Int[np.ndarray, " k"]  # which frames they are
    field: PoseField  # camera in the world over the whole recording
    field_params: Any
    field_rmse_m: float
    field_rmse_deg: float


class System(NamedTuple):
    """What does not change from frame to frame; `world` compiles for a size of the map."""

    recording: Recording
    config: SlamConfig
    framed: Framed
    readings: Callable[[int, np.ndarray, np.ndarray], Readings]
    world: Callable[[GridConfig], World]


def run(
    recording: Recording,
    config: SlamConfig = _DEFAULT,
    on_frame: Callable[[Progress], None] | None = None,
    state: SlamState | None = None,
) -> SlamResult:
    """Track every frame of an RGB-D recording and map what it sees (paper section 3.4, METHOD section 5).

    The world's frame is that of the truth where its first pose is known (as in NICE-SLAM), else the first
    camera's; `gravity_world` must be in that frame. `state` is where an earlier run stood, to go on from
    there. Raises DataError where the recording cannot be tracked: fewer than two frames, no depth in the
    first, IMU asked for and not there.
    """
    system = make_system(recording, config)
    state = begin(system) if state is None else state
    for i in range(state.done, len(recording.t)):
        started = time.perf_counter()
        state = step(system, state, recording.read(i))
        jax.block_until_ready(state.map)
        state = state._replace(frames=state.frames.put(i, seconds=time.perf_counter() - started))
        if on_frame is not None:
            on_frame(Progress(i, len(recording.t), state, _truth_error(recording, state)))
    return _finish(system, state)


def make_system(recording: Recording, config: SlamConfig) -> System:
    """The compiled parts of a run; checks what can be checked beforehand."""
    readings = _readings(recording, config)
    t = recording.t
    framed = make_field(config.frame, config.field, float(np.median(np.diff(t))), float(t[-1] - t[0]))
    settle = make_settle(framed, config.track, IMU_WEIGHTS[config.imu], _sigmas(recording, config))
    world = lru_cache(maxsize=1)(partial(make_world, recording, config, settle))
    return System(recording, config, framed, readings, world)


def begin(system: System, size: GridConfig | None = None) -> SlamState:
    """A run before its first frame, its map of a given size or for what that frame sees."""
    recording, config = system.recording, system.config
    frames = no_frames(len(recording.t))
    T_world_cam = _first_pose(recording)
    frames.T_world_body[0] = T_world_cam @ np.linalg.inv(recording.T_body_cam)
    if size is None:
        points = seen_points(recording.read(0), recording, T_world_cam)
        if len(points) == 0:
            raise DataError(f"{recording.name}: expected depth in the first frame, found none")
        size = first_grid(points, config)
    key, field_key = jax.random.split(jax.random.key(config.seed))
    return SlamState(
        0, frames, np.zeros(6), np.zeros(3), np.zeros(3),
        system.framed.field.init(field_key), key, 0.0, size, system.world(size).start(),
    )  # fmt: skip


def step(system: System, state: SlamState, frame: Frame) -> SlamState:
    """The run after one more frame. The map of `state` is written over."""
    recording, config, i = system.recording, system.config, state.done
    generator = np.random.default_rng([config.seed, i])
    key, track_key, map_key = jax.random.split(state.key, 3)
    image = Image(jnp.asarray(frame.rgb), jnp.asarray(frame.depth, jnp.float32))
    if i > 0:
        state = _tracked(system, state, image, generator, track_key)
    state = state._replace(done=i + 1, key=key)
    T_world_cam = state.frames.T_world_body[i] @ recording.T_body_cam
    points = seen_points(frame, recording, T_world_cam)
    if state.frames.lost[i] or len(points) == 0 or not _due(system, state):
        return state
    away = np.linalg.norm(points - T_world_cam[:3, 3], axis=1)
    state = state._replace(far=max(state.far, 1.2 * float(np.percentile(away, 99))))
    state = room_for(points, state)
    return map_frame(system.world(state.grid), recording, config, state, image, points, generator, map_key)


def _tracked(
    system: System, state: SlamState, image: Image, generator: np.random.Generator, key: PRNGKeyArray
) -> SlamState:
    """The state with the next frame's pose."""
    (recording, config), i, frames = system[:2], state.done, state.frames
    t, T_world_ref = recording.t, frames.T_world_body[i - 1]
    dt = float(t[i] - t[i - 1])
    readings = system.readings(i - 1, T_world_ref, state.false_acceleration)
    interval, predicted = _interval(system, state, dt, readings)
    where = gauge(config.frame, float(t[i - 1] - t[0]), T_world_ref, frames.T_world_body[0], generator)
    tracked = system.world(state.grid).track(
        scene_params(state.map), state.params, jnp.asarray(T_world_ref, jnp.float32), where, interval, image,
        jnp.float32(state.far), key,
    )  # fmt: skip
    tracked = jax.device_get(tracked)
    lost = _failed(tracked, frames.loss[1:i][~frames.lost[1:i]], config)
    T_ref_body = predicted if lost else np.asarray(tracked.T_ref_body, np.float64)
    T_world_body = T_world_ref @ T_ref_body
    T_world_body[:3, :3] = nearest_rotation(T_world_body[:3, :3])  # float32 adds up
    false_acceleration = state.false_acceleration
    if i > 1 and not lost and config.senses_speed:  # the first speed is not known
        error = T_world_ref[:3, :3] @ (T_ref_body[:3, 3] - predicted[:3, 3])
        false_acceleration = observe_acceleration(false_acceleration, dt, error)
    return state._replace(
        frames=frames.put(
            i,
            T_world_body=T_world_body,
            lost=lost,
            iterations=tracked.iterations,
            loss=tracked.loss,
            depth_error=tracked.depth_error,
            valid=tracked.valid,
        ),
        twist=np.asarray(se3.log(jnp.asarray(T_ref_body, jnp.float32)), np.float64) / dt,
        velocity_body=end_velocity(dt, T_ref_body, readings, speed=config.senses_speed),
        false_acceleration=false_acceleration,
        params=tracked.params,
    )


def _interval(
    system: System, state: SlamState, dt: float, readings: Readings
) -> tuple[Interval, Float[np.ndarray, "4 4"]]:
    """What tracking the next frame starts from, and the predicted motion of the whole interval."""
    last, t, T_world_body = state.done - 1, system.recording.t, state.frames.T_world_body
    senses = {"rotation": system.config.senses_rotation, "speed": system.config.senses_speed}
    stamps, poses = predict(dt, state.twist, state.velocity_body, readings, **senses)
    # Without two frames the speed is not known, and the accelerometer only changes it.
    senses["speed"] &= last > 0
    behind = [max(last - k, 0) for k in range(BEHIND + 1)]  # the last frame itself, and those before
    past = np.linalg.inv(T_world_body[last]) @ T_world_body[behind]
    sigma = prediction_sigma(dt, poses[-1], **senses)
    if last == 0:
        sigma = sigma + [0.3 * dt, 0.0 if senses["rotation"] else 0.3 * dt]  # as fast as a hand may move
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    return Interval(
        as_float(dt),
        as_float(np.concatenate([stamps, t[behind] - t[last]])),
        as_float(np.concatenate([poses, past])),
        as_float(sigma),
        readings,
    ), poses[-1]


def _failed(tracked: Tracked, losses: Float[np.ndarray, " k"], config: SlamConfig) -> bool:
    """Whether tracking went wrong: too little of the image explained, or far worse than it usually is."""
    usual = float(np.median(losses[-30:])) if len(losses) else np.inf
    explained = np.isfinite(tracked.loss) and tracked.valid >= config.track.minimum_valid
    return not (explained and tracked.loss < 2 * usual)


def _due(system: System, state: SlamState) -> bool:
    """Whether the last frame is to be mapped."""
    config, t, i = system.config, system.recording.t, state.done - 1
    held_out = config.hold_out > 0 and i % config.hold_out == config.hold_out - 1
    mapped = np.flatnonzero(state.frames.mapped)
    return not held_out and (len(mapped) == 0 or t[i] - t[mapped[-1]] >= config.map_every_s)


def _readings(recording: Recording, config: SlamConfig) -> Callable[[int, np.ndarray, np.ndarray], Readings]:
    """The readings after each frame, given the body's pose and the false acceleration [m/s^2] then."""
    if len(recording.t) < 2:
        raise DataError(f"{recording.name}: expected at least 2 frames, got {len(recording.t)}")
    if config.imu == "none":
        empty = no_readings()
        return lambda i, T_world_ref, offset: empty
    if recording.imu is None:
        raise DataError(f"{recording.name}: --imu {config.imu} needs inertial readings, and there are none")
    readings, mask = inertial.windows(recording.imu, recording.t)

    def window(i, T_world_ref, offset):
        gravity = jnp.asarray(recording.gravity_world + offset, jnp.float32)
        local = inertial.Imu(*(jnp.asarray(x, jnp.float32) for x in (
            readings.t[i] - recording.t[i], readings.omega_body[i], readings.acceleration_body[i]
        )))  # fmt: skip
        return integrate(local, jnp.asarray(mask[i]), jnp.asarray(T_world_ref[:3, :3], jnp.float32), gravity)

    return window


def _first_pose(recording: Recording) -> Float[np.ndarray, "4 4"]:
    if recording.T_world_cam is not None and np.isfinite(recording.T_world_cam[0]).all():
        return np.array(recording.T_world_cam[0], np.float64)
    return np.eye(4)


def _sigmas(recording: Recording, config: SlamConfig) -> ResidualSigmas:
    """The sensor's noise and the field's own stiffness together."""
    if config.imu == "none" or recording.imu is None:
        return FIELD_SIGMAS
    rate_hz = 1 / float(np.median(np.diff(recording.imu.t)))
    sensor = inertial.residual_sigmas(config.imu_noise, rate_hz, float(np.median(np.diff(recording.t))))
    return ResidualSigmas(*(float(np.hypot(a, b)) for a, b in zip(sensor, FIELD_SIGMAS, strict=True)))


def _truth_error(recording: Recording, state: SlamState) -> float:
    if recording.T_world_cam is None:
        return float("nan")
    i = state.done - 1
    estimate = state.frames.T_world_body[i] @ recording.T_body_cam
    return float(np.linalg.norm(recording.T_world_cam[i, :3, 3] - estimate[:3, 3]))


def _finish(system: System, state: SlamState) -> SlamResult:
    """One field fitted to all poses, and everything that was recorded on the way.

    A B-spline with a knot a frame: a PoseNet over the same 12 s of the default room stayed 1.5 cm from the
    poses, and where the camera had turned once around it took the other way.
    """
    recording, frames = system.recording, state.frames
    T_world_cam = frames.T_world_body @ recording.T_body_cam
    t = recording.t - recording.t[0]
    span = (0.0, float(t[-1]))
    intervals = max(round(t[-1] / float(np.median(np.diff(t)))), 1)
    field = bspline(span, intervals)
    knots = (np.arange(intervals + 3) - 1) * (t[-1] / intervals)
    between = jax.vmap(stamped(jnp.asarray(t, jnp.float32), jnp.asarray(T_world_cam, jnp.float32)))
    start = control_points(between(jnp.asarray(knots, jnp.float32)))
    fitted = fit(field, t, T_world_cam, params=start, steps=400, learning_rate=1e-3)
    return SlamResult(
        T_world_cam,
        lost=frames.lost,
        mapped=frames.mapped,
        iterations=frames.iterations,
        loss=frames.loss,
        depth_error=frames.depth_error,
        valid=frames.valid,
        seconds=frames.seconds,
        scene=system.world(state.grid).scene,
        grid=state.grid,
        scene_params=scene_params(state.map),
        keyframes=np.flatnonzero(frames.keyframe),
        field=field,
        field_params=fitted.params,
        field_rmse_m=float(fitted.translation_rmse_m),
        field_rmse_deg=float(fitted.rotation_rmse_deg),
    )
