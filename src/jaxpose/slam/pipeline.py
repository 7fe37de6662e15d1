"""The SLAM loop: track, map, keep keyframes; at the end one field for the whole trajectory.

`init`, `step` and `finish` are for frames that come one by one, `run` is for a recording; both are one loop.
"""

import time
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpose.datasets.types import Frame, Recording, check_frame
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, angle_of_view
from jaxpose.imu import Imu
from jaxpose.scenes.voxel_blocks import voxel_blocks
from jaxpose.slam.ahead import compile_growth, compile_search, end_compiled
from jaxpose.slam.batch import FinalTrajectory, final_trajectory
from jaxpose.slam.beginning import begin, begun_again, told_wrongly
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.initial_pose import upright_pose
from jaxpose.slam.keyframes import FrameReader, coarse_depth, keyframe_images, thumbnail
from jaxpose.slam.loops.bundle import adopt, propose
from jaxpose.slam.loops.closure import with_loops
from jaxpose.slam.loops.rebuild import EACH, resumed, with_room
from jaxpose.slam.loops.refine import refined
from jaxpose.slam.loops.types import Proposal
from jaxpose.slam.map.backend import (
    as_blocks,
    framed_field,
    is_mapped,
    map_frame,
    pool_size,
    seen_points,
)
from jaxpose.slam.map.texture import make_texture, painted_over, textured
from jaxpose.slam.observation import to_device
from jaxpose.slam.readings import all_readings, joined, readings_until
from jaxpose.slam.tracker import expected_motion, next_pose, unrolled
from jaxpose.slam.tracking.features import detect
from jaxpose.slam.tracking.intrinsic_frame import is_due, make_refit, window
from jaxpose.slam.types import SlamResult, SlamState

_DEFAULT = SlamConfig()


class Progress(NamedTuple):
    """One frame done; `ground_truth_error` [m] with the first poses put together, NaN where there is none."""

    index: int
    count: int
    state: SlamState  # valid until the next frame, which writes over its map
    ground_truth_error: float


def step(
    state: SlamState,
    rgb: np.ndarray,
    depth: np.ndarray,
    t: float,
    imu: Imu | None = None,
    *,
    donate: bool = False,
) -> SlamState:
    """The run after one more frame.

    Args:
        state: the run so far.
        rgb: colour (h, w, 3), uint8.
        depth: depth along the optical axis (h, w) [m], registered to colour; 0 where there is none.
        t: time of the frame [s], later than the last one's, on any clock.
        imu: readings since the last frame, on the same clock: body rate [rad/s] and specific force [m/s^2],
            gravity in it. They should reach past `t`, or to within a sample of it.
        donate: write over the map of `state`, which is then no longer usable; spares copying the map.

    Returns:
        The new state: `state.frames.T_world_body[-1] @ state.T_body_cam` is the camera's pose,
        `state.frames.status[-1]` how it was found.

    Raises:
        ValueError: for images of another size, or times that do not increase.
        DataError: where the first frame has no depth, or an IMU is asked for and there are no readings.
    """
    frame = _checked(state, rgb, depth, float(t))
    if state.config.uses_gyroscope and imu is None and state.imu is None:
        raise DataError(f"slam.step: imu={state.config.imu!r} needs inertial readings, and there are none")
    if not donate:
        state = state._replace(map=jax.tree.map(jnp.copy, state.map))
    before = state
    state = _advance(before, frame, float(t), imu, lambda i: _kept_image(before, i))
    if state.frames.keyframe[-1]:
        kept = Frame(np.array(frame.rgb), np.array(frame.depth))
        state = state._replace(images=(*state.images, kept))
    if imu is not None and state.config.uses_gyroscope:
        came = Imu(*(np.array(x, np.float64) for x in imu))
        state = state._replace(readings=(*state.readings, came))
    return state


def finish(state: SlamState) -> SlamResult:
    """The whole run so far: its poses, its map with fine colour, one continuous field through all poses.

    No frame is looked at again, as `run` does at its end: only the images of keyframes are kept.

    Args:
        state: a run of at least two frames, made by `step`; it stays usable.

    Raises:
        DataError: for fewer than two frames.
    """
    read = lambda i: _kept_image(state, i)
    copied = lambda: state._replace(map=jax.tree.map(jnp.copy, state.map))
    whole = resumed(copied(), read) if len(state.pending) else state
    return _summed_up(whole, read, _final(whole, all_readings(state.readings)))


def run(
    recording: Recording,
    config: SlamConfig = _DEFAULT,
    on_frame: Callable[[Progress], None] | None = None,
    state: SlamState | None = None,
    on_refined: Callable[[int, int], None] | None = None,
) -> SlamResult:
    """Track every frame of an RGB-D recording and map what it sees (Ma et al. 2024, section 3.4).

    At its end frames in doubt are registered once more, to the map of all of them, and keyframes are adjusted
    together (`config.refine`). Where clock or mounting of the IMU are estimated and were told wrongly, all is
    tracked again with what was found.

    Args:
        recording: frames with times, and what is known beside them. The world's frame is that of its first
            true pose, or upright by its accelerometer; `gravity_world` is in it.
        config: settings of the run.
        on_frame: called after every frame.
        state: where an earlier run of the same recording stood, to go on from there.
        on_refined: called at the end with how many frames are looked at once more, and how many there are.

    Raises:
        DataError: where the recording cannot be tracked: fewer than two frames, no depth in the first, an IMU
            asked for and not there.
    """
    bundle = None
    with end_compiled(recording, config, on_frame) as on_each:
        state = track_all(recording, config, on_each, state)
        if config.uses_refinement:
            state = refined(state, recording.read, on_refined)
        if config.uses_bundle and state.earlier is None:  # whose map's poses are not to be changed
            bundle = propose(state, recording.read, on_refined)
            if bundle is not None and bundle.agrees:
                state = adopt(state, bundle, recording.read, on_refined)
    found = _final(state, recording.imu, bundle)
    if found.posterior is not None and not state.passes and told_wrongly(state, found.posterior):
        return run(recording, config, on_frame, begun_again(state, found.posterior), on_refined)
    return _summed_up(state, recording.read, found, bundle)


def track_all(
    recording: Recording,
    config: SlamConfig,
    on_frame: Callable[[Progress], None] | None = None,
    state: SlamState | None = None,
) -> SlamState:
    """Track and map every frame: `run` without its end, with the same arguments and errors."""
    state = state or begin(recording, config)
    imu = recording.imu
    if imu is not None:
        imu = imu._replace(t=np.asarray(imu.t) - state.imu_offset_s)
    for i in range(state.frames.count, len(recording.t)):
        started, t = time.perf_counter(), float(recording.t[i])
        readings = readings_until(imu, state.frames.t[-1] if i else -np.inf, t)
        try:
            frame = check_frame(recording.read(i), recording.camera)
        except ValueError as error:
            raise DataError(f"{recording.name}: frame {i}: {error}") from None
        try:
            state = _advance(state, frame, t, readings, recording.read)
        except DataError as error:
            raise DataError(f"{recording.name}: {error}") from None
        state = state._replace(frames=state.frames.put(i, seconds=time.perf_counter() - started))
        if on_frame is not None:
            on_frame(Progress(i, len(recording.t), state, _ground_truth_error(recording, state)))
    return resumed(state, recording.read)


def _advance(state: SlamState, frame: Frame, t: float, imu: Imu | None, read: FrameReader) -> SlamState:
    """The run after one more frame. The map of `state` is written over."""
    state = resumed(state, read, EACH)
    i, config = state.frames.count, state.config
    generator = np.random.default_rng([config.seed, i])
    track_key, map_key = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), i))
    state = state._replace(frames=state.frames.appended(t), imu=joined(state, imu))
    predicted = expected_motion(state) if i else None
    if predicted is not None:
        frame = unrolled(state, predicted, frame)
    image = to_device(frame)._replace(exposure=state.exposure)
    features = detect(frame, state.camera) if config.uses_features else None
    if predicted is None:
        state = _first_pose(state)
    else:
        state = next_pose(state, predicted, frame, image, features, generator, track_key)
    state = state._replace(features=features, frames=state.frames.with_odometry())
    if config.frame == "intrinsic" and is_due(i):
        state = _update_intrinsic_frame(state)
    T_world_cam = state.frames.T_world_body[i] @ state.T_body_cam
    points = seen_points(frame, state.camera, T_world_cam)
    if i == 0 and len(points) == 0:
        raise DataError("expected depth in the first frame, found none")
    if len(points) == 0 or not is_mapped(state, frame):
        return state
    away = np.linalg.norm(points - T_world_cam[:3, 3], axis=1)
    state = state._replace(max_depth=max(state.max_depth, 1.2 * float(np.percentile(away, 99))))
    used, _ = pool_size(state)
    state = with_room(frame, points, state, read)
    image = image._replace(exposure=state.exposure)
    if predicted is None:
        compile_search(state, image)
    elif used:
        compile_growth(state, used, image, predicted)
    state = map_frame(state, image, points, read, generator, map_key)
    if state.frames.keyframe[i]:
        added = lambda kept, new: np.concatenate([kept, new[None]])
        state = state._replace(
            thumbnails=added(state.thumbnails, thumbnail(frame)),
            keyframe_depths=added(state.keyframe_depths, coarse_depth(frame)),
        )
        if features is not None:
            state = state._replace(keyframe_features=(*state.keyframe_features, features))
        if config.uses_loops:
            state = with_loops(state, frame, read)
    return state


def _first_pose(state: SlamState) -> SlamState:
    """The state with the first frame's pose: as it was told, or upright by the readings that came with it."""
    T_world_cam = state.T_world_cam_first
    if T_world_cam is None:
        T_world_cam = upright_pose(state.imu, state.frames.t[0], state.T_body_cam, state.gravity_world)
    return state._replace(
        frames=state.frames.put(0, T_world_body=T_world_cam @ rigid.inverse(state.T_body_cam))
    )


def _update_intrinsic_frame(state: SlamState) -> SlamState:
    """The state with the intrinsic frame brought to the motions so far (Ma et al. 2024, section 3.3)."""
    frames = state.frames
    chosen, poses = window(frames.count - 1), frames.T_world_body
    motions = rigid.inverse(poses[chosen - 1]) @ poses[chosen]
    times = (frames.t[chosen] - frames.t[0]) / state.duration_s
    refit = _refit(state.camera, state.config)
    params, T_inner = refit(state.params, jnp.asarray(times, jnp.float32), jnp.asarray(motions, jnp.float32))
    return state._replace(params=params, frames=frames.put(chosen, T_inner=np.asarray(T_inner)))


@lru_cache(maxsize=2)
def _refit(camera: Camera, config: SlamConfig):
    framed = framed_field(config)
    assert framed is not None and framed.parts is not None
    return make_refit(*framed.parts, angle_of_view(camera)[0])


def _final(state: SlamState, imu: Imu | None, bundle: Proposal | None = None) -> FinalTrajectory:
    """One continuous trajectory, by all readings or else through all poses."""
    if (count := state.frames.count) < 2:
        raise DataError(f"SLAM: expected at least 2 frames, got {count}")
    return final_trajectory(state, imu, bundle)


def _summed_up(
    state: SlamState, read: FrameReader, found: FinalTrajectory, bundle: Proposal | None = None
) -> SlamResult:
    """The run with its trajectory, and with the texture of its map."""
    if state.config.frame == "intrinsic" and not is_due(state.frames.count - 1):
        state = _update_intrinsic_frame(state)
    frames = state.frames
    tracked = frames.T_world_body @ state.T_body_cam
    config, blocks = as_blocks(state)
    keyframes = keyframe_images(read, np.flatnonzero(frames.keyframe), tracked)
    texture = make_texture(config, blocks, keyframes, state.camera)
    if state.earlier is not None:
        texture = painted_over(state.earlier.texture, texture)
    return SlamResult(
        T_world_cam_odometry=frames.T_odometry @ state.T_body_cam,
        frames=frames,
        loops=state.loops,
        bundle=bundle,
        coarser_at=state.coarser_at,
        keyframe_features=state.keyframe_features,
        T_body_cam=state.T_body_cam,
        earlier=state.earlier,
        scene=textured(voxel_blocks(config), config),
        map_config=config,
        scene_params=(blocks, jax.tree.map(jnp.asarray, texture)),
        **found._asdict(),
    )


def _kept_image(state: SlamState, index: int) -> Frame:
    """The image of a keyframe that `step` has kept."""
    return state.images[int(np.searchsorted(np.flatnonzero(state.frames.keyframe), index))]


def _checked(state: SlamState, rgb: np.ndarray, depth: np.ndarray, t: float) -> Frame:
    """The images of a frame as the pipeline has them; ValueError for what does not fit the run."""
    frame = check_frame(Frame(rgb, depth), state.camera)
    if not np.isfinite(t) or (state.frames.count and t <= state.frames.t[-1]):
        after = f" after {state.frames.t[-1]:.9g}" if state.frames.count else ""
        raise ValueError(f"slam.step: expected a time [s]{after}, got {t:.9g}")
    return frame


def _ground_truth_error(recording: Recording, state: SlamState) -> float:
    if recording.T_world_cam is None:
        return float("nan")
    i = state.frames.count - 1
    first, now = state.frames.T_world_body[[0, i]] @ state.T_body_cam
    put_together = recording.T_world_cam[0] @ rigid.inverse(first) @ now
    return float(np.linalg.norm(recording.T_world_cam[i, :3, 3] - put_together[:3, 3]))
