"""Where the camera is at the next frame: predicted, registered, and searched for where that is in doubt."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jaxpose.datasets.types import Frame
from jaxpose.geometry import rigid
from jaxpose.slam.config import RecoveryConfig
from jaxpose.slam.keyframes import unlikeness
from jaxpose.slam.map.backend import map_backend, scene_params
from jaxpose.slam.observation import Image, is_blank
from jaxpose.slam.rolling_shutter import at_first_row
from jaxpose.slam.tracking.features import Features
from jaxpose.slam.tracking.predict import (
    BEHIND,
    MotionPrediction,
    TrackingProblem,
    constant_velocity,
    end_velocity,
    feature_nis,
    imu_sigmas,
    observe_acceleration,
    observe_gyro_bias,
    predict,
    prediction_sigma,
    readings_between,
    seen_pose,
    with_features,
    worst_sigmas,
)
from jaxpose.slam.tracking.reference_frames import reference_frame
from jaxpose.slam.tracking.register import Tracked
from jaxpose.slam.tracking.relocalise import CENTRES, FOUND_SIGMA
from jaxpose.slam.types import Frames, Motion, SlamState, TrackingStatus

# What is kept of a registration.
_KEPT = "iterations", "loss", "depth_error", "colour_error", "valid", "sigma", "covariance", "line_delay"


def next_pose(
    state: SlamState,
    by_motion: MotionPrediction,
    frame: Frame,
    image: Image,
    features: Features | None,
    generator: np.random.Generator,
    key: PRNGKeyArray,
) -> SlamState:
    """The state with the pose of its last frame, which has none yet: registered, or predicted and marked.

    `by_motion` is what was expected of it (`expected_motion`).
    """
    config, policy, frames = state.config, state.config.recovery, state.frames
    predicted = by_motion
    seen = None if features is None else seen_pose(state, predicted, frame, features)
    if seen is not None:
        state, predicted = with_features(state, predicted, seen)
        frames = state.frames
    held = seen is not None and bool(max(worst_sigmas(seen.covariance)) < policy.held_by_features)
    reach = _reach(state, predicted, held)
    if np.mean(frame.depth > 0) < policy.least_depth:
        return _update_state(state, frames, predicted, by_motion, None, TrackingStatus.LOST)
    near_key, wide_key = jax.random.split(key)
    used = predicted
    tracked = _track(state, frames, predicted, image, generator, near_key)
    lost = _failed(state, tracked, reach, held)
    elsewhere = not is_blank(frame) and _is_appearance_outlier(policy, frames, float(tracked.colour_error))
    if (lost or elsewhere) and seen is not None and not frames.doubted[-2]:  # features of another place?
        other = _track(state, frames, by_motion, image, generator, near_key)
        if lost or _looks_better(policy, other, tracked):
            seen, held, predicted, used, tracked = None, False, by_motion, by_motion, other
            reach = _reach(state, predicted, held)
            lost = _failed(state, tracked, reach, held)
    if lost or (not held and _appearance_doubtful(state, tracked, predicted)):
        corrected, found = _relocalise(state, frame, image, predicted.T_ref_body[-1], reach, wide_key)
        sigma = np.minimum(predicted.sigma, FOUND_SIGMA)
        around = constant_velocity(predicted, found, np.diag(np.repeat(sigma**2, 3)))
        other = _track(state, corrected, around, image, generator, wide_key)
        other_lost = _failed(state, other, reach, False)
        if lost or (not other_lost and _looks_better(policy, other, tracked)):
            frames, tracked, lost, used = corrected, other, other_lost, around
    unknown_place = lost and tracked.valid < config.track.minimum_valid
    if unknown_place and config.uses_accelerometer and max(reach) < policy.reckoned:
        return _update_state(state, state.frames, predicted, by_motion, None, TrackingStatus.DEAD_RECKONED)
    if lost:
        return _update_state(state, state.frames, predicted, by_motion, tracked, TrackingStatus.LOST)
    if seen is not None:
        found = np.asarray(tracked.T_ref_body), np.asarray(tracked.information)
        frames = frames.put(-1, feature_nis=feature_nis(state, frames, used, seen, *found))
    status = registered_status(policy, tracked)
    if (
        not held
        and not is_blank(frame)
        and _is_appearance_outlier(policy, frames, float(tracked.colour_error))
    ):
        status = TrackingStatus.APPEARANCE_OUTLIER
    return _update_state(state, frames, predicted, by_motion, tracked, status)


def registered_near(
    state: SlamState,
    i: int,
    T_world_body: Float[np.ndarray, "4 4"],
    sigma: Float[np.ndarray, "2"],
    image: Image,
) -> Tracked:
    """A frame of a run registered to the map as it is now; the motion is that from the frame before it.

    Args:
        state: a run.
        i: the frame, not the first.
        T_world_body: where it may be.
        sigma: how far off [m, rad] that may be.
        image: of the frame.

    Returns:
        The registration.
    """
    frames = Frames(*(values[: i + 1] for values in state.frames))
    state = state._replace(frames=frames)
    T_ref_body = rigid.inverse(frames.T_world_body[i - 1]) @ T_world_body
    expected = constant_velocity(expected_motion(state), T_ref_body, np.diag(np.repeat(sigma**2, 3)))
    generator, key = np.random.default_rng([state.config.seed, i]), jax.random.key(state.config.seed)
    return _track(state, frames, expected, image, generator, jax.random.fold_in(key, i))


def registered_status(policy: RecoveryConfig, tracked: Tracked) -> TrackingStatus:
    """How a frame was found whose registration is believed: weak, where the image says little."""
    weak = (np.asarray(tracked.sigma) > policy.weak).any()
    return TrackingStatus.WEAK if weak else TrackingStatus.TRACKED


def with_registration(
    frames: Frames,
    i: int,
    T_world_body: Float[np.ndarray, "4 4"],
    status: TrackingStatus,
    tracked: Tracked | None,
) -> Frames:
    """The frames with the pose of one of them, and what is kept of its registration, if there was one."""
    pose = T_world_body.copy()
    pose[:3, :3] = rigid.nearest_rotation(pose[:3, :3])  # float32 adds up
    values = {} if tracked is None else {name: getattr(tracked, name) for name in _KEPT}
    return frames.put(i, T_world_body=pose, status=status, **values)


def unrolled(state: SlamState, predicted: MotionPrediction, frame: Frame) -> Frame:
    """The state's last frame, all of it at its first row's time, by the speed that is expected there."""
    if state.config.line_delay_us == 0:
        return frame
    twist_cam = rigid.adjoint(rigid.inverse(state.T_body_cam)) @ predicted.twist
    return at_first_row(frame, state.camera, twist_cam, state.config.line_delay_us / 1e6)


def expected_motion(state: SlamState) -> MotionPrediction:
    """The motion to the last frame, before it is looked at, and how far off [m, rad] it may be.

    By constant velocity or by the readings.
    """
    config, frames, motion = state.config, state.frames, state.motion
    start, end = frames.t[-2:].tolist()
    T_world_ref, dt = frames.T_world_body[-2], end - start
    imu = state.imu if config.uses_gyroscope else None
    gravity_world = state.gravity_world + motion.accelerometer_bias_world
    readings = readings_between(imu, start, end, T_world_ref[:3, :3], motion.gyro_bias, gravity_world)
    timestamps, T_ref_body = predict(
        dt, motion.twist, motion.velocity_body, readings,
        rotation=config.uses_gyroscope, speed=config.uses_accelerometer,
    )  # fmt: skip
    first = frames.count == 2
    sigma = prediction_sigma(
        dt,
        T_ref_body[-1],
        rotation=config.uses_gyroscope,
        # Without two frames the speed is not known, and the accelerometer only changes it.
        speed=config.uses_accelerometer and not first,
        gyro_bias_sigma=float(motion.gyro_bias_sigma),
    )
    if first:
        sigma = sigma + [0.3 * dt, 0.0 if config.uses_gyroscope else 0.3 * dt]  # as fast as a hand may move
    covariance = np.diag(np.repeat(sigma**2, 3))
    return MotionPrediction(dt, timestamps, T_ref_body, covariance, np.zeros((6, 6)), readings)


def _update_state(
    state: SlamState,
    frames: Frames,
    prediction: MotionPrediction,
    by_motion: MotionPrediction,
    tracked: Tracked | None,
    status: TrackingStatus,
) -> SlamState:
    """The state with the tracked motion, or with the predicted one where nothing was registered."""
    config, i, dt, predicted = state.config, frames.count - 1, prediction.dt, prediction.T_ref_body[-1]
    registered = None if status == TrackingStatus.LOST else tracked
    T_ref_body = predicted if registered is None else np.asarray(registered.T_ref_body, np.float64)
    sure = registered is not None and status <= TrackingStatus.WEAK and frames.last_found == i - 1
    fade = np.exp(-dt / config.recovery.fading_s) if status == TrackingStatus.LOST else 1.0
    velocity_body = end_velocity(dt, T_ref_body, prediction.readings, speed=config.uses_accelerometer)
    motion = _observe_biases(state, T_ref_body, by_motion.T_ref_body[-1], dt) if sure else state.motion
    motion = motion._replace(
        twist=fade * rigid.log(T_ref_body) / dt,
        velocity_body=velocity_body if config.uses_accelerometer else fade * velocity_body,
    )
    frames = with_registration(frames, i, frames.T_world_body[i - 1] @ T_ref_body, status, tracked)
    state = state._replace(frames=frames, motion=motion)
    if registered is None:
        return state
    return state._replace(params=registered.params, exposure=registered.exposure)


def _observe_biases(state: SlamState, T_ref_body: np.ndarray, predicted: np.ndarray, dt: float) -> Motion:
    """The biases after a prediction that turned out to be off from the registered motion."""
    motion, config, frames = state.motion, state.config, state.frames
    if frames.count > 2 and config.uses_accelerometer:  # else the speed is not known
        error = frames.T_world_body[-2, :3, :3] @ (T_ref_body[:3, 3] - predicted[:3, 3])
        bias = observe_acceleration(motion.accelerometer_bias_world, dt, error)
        motion = motion._replace(accelerometer_bias_world=bias)
    if config.uses_gyroscope:
        off = predicted[:3, :3].T @ T_ref_body[:3, :3]
        bias, sigma = observe_gyro_bias(motion.gyro_bias, float(motion.gyro_bias_sigma), dt, off)
        motion = motion._replace(gyro_bias=bias, gyro_bias_sigma=sigma)
    return motion


def _reach(state: SlamState, predicted: MotionPrediction, held: bool) -> np.ndarray:
    """How far [m, rad] to search: what a hand's change of speed adds, and the time since a pose was found.

    Returns inf once that exceeds `farthest`: nothing is known any more.
    """
    config, t, dt = state.config, state.frames.t, predicted.dt
    if held:
        return 3 * predicted.sigma
    blind = t[-2] - t[state.frames.last_found]
    metres = 0.05 * blind + 0.02 * blind**2 if config.uses_accelerometer else 0.25 * dt**2 + 0.3 * blind
    radians = 0.005 * blind if config.uses_gyroscope else 0.5 * dt**2 + 0.3 * blind
    reach = predicted.sigma + [metres, radians]
    return np.where(reach < config.recovery.farthest, reach, np.inf)


def _relocalise(
    state: SlamState,
    frame: Frame,
    image: Image,
    predicted: Float[np.ndarray, "4 4"],
    reach: np.ndarray,
    key: PRNGKeyArray,
) -> tuple[Frames, Float[np.ndarray, "4 4"]]:
    """The motion that a wide search finds, and frames in doubt moved to lead there.

    After a loss, poses of keyframes within reach that look alike are searched around too.
    """
    T_body_cam, frames, i = state.T_body_cam, state.frames, state.frames.count - 1
    T_world_predicted = frames.T_world_body[i - 1] @ predicted
    last = frames.last_found
    centres = [T_world_predicted]
    if last < i - 1:
        keyframes = np.flatnonzero(frames.keyframe)
        away = rigid.inverse(T_world_predicted) @ frames.T_world_body[[*keyframes, last]]
        angle = rigid.rotation_angle(away[:, :3, :3], np.eye(3))
        off = np.stack([np.linalg.norm(away[:, :3, 3], axis=1), angle], axis=1)
        near = np.all(off <= 3 * reach, axis=1)
        alike = [k for k in np.argsort(unlikeness(state.thumbnails, frame)) if near[k]]
        chosen = [*([last] if near[-1] else []), *keyframes[alike]]
        centres += list(frames.T_world_body[chosen][: CENTRES - 1])
    spread = np.where(np.isfinite(reach), reach, state.config.recovery.around_keyframes)
    assert state.map is not None
    found = map_backend(state).relocalise(
        scene_params(state.map),
        state.map.fusion_state,
        jnp.asarray(np.resize(centres, (CENTRES, 4, 4)) @ T_body_cam, jnp.float32),
        jnp.asarray(spread, jnp.float32),
        image,
        jax.random.fold_in(key, 1),
    )
    T_world_body = np.asarray(found, np.float64) @ rigid.inverse(T_body_cam)
    frames = frames.corrected(rigid.inverse(T_world_predicted) @ T_world_body)
    return frames, rigid.inverse(frames.T_world_body[i - 1]) @ T_world_body


def _track(
    state: SlamState,
    frames: Frames,
    predicted: MotionPrediction,
    image: Image,
    generator: np.random.Generator,
    key: PRNGKeyArray,
) -> Tracked:
    """The compiled tracking step from a prediction, its result on the host."""
    assert state.map is not None
    return jax.device_get(
        map_backend(state).track(
            scene_params(state.map),
            state.map.fusion_state,
            state.params,
            tracking_problem(state, frames, predicted, generator),
            image,
            jnp.float32(state.max_depth),
            key,
        )
    )


def tracking_problem(
    state: SlamState, frames: Frames, predicted: MotionPrediction, generator: np.random.Generator
) -> TrackingProblem:
    """What the tracking step starts from."""
    config, t, T_world_body, last = state.config, frames.t, frames.T_world_body, frames.count - 2
    behind = [max(last - k, 0) for k in range(BEHIND + 1)]  # the last frame itself, and those before
    past = rigid.inverse(T_world_body[last]) @ T_world_body[behind]
    timestamps = np.concatenate([predicted.timestamps, t[behind] - t[last]])
    # A field stands still outside of its span, 4 intervals: after a gap these are longer.
    interval_s = max(float(np.median(np.diff(t))), float(np.abs(timestamps).max()) / 4 * (1 + 1e-6))
    where = reference_frame(
        config.frame,
        since_first_s=t[last] - t[0],
        interval_s=interval_s,
        duration_s=state.duration_s,
        T_world_ref=T_world_body[last],
        T_world_first=T_world_body[0],
        generator=generator,
    )
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    imu = state.imu if config.uses_gyroscope else None
    return TrackingProblem(
        as_float(predicted.dt),
        as_float(timestamps),
        as_float(np.concatenate([predicted.T_ref_body, past])),
        as_float(predicted.covariance),
        as_float(predicted.support),
        predicted.readings,
        jax.tree.map(as_float, imu_sigmas(config.imu_noise, imu, predicted.dt)),
        as_float(T_world_body[last]),
        as_float(state.T_body_cam),
        as_float(rigid.adjoint(rigid.inverse(state.T_body_cam)) @ predicted.twist),
        where,
    )


def _failed(state: SlamState, tracked: Tracked, reach: np.ndarray, held: bool) -> bool:
    """Whether registration went wrong: too little of the image explained, or far worse than it usually is.

    After a loss more is asked for: a wrong place may look right, and would be mapped.
    """
    frames, policy = state.frames, state.config.recovery
    usual = _usual(frames.loss[:-1], frames.lost[:-1])
    least, most = state.config.track.minimum_valid, policy.lost_loss
    sure = held or (state.config.uses_accelerometer and max(reach) < policy.held)
    if frames.lost[-3:-1].any() and not sure:
        near = np.isfinite(reach).all()
        least = policy.found_valid if near else policy.recognised_valid
        most = policy.found_loss if near else policy.recognised_loss
    finite = np.isfinite(tracked.loss) and np.isfinite(tracked.T_ref_body).all()
    explained = finite and (held or tracked.valid >= least)
    # One sigma is what the sensor's own noise leaves; without noise the usual loss would be next to nothing.
    return not (explained and tracked.loss < most * max(usual, 1.0))


def _appearance_doubtful(state: SlamState, tracked: Tracked, predicted: MotionPrediction) -> bool:
    """Whether the camera may have settled beside its place: colours fit worse than usual, or none is known.

    Where there are few shapes, surfaces fit in more places than one, and colour pulls from a few cm only.
    """
    if state.frames.count == 2:
        return float(predicted.sigma.max()) > state.config.recovery.colour_pulls
    return float(tracked.colour_error) > state.config.recovery.worse_colour * _usual_colour(state.frames)


def _is_appearance_outlier(policy: RecoveryConfig, frames: Frames, colour_error: float) -> bool:
    """Whether the current frame fits in shape, but so badly in colour that place or light is another.

    Nothing is mapped from a wrong place. A light stays, so after a while it is taken as one, and what follows
    is held against the first frame in it.
    """
    last = frames.last_found
    usual = max(_usual_colour(frames), np.nan_to_num(frames.colour_error[last]), policy.least_colour)
    lately = frames.t[-1] - frames.t[last] < policy.other_light_s
    return bool(colour_error > policy.outlier_colour * usual and lately)


def _looks_better(policy: RecoveryConfig, other: Tracked, tracked: Tracked) -> bool:
    """Whether, of two poses that fit the surfaces, the other has the better colours and sees enough."""
    return bool(
        other.colour_error < policy.better_colour * tracked.colour_error
        and other.valid > policy.as_much * tracked.valid
        and other.loss < policy.as_well * tracked.loss
    )


def _usual_colour(frames: Frames) -> float:
    return _usual(frames.colour_error[:-1], frames.doubted[:-1])


def _usual(values: Float[np.ndarray, " i"], doubted: Bool[np.ndarray, " i"]) -> float:
    """The median over the last 30 frames that are in no doubt; infinite before the first."""
    found = values[~doubted & np.isfinite(values)][-30:]
    return float(np.median(found)) if len(found) else np.inf
