"""The SLAM loop: predict, track, map, keep keyframes; at the end one field for the whole trajectory."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpose import imu as inertial
from jaxpose import se3
from jaxpose.errors import DataError
from jaxpose.fields import PoseField, PoseNetConfig, bspline, control_points, fit, stamped
from jaxpose.imu import ADIS16448, ImuNoise, ResidualSigmas
from jaxpose.metrics import nearest_rotation
from jaxpose.recording import Frame, Recording
from jaxpose.scenes import GridConfig, SceneField, box, grid, grow, merge
from jaxpose.slam.frames import FrameName, gauge, make_field
from jaxpose.slam.keyframes import Keyframe, choose, overlap
from jaxpose.slam.mapping import MapConfig, MapState, look_up, make_descend, make_fuse
from jaxpose.slam.objective import ImuWeights, TrackConfig
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
)  # fmt: skip
from jaxpose.slam.track import Tracked, make_settle, make_track

ImuMode = Literal["none", "loose", "tight", "accelerometer", "combined"]

IMU_WEIGHTS: dict[ImuMode, ImuWeights] = {
    "none": ImuWeights(),
    "loose": ImuWeights(loose=1.0),
    "tight": ImuWeights(tight=1.0),
    "accelerometer": ImuWeights(accelerometer=1.0),
    "combined": ImuWeights(loose=1.0, tight=1.0, accelerometer=1.0),
}

_USES_SPEED = ("accelerometer", "combined")

# How well a PoseNet over a few frames follows a hand's motion between them: added to the sensor's own noise.
FIELD_SIGMAS = ResidualSigmas(loose=0.004, tight=0.1, accelerometer=1.0)


@dataclass(frozen=True)
class SlamConfig:
    """Settings of a run; every random choice follows from `seed`."""

    imu: ImuMode = "none"
    frame: FrameName = "anchored"
    seed: int = 0
    field: PoseNetConfig = PoseNetConfig(layers=4, width=128, activation="softplus")
    track: TrackConfig = TrackConfig()
    map: MapConfig = MapConfig()
    map_every_s: float = 0.15  # [s] between mapping steps
    voxel: float | None = None  # [m]; None: from the size of the room
    hold_out: int = 0  # every n-th frame is tracked but never mapped, to measure the map on; 0: none
    keyframe_overlap: float = 0.9  # a frame that shares less with every keyframe becomes one
    imu_noise: ImuNoise = ADIS16448

    def __post_init__(self):
        positive = {
            "track.pixels": self.track.pixels,
            "track.iterations": self.track.iterations,
            "track.field_steps": self.track.field_steps,
            "map.window": self.map.window,
            "map.iterations": self.map.iterations,
            "map.first_iterations": self.map.first_iterations,
            "field.layers": self.field.layers,
            "field.width": self.field.width,
        }
        for name, value in positive.items():
            if value < 1:
                raise ValueError(f"{name}: expected 1 or more, got {value}")
        if self.hold_out == 1 or self.hold_out < 0:
            raise ValueError(f"hold_out: expected 0, or 2 or more, got {self.hold_out}")


class Progress(NamedTuple):
    """One frame done; `truth_error` [m] is the distance to the truth with the first poses put together."""

    index: int
    count: int
    tracked: Tracked | None  # None: the first frame
    lost: bool
    truth_error: float
    seconds: float


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
    keyframes: list[Keyframe]
    field: PoseField  # camera in the world over the whole recording
    field_params: Any
    field_rmse_m: float
    field_rmse_deg: float


class _World(NamedTuple):
    """The map, and the steps compiled for its size."""

    grid: GridConfig
    scene: SceneField
    state: MapState
    merged: Any  # the scene as tracking reads it
    track: Callable[..., Tracked]
    update: Callable[..., tuple[MapState, jax.Array]]


def run(
    recording: Recording,
    config: SlamConfig = SlamConfig(),
    on_frame: Callable[[Progress], None] | None = None,
) -> SlamResult:
    """Track every frame of an RGB-D recording and map what it sees (paper section 3.4, METHOD section 5).

    The world's frame is that of the truth where its first pose is known (as in NICE-SLAM), else the first
    camera's; `gravity_world` must be in that frame. Raises DataError where the recording cannot be
    tracked: fewer than two frames, no depth in the first, IMU asked for and not there.
    """
    windows = _inertial_windows(recording, config)
    generator = np.random.default_rng(config.seed)
    key = jax.random.key(config.seed)
    key, field_key = jax.random.split(key)
    T_body_cam = np.asarray(recording.T_body_cam, np.float64)
    T_cam_body = np.linalg.inv(T_body_cam)
    t = recording.t
    framed = make_field(config.frame, config.field, float(np.median(np.diff(t))), float(t[-1] - t[0]))
    params = framed.field.init(field_key)
    settle = make_settle(framed, config.track, IMU_WEIGHTS[config.imu], _sigmas(recording, config))
    compile_world = partial(_compile, recording, config, settle)

    T_world_cam = [_first_pose(recording)]
    T_world_body = [T_world_cam[0] @ T_cam_body]
    velocity, twist, offset = np.zeros(3), np.zeros(6), np.zeros(3)
    records: list[tuple[bool, Tracked | None, float]] = []
    mapped: list[int] = []
    keyframes: list[Keyframe] = []
    world, far, mapped_at = None, 0.0, -np.inf

    for i in range(len(t)):
        started = time.perf_counter()
        frame = recording.read(i)
        image = Image(jnp.asarray(frame.rgb), jnp.asarray(frame.depth, jnp.float32))
        key, track_key, map_key = jax.random.split(key, 3)
        tracked, lost = None, False
        if world is not None:
            dt = float(t[i] - t[i - 1])
            readings = windows(i - 1, T_world_body[-1], offset)
            interval, predicted = _interval(dt, T_world_body, t[:i], twist, velocity, readings, config.imu)
            where = gauge(config.frame, float(t[i - 1] - t[0]), T_world_body[-1], T_world_body[0], generator)
            tracked = world.track(
                world.merged, world.state.memory, params, jnp.asarray(T_world_body[-1], jnp.float32), where,
                interval, image, jnp.float32(far), track_key,
            )  # fmt: skip
            tracked = jax.device_get(tracked)
            params = tracked.params
            lost = _failed(
                tracked, [float(r[1].loss) for r in records if r[1] is not None and not r[0]], config
            )
            T_ref_body = predicted if lost else np.asarray(tracked.T_ref_body, np.float64)
            T_world_body.append(T_world_body[-1] @ T_ref_body)
            T_world_body[-1][:3, :3] = nearest_rotation(T_world_body[-1][:3, :3])  # float32 adds up
            T_world_cam.append(T_world_body[-1] @ T_body_cam)
            if i > 1 and not lost and config.imu in _USES_SPEED:  # the first speed is not known
                error = T_world_body[-2][:3, :3] @ (T_ref_body[:3, 3] - predicted[:3, 3])
                offset = observe_acceleration(offset, dt, error)
            twist = np.asarray(se3.log(jnp.asarray(T_ref_body, jnp.float32)), np.float64) / dt
            velocity = end_velocity(dt, T_ref_body, readings, speed=config.imu in _USES_SPEED)

        points = _points(frame, recording, T_world_cam[-1])
        if world is None and len(points) == 0:
            raise DataError(f"{recording.name}: expected depth in the first frame, found none")
        held_out = config.hold_out > 0 and i % config.hold_out == config.hold_out - 1
        if not lost and not held_out and len(points) and t[i] - mapped_at >= config.map_every_s:
            far = max(
                far, 1.2 * float(np.percentile(np.linalg.norm(points - T_world_cam[-1][:3, 3], axis=1), 99))
            )
            world = _room_for(points, world, config, compile_world)
            shares = (
                overlap(points, np.stack([k.T_world_cam for k in keyframes]), recording.camera)
                if keyframes
                else np.zeros(0)
            )
            world = _mapped(world, image, T_world_cam[-1], keyframes, shares, far, config, generator, map_key)
            mapped_at = t[i]
            mapped.append(i)
            if not keyframes or shares.max() < config.keyframe_overlap:
                keyframes.append(Keyframe(i, image, T_world_cam[-1]))
        assert world is not None  # made from the first frame
        jax.block_until_ready(world.merged)
        seconds = time.perf_counter() - started
        records.append((lost, tracked, seconds))
        if on_frame is not None:
            on_frame(Progress(i, len(t), tracked, lost, _truth_error(recording, i, T_world_cam), seconds))

    return _finish(recording, np.stack(T_world_cam), records, mapped, world, keyframes)


def _inertial_windows(recording: Recording, config: SlamConfig) -> Callable[..., Readings]:
    """The readings after each frame, given the body's pose and the false acceleration [m/s^2] then.

    Checks what can be checked beforehand.
    """
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


def _first_pose(recording: Recording) -> np.ndarray:
    if recording.T_world_cam is not None and np.isfinite(recording.T_world_cam[0]).all():
        return np.array(recording.T_world_cam[0], np.float64)
    return np.eye(4)


def _interval(dt, T_world_body, t, twist, velocity, readings, mode) -> tuple[Interval, np.ndarray]:
    """What tracking starts from, and the predicted motion of the whole interval."""
    # Without two frames the speed is not known, and the accelerometer only changes it.
    senses = {"rotation": mode != "none", "speed": mode in _USES_SPEED}
    stamps, poses = predict(dt, twist, velocity, readings, **senses)
    senses["speed"] &= len(t) > 1
    T_ref_world = np.linalg.inv(T_world_body[-1])
    behind = [max(len(t) - 1 - k, 0) for k in range(BEHIND + 1)]  # the last frame itself, and those before
    past = np.stack([T_ref_world @ T_world_body[k] for k in behind])
    sigma = prediction_sigma(dt, poses[-1], **senses)
    if len(t) == 1:
        sigma = sigma + [0.3 * dt, 0.0 if senses["rotation"] else 0.3 * dt]  # as fast as a hand may move
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    return Interval(
        as_float(dt),
        as_float(np.concatenate([stamps, t[behind] - t[-1]])),
        as_float(np.concatenate([poses, past])),
        as_float(sigma),
        readings,
    ), poses[-1]


def _failed(tracked: Tracked, losses: list[float], config: SlamConfig) -> bool:
    """Whether tracking went wrong: too little of the image explained, or far worse than it usually is."""
    usual = float(np.median(losses[-30:])) if losses else np.inf
    explained = np.isfinite(tracked.loss) and tracked.valid >= config.track.minimum_valid
    # One sigma is what the sensor's own noise leaves; without noise the usual loss would be next to nothing.
    return not (explained and tracked.loss < 2 * max(usual, 1.0))


def _points(frame: Frame, recording: Recording, T_world_cam: np.ndarray, step: int = 16) -> np.ndarray:
    """World points (n, 3) of every 16th pixel in both directions that has depth, float64."""
    camera = recording.camera
    row, column = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    depth = frame.depth[row, column]
    seen = depth > 0
    ray = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(row.shape)], -1)
    points = ray[seen] * depth[seen][:, None]
    return points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]


def _compile(recording, config, settle, grid_config: GridConfig, state: MapState | None) -> _World:
    """The map's compiled steps for a grid; a map that starts if there is no state yet."""
    scene = grid(grid_config)
    scale = {"band": grid_config.truncation, "width": grid_config.truncation / 8}
    if config.map.method == "fused":
        init_map, update = make_fuse(grid_config, recording.camera, grid_config.truncation)
    else:
        map_config = replace(config.map, sample=replace(config.map.sample, **scale))
        init_map, update = make_descend(scene, recording.camera, map_config)
    track_config = replace(config.track, sample=replace(config.track.sample, **scale))
    T_body_cam = jnp.asarray(recording.T_body_cam, jnp.float32)
    track = make_track(
        scene, partial(look_up, scene, grid_config), recording.camera, T_body_cam, track_config, settle
    )
    state = init_map(scene.init(jax.random.key(0))) if state is None else state
    return _World(grid_config, scene, state, _merge(state.params), track, update)


_merge = jax.jit(merge)


def _sigmas(recording: Recording, config: SlamConfig) -> ResidualSigmas:
    """The sensor's noise and the field's own stiffness together."""
    if config.imu == "none" or recording.imu is None:
        return FIELD_SIGMAS
    rate_hz = 1 / float(np.median(np.diff(recording.imu.t)))
    sensor = inertial.residual_sigmas(config.imu_noise, rate_hz, float(np.median(np.diff(recording.t))))
    return ResidualSigmas(*(float(np.hypot(a, b)) for a, b in zip(sensor, FIELD_SIGMAS, strict=True)))


def _room_for(points, world: _World | None, config: SlamConfig, compile_world) -> _World:
    """A world whose grid holds the points; a few stray ones do not make it grow."""
    lower, upper = np.percentile(points, [1, 99], axis=0)
    corners = np.stack([lower, upper])
    if world is None:
        levels = 1 if config.map.method == "fused" else 2
        return compile_world(box(corners, voxel=config.voxel, levels=levels), None)
    if (lower >= world.grid.lower).all() and (upper <= world.grid.upper).all():
        return world
    return compile_world(*grow(world.grid, world.state, corners))


def _mapped(world, image, T_world_cam, keyframes, shares, far, config, generator, key) -> _World:
    """The world after a mapping step on this frame and keyframes that overlap it."""
    if config.map.method == "fused":
        state = world.update(world.state, image, jnp.asarray(T_world_cam, jnp.float32))
        return world._replace(state=state, merged=state.params)
    first = not keyframes
    others = [] if first else [keyframes[k] for k in choose(shares, config.map.window - 1, generator)]
    images = [image] * config.map.window if first else [image, *(k.image for k in others)]
    poses = [T_world_cam] * config.map.window if first else [T_world_cam, *(k.T_world_cam for k in others)]
    state, _ = world.update(
        world.state,
        jax.tree.map(lambda *x: jnp.stack(x), *images),
        jnp.asarray(np.stack(poses), jnp.float32),
        jnp.float32(far),
        jnp.float32(config.map.first_rate if first else config.map.learning_rate),
        jnp.int32(config.map.first_iterations if first else config.map.iterations),
        key,
    )
    return world._replace(state=state, merged=_merge(state.params))


def _truth_error(recording: Recording, i: int, T_world_cam: list[np.ndarray]) -> float:
    if recording.T_world_cam is None:
        return float("nan")
    return float(np.linalg.norm(recording.T_world_cam[i, :3, 3] - T_world_cam[i][:3, 3]))


def _finish(recording, T_world_cam, records, mapped, world, keyframes) -> SlamResult:
    """One field fitted to all poses, and everything that was recorded on the way.

    A B-spline with a knot a frame: a PoseNet over the same 12 s of the default room stayed 1.5 cm from the
    poses, and where the camera had turned once around it took the other way.
    """
    t = recording.t - recording.t[0]
    span = (0.0, float(t[-1]))
    intervals = max(round(t[-1] / float(np.median(np.diff(t)))), 1)
    field = bspline(span, intervals)
    knots = (np.arange(intervals + 3) - 1) * (t[-1] / intervals)
    between = jax.vmap(stamped(jnp.asarray(t, jnp.float32), jnp.asarray(T_world_cam, jnp.float32)))
    start = control_points(between(jnp.asarray(knots, jnp.float32)))
    fitted = fit(field, t, T_world_cam, params=start, steps=400, learning_rate=1e-3)
    default = Tracked(None, np.eye(4), *[np.nan] * 3, 0)  # type: ignore[arg-type]
    each = [tracked or default for _, tracked, _ in records]
    return SlamResult(
        T_world_cam,
        lost=np.array([lost for lost, _, _ in records]),
        mapped=np.isin(np.arange(len(records)), mapped),
        iterations=np.array([int(x.iterations) for x in each]),
        loss=np.array([float(x.loss) for x in each]),
        depth_error=np.array([float(x.depth_error) for x in each]),
        valid=np.array([float(x.valid) for x in each]),
        seconds=np.array([s for _, _, s in records]),
        scene=world.scene,
        grid=world.grid,
        scene_params=world.merged,
        keyframes=keyframes,
        field=field,
        field_params=fitted.params,
        field_rmse_m=float(fitted.translation_rmse_m),
        field_rmse_deg=float(fitted.rotation_rmse_deg),
    )
