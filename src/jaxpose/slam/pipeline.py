"""The SLAM loop: predict, track, map, keep keyframes; at the end one field for the whole trajectory."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.fields import PoseField, bspline, control_points_along, fit
from jaxpose.scenes import GridConfig, SceneField
from jaxpose.slam.config import ImuMode, SlamConfig
from jaxpose.slam.initial_pose import first_pose
from jaxpose.slam.keyframes import read_keyframes
from jaxpose.slam.map.texture import make_texture, textured
from jaxpose.slam.map.world import grow_to_fit, initial_grid, map_frame, scene_params, seen_points
from jaxpose.slam.observation import is_blank, to_device
from jaxpose.slam.system import System, make_system
from jaxpose.slam.tracker import next_pose
from jaxpose.slam.tracking.intrinsic_frame import Refit, is_due, window
from jaxpose.slam.tracking.predict import GYRO_BIAS_SIGMA
from jaxpose.slam.types import SlamState, no_frames

__all__ = ["ImuMode", "Progress", "SlamConfig", "SlamResult", "run"]

_DEFAULT = SlamConfig()


class Progress(NamedTuple):
    """One frame done; `truth_error` [m] is the distance to ground truth with the first poses put together."""

    index: int
    count: int
    state: SlamState  # valid until the next frame, which writes over its map
    truth_error: float


class SlamResult(NamedTuple):
    """A tracked recording."""

    T_world_cam: np.ndarray  # (n, 4, 4)
    T_inner: np.ndarray  # (n, 4, 4) the body's motion since the last frame, in the frame `intrinsic`
    lost: np.ndarray  # (n,) bool: tracking failed, the pose is the prediction
    uncertain: np.ndarray  # (n,) bool: lost, unlike the map in colour, from the IMU, or little to hold on to
    mapped: np.ndarray  # (n,) bool: the map was made from it
    iterations: np.ndarray  # (n,)
    loss: np.ndarray  # (n,)
    depth_error: np.ndarray  # (n,) [m] median
    colour_error: np.ndarray  # (n,) median, of colours in [0, 1]
    valid: np.ndarray  # (n,)
    sigma: np.ndarray  # (n, 2) [m, rad] of the pose, by what the image says of it
    seconds: np.ndarray  # (n,) wall time, compilation included
    scene: SceneField
    grid: GridConfig
    scene_params: Any  # (values of the grid's nodes, their paint)
    keyframes: Int[np.ndarray, " k"]  # which frames they are
    field: PoseField  # camera in the world over the whole recording
    field_params: Any
    field_rmse_m: float
    field_rmse_deg: float


def run(
    recording: Recording,
    config: SlamConfig = _DEFAULT,
    on_frame: Callable[[Progress], None] | None = None,
    state: SlamState | None = None,
) -> SlamResult:
    """Track every frame of an RGB-D recording and map what it sees (paper section 3.4, METHOD section 5).

    The world's frame is `first_pose`'s: that of the ground truth, or upright by an accelerometer;
    `gravity_world` is in it. `state` is where an earlier run stood, to go on from there. Raises DataError
    where the recording cannot be tracked: fewer than two frames, no depth in the first, IMU asked for and not
    there.
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


def begin(system: System, size: GridConfig | None = None) -> SlamState:
    """A run before its first frame, its map of a given size or for what that frame sees."""
    recording, config = system.recording, system.config
    frames = no_frames(len(recording.t))
    T_world_cam = first_pose(recording).T_world_cam
    frames.T_world_body[0] = T_world_cam @ np.linalg.inv(recording.T_body_cam)
    if size is None:
        points = seen_points(recording.read(0), recording, T_world_cam)
        if len(points) == 0:
            raise DataError(f"{recording.name}: expected depth in the first frame, found none")
        size = initial_grid(points, config)
    key, field_key = jax.random.split(jax.random.key(config.seed))
    return SlamState(
        0, frames, np.zeros(6), np.zeros(3), np.zeros(3), GYRO_BIAS_SIGMA, np.zeros(3),
        jax.jit(system.framed.field.init)(field_key), key, np.ones(3, np.float32), 0.0, size,
        system.world(size).start(),
    )  # fmt: skip


def step(system: System, state: SlamState, frame: Frame) -> SlamState:
    """The run after one more frame. The map of `state` is written over."""
    recording, config, i = system.recording, system.config, state.done
    generator = np.random.default_rng([config.seed, i])
    key, track_key, map_key = jax.random.split(state.key, 3)
    image = to_device(frame)._replace(exposure=state.exposure)
    if i > 0:
        state = next_pose(system, state, frame, image, generator, track_key)
    if system.refit is not None and is_due(i, len(recording.t)):
        state = _update_intrinsic_frame(system.refit, state, recording.t, i)
    state = state._replace(done=i + 1, key=key)
    T_world_cam = state.frames.T_world_body[i] @ recording.T_body_cam
    points = seen_points(frame, recording, T_world_cam)
    if len(points) == 0 or not _due(system, state, frame):
        return state
    away = np.linalg.norm(points - T_world_cam[:3, 3], axis=1)
    state = state._replace(far=max(state.far, 1.2 * float(np.percentile(away, 99))))
    state = grow_to_fit(points, state)
    image = image._replace(exposure=state.exposure)
    return map_frame(system.world(state.grid), recording, config, state, image, points, generator, map_key)


def _update_intrinsic_frame(refit: Refit, state: SlamState, t: Float[np.ndarray, " n"], i: int) -> SlamState:
    """The state with the intrinsic frame brought to the motions up to frame i."""
    chosen, poses = window(i), state.frames.T_world_body
    motions = np.linalg.inv(poses[chosen - 1]) @ poses[chosen]
    params, T_inner = refit(
        state.params, jnp.asarray(t[chosen] - t[0], jnp.float32), jnp.asarray(motions, jnp.float32)
    )
    return state._replace(params=params, frames=state.frames.put(chosen, T_inner=np.asarray(T_inner)))


def _due(system: System, state: SlamState, frame: Frame) -> bool:
    """Whether the last frame is to be mapped: not where its pose or its colour is in doubt."""
    config, frames, i = system.config, state.frames, state.done - 1
    held_out = config.hold_out > 0 and i % config.hold_out == config.hold_out - 1
    mapped = np.flatnonzero(frames.mapped)
    doubted = frames.lost[i] or frames.appearance_outlier[i]
    if held_out or doubted or not len(mapped):
        return not held_out and not doubted
    unconfirmed = frames.lost[i - 1] and not config.uses_accelerometer
    passed = system.recording.t[i] - system.recording.t[mapped[-1]]
    return bool(not unconfirmed and not is_blank(frame) and passed >= config.map_every_s)


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
    start = control_points_along(t, T_world_cam, intervals)
    fitted = fit(field, t, T_world_cam, params=start, steps=400, learning_rate=1e-3)
    scene, (values,) = system.world(state.grid).scene, scene_params(state.map)
    keyframes = np.flatnonzero(frames.keyframe)
    views = read_keyframes(recording, keyframes, T_world_cam)
    texture = make_texture(state.grid, np.asarray(values[..., 0]), views, recording.camera)
    return SlamResult(
        T_world_cam,
        frames.T_inner,
        lost=frames.lost,
        uncertain=frames.uncertain,
        mapped=frames.mapped,
        iterations=frames.iterations,
        loss=frames.loss,
        depth_error=frames.depth_error,
        colour_error=frames.colour_error,
        valid=frames.valid,
        sigma=frames.sigma,
        seconds=frames.seconds,
        scene=textured(scene, state.grid),
        grid=state.grid,
        scene_params=(values, jax.tree.map(jnp.asarray, texture)),
        keyframes=keyframes,
        field=field,
        field_params=fitted.params,
        field_rmse_m=float(fitted.translation_rmse_m),
        field_rmse_deg=float(fitted.rotation_rmse_deg),
    )
