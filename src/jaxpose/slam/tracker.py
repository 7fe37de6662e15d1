"""Where the camera is at the next frame: predicted, searched for if that may be far off, and tracked."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jaxpose.datasets.types import Frame
from jaxpose.geometry.rigid import nearest_rotation, rotation_angle_deg
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.keyframes import look
from jaxpose.slam.map.world import scene_params
from jaxpose.slam.observation import Image, is_blank
from jaxpose.slam.system import System
from jaxpose.slam.tracking.predict import (
    BEHIND,
    PreintegratedImu,
    TrackingProblem,
    end_velocity,
    exp,
    log,
    observe_acceleration,
    observe_gyro_bias,
    predict,
    prediction_sigma,
)
from jaxpose.slam.tracking.reference_frames import reference_frame
from jaxpose.slam.tracking.relocalise import CENTRES, FOUND_SIGMA
from jaxpose.slam.tracking.steps import Tracked
from jaxpose.slam.types import Frames, SlamState

_HELD = 0.08  # [m, rad] a prediction from the IMU that cannot be off by more is as good as no loss
_FARTHEST = 0.5  # [m, rad]
_AROUND_CENTRES = 0.25  # [m, rad] a search reaches where nothing else is known
# After a loss, share explained and loss against the usual: of a camera that could be anywhere, or is near.
_RECOGNISED = 0.7, 1.1
_FOUND_AGAIN = 0.5, 1.3
_RECKONED = 0.3  # [m, rad] a pose from the IMU alone is good enough to go on from
_SHARP = 0.02  # [m, rad] a pose known less well is uncertain
_LEAST_DEPTH = 0.01  # share of an image
_PULLED = 0.03  # [m, rad] as far off as colour still pulls
_WORSE_COLOUR, _BETTER_COLOUR = 1.5, 0.9  # against the usual error, and that of another pose
_AS_MUCH, _AS_WELL = 0.7, 1.3  # share explained and loss against another pose's
_OTHER_COLOUR = 2.5  # against the usual error; measured at most 2.2 at true poses, 2.6 and more beside them
_LEAST_COLOUR = 0.008  # an error that images without noise stay below; less says nothing
_OTHER_LIGHT_S = 2.0
_FADING_S = 0.5  # in which a speed that nothing senses is forgotten


class MotionPrediction(NamedTuple):
    """What is expected of the motion since the last frame, before this frame's image is looked at."""

    dt: float  # [s]
    timestamps: Float[np.ndarray, " k"]  # [s] since the last frame, up to dt
    T_ref_body: Float[np.ndarray, "k 4 4"]
    sigma: Float[np.ndarray, "2"]  # [m, rad] how far off it may be at dt
    readings: PreintegratedImu


def next_pose(
    system: System,
    state: SlamState,
    frame: Frame,
    image: Image,
    generator: np.random.Generator,
    key: PRNGKeyArray,
) -> SlamState:
    """The state with the next frame's pose: tracked, or predicted and marked as lost."""
    config, ahead = system.config, _ahead(system, state)
    reach = _reach(system, state, ahead)
    if np.mean(frame.depth > 0) < _LEAST_DEPTH:
        return _update_state(system, state, state.frames, ahead, None, lost=True)
    near_key, wide_key = jax.random.split(key)
    frames = state.frames
    tracked = _track(system, state, frames, ahead, image, generator, near_key)
    lost = _failed(system, state, tracked, reach)
    if lost or _appearance_doubtful(state, tracked, ahead):
        bent, found = _relocalise(system, state, frame, image, ahead.T_ref_body[-1], reach, wide_key)
        other = _track(system, state, bent, _constant_velocity(ahead, found), image, generator, wide_key)
        other_lost = _failed(system, state, other, reach)
        if lost or (not other_lost and _looks_better(other, tracked)):
            frames, tracked, lost = bent, other, other_lost
    unknown_place = lost and tracked.valid < config.track.minimum_valid
    if unknown_place and config.uses_accelerometer and max(reach) < _RECKONED:
        return _update_state(system, state, state.frames, ahead, None, lost=False)
    seen = not lost and not is_blank(frame)
    appearance_outlier = seen and _is_appearance_outlier(
        frames, system.recording.t, state.done, float(tracked.colour_error)
    )
    return _update_state(system, state, frames, ahead, tracked, lost, appearance_outlier)


def _ahead(system: System, state: SlamState) -> MotionPrediction:
    """By constant speed or the readings."""
    config, t, last = system.config, system.recording.t, state.done - 1
    dt = float(t[last + 1] - t[last])
    readings = system.readings(
        last, state.frames.T_world_body[last], state.gyro_bias, state.accelerometer_bias_world
    )
    timestamps, T_ref_body = predict(
        dt, state.twist, state.velocity_body, readings,
        rotation=config.uses_gyroscope, speed=config.uses_accelerometer,
    )  # fmt: skip
    return MotionPrediction(dt, timestamps, T_ref_body, _sigma(config, state, dt, T_ref_body[-1]), readings)


def _constant_velocity(ahead: MotionPrediction, found: Float[np.ndarray, "4 4"]) -> MotionPrediction:
    """At one speed to a motion that a search has found."""
    twist = log(found)
    share = np.arange(1, len(ahead.timestamps) + 1) / len(ahead.timestamps)
    T_ref_body = exp(share[:, None] * twist)
    sigma = np.minimum(ahead.sigma, FOUND_SIGMA)
    return ahead._replace(timestamps=ahead.dt * share, T_ref_body=T_ref_body, sigma=sigma)


def _update_state(
    system: System,
    state: SlamState,
    frames: Frames,
    ahead: MotionPrediction,
    tracked: Tracked | None,
    lost: bool,
    appearance_outlier: bool = False,
) -> SlamState:
    """The state after an interval: with the tracked motion, or with the predicted one where that is lost."""
    config, i, dt, predicted = system.config, state.done, ahead.dt, ahead.T_ref_body[-1]
    if tracked is None or lost:  # neither: reckoned from the IMU
        frames, T_ref_body = state.frames, predicted
        params, exposure = state.params, state.exposure
    else:
        T_ref_body = np.asarray(tracked.T_ref_body, np.float64)
        params, exposure = tracked.params, tracked.exposure
    T_world_ref = frames.T_world_body[i - 1]
    T_world_body = T_world_ref @ T_ref_body
    T_world_body[:3, :3] = nearest_rotation(T_world_body[:3, :3])  # float32 adds up
    sure = tracked is not None and not lost and not appearance_outlier and _last_found(frames, i) == i - 1
    accelerometer_bias_world = state.accelerometer_bias_world
    if i > 1 and sure and config.uses_accelerometer:  # else the speed is not known
        error = T_world_ref[:3, :3] @ (T_ref_body[:3, 3] - predicted[:3, 3])
        accelerometer_bias_world = observe_acceleration(accelerometer_bias_world, dt, error)
    gyro_bias, gyro_bias_sigma = state.gyro_bias, state.gyro_bias_sigma
    if sure and config.uses_gyroscope:
        off = predicted[:3, :3].T @ T_ref_body[:3, :3]
        gyro_bias, gyro_bias_sigma = observe_gyro_bias(gyro_bias, gyro_bias_sigma, dt, off)
    uncertain = appearance_outlier or _uncertain(tracked, lost)
    frames = frames.put(
        i, T_world_body=T_world_body, lost=lost, appearance_outlier=appearance_outlier, uncertain=uncertain
    )
    if tracked is not None:
        frames = frames.put(
            i,
            iterations=tracked.iterations,
            loss=tracked.loss,
            depth_error=tracked.depth_error,
            colour_error=tracked.colour_error,
            valid=tracked.valid,
            sigma=tracked.sigma,
        )
    fade = np.exp(-dt / _FADING_S) if lost else 1.0
    velocity_body = end_velocity(dt, T_ref_body, ahead.readings, speed=config.uses_accelerometer)
    return state._replace(
        frames=frames,
        twist=fade * log(T_ref_body) / dt,
        velocity_body=velocity_body if config.uses_accelerometer else fade * velocity_body,
        gyro_bias=gyro_bias,
        gyro_bias_sigma=gyro_bias_sigma,
        accelerometer_bias_world=accelerometer_bias_world,
        params=params,
        exposure=exposure,
    )


def _uncertain(tracked: Tracked | None, lost: bool) -> bool:
    """Whether a pose rests on a prediction, or on an image that says little of it."""
    return tracked is None or lost or bool((np.asarray(tracked.sigma) > _SHARP).any())


def _sigma(config: SlamConfig, state: SlamState, dt: float, predicted: Float[np.ndarray, "4 4"]):
    """How far off [m, rad] a predicted motion may be."""
    first = state.done == 1
    # Without two frames the speed is not known, and the accelerometer only changes it.
    speed = config.uses_accelerometer and not first
    sigma = prediction_sigma(
        dt,
        predicted,
        rotation=config.uses_gyroscope,
        speed=speed,
        gyro_bias_sigma=state.gyro_bias_sigma,
    )
    if first:
        sigma = sigma + [0.3 * dt, 0.0 if config.uses_gyroscope else 0.3 * dt]  # as fast as a hand may move
    return sigma


def _reach(system: System, state: SlamState, ahead: MotionPrediction) -> np.ndarray:
    """How far [m, rad] to search: what a hand's change of speed adds, and the time since a pose was found.

    Infinite where nothing is known any more.
    """
    config, t, i, dt = system.config, system.recording.t, state.done, ahead.dt
    blind = t[i - 1] - t[_last_found(state.frames, i)]
    metres = 0.05 * blind + 0.02 * blind**2 if config.uses_accelerometer else 0.25 * dt**2 + 0.3 * blind
    radians = 0.005 * blind if config.uses_gyroscope else 0.5 * dt**2 + 0.3 * blind
    reach = ahead.sigma + [metres, radians]
    return np.where(reach < _FARTHEST, reach, np.inf)


def _last_found(frames: Frames, i: int) -> int:
    """The last frame before i that is not in doubt."""
    return int(np.flatnonzero(~(frames.lost | frames.appearance_outlier)[:i])[-1])


def _relocalise(
    system: System,
    state: SlamState,
    frame: Frame,
    image: Image,
    predicted: Float[np.ndarray, "4 4"],
    reach: np.ndarray,
    key: PRNGKeyArray,
) -> tuple[Frames, Float[np.ndarray, "4 4"]]:
    """The motion that a wide search finds, frames in doubt bent to lead there.

    After a loss, poses of keyframes within reach that look alike are searched around too.
    """
    T_body_cam, frames, i = system.recording.T_body_cam, state.frames, state.done
    T_world_predicted = frames.T_world_body[i - 1] @ predicted
    last = _last_found(frames, i)
    centres = [T_world_predicted]
    if last < i - 1:
        kept = np.append(np.flatnonzero(frames.keyframe), last)
        away = np.linalg.inv(T_world_predicted) @ frames.T_world_body[kept]
        angle = rotation_angle_deg(away[:, :3, :3], np.tile(np.eye(3), (len(kept), 1, 1)))
        off = np.stack([np.linalg.norm(away[:, :3, 3], axis=1), np.deg2rad(angle)], axis=1)
        kept = kept[(off <= 3 * reach).all(axis=1)]
        seen = look(frame)
        appearance_outlier = [np.mean((system.look(k) - seen) ** 2) for k in kept.tolist()]
        centres += list(frames.T_world_body[kept[np.argsort(appearance_outlier)[: CENTRES - 1]]])
    spread = np.where(np.isfinite(reach), reach, _AROUND_CENTRES)
    found = system.world(state.grid).relocalise(
        scene_params(state.map),
        state.map.fusion_state,
        jnp.asarray(np.resize(centres, (CENTRES, 4, 4)) @ T_body_cam, jnp.float32),
        jnp.asarray(spread, jnp.float32),
        image,
        jax.random.fold_in(key, 1),
    )
    T_world_body = np.asarray(found, np.float64) @ np.linalg.inv(T_body_cam)
    frames = _distribute_correction(
        frames, system.recording.t, last, i, np.linalg.inv(T_world_predicted) @ T_world_body
    )
    return frames, np.linalg.inv(frames.T_world_body[i - 1]) @ T_world_body


def _distribute_correction(
    frames: Frames, t: np.ndarray, last: int, i: int, T_predicted_found: np.ndarray
) -> Frames:
    """The frames between `last` and i moved by their share of what the prediction at i was off."""
    lost = np.arange(last + 1, i)
    share = (t[lost] - t[last]) / (t[i] - t[last])
    correction = exp(share[:, None] * log(T_predicted_found))
    return frames.put(lost, T_world_body=frames.T_world_body[lost] @ correction)


def _interval(system: System, frames: Frames, last: int, ahead: MotionPrediction) -> TrackingProblem:
    """What tracking the next frame starts from."""
    t, T_world_body = system.recording.t, frames.T_world_body
    behind = [max(last - k, 0) for k in range(BEHIND + 1)]  # the last frame itself, and those before
    past = np.linalg.inv(T_world_body[last]) @ T_world_body[behind]
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    return TrackingProblem(
        as_float(ahead.dt),
        as_float(np.concatenate([ahead.timestamps, t[behind] - t[last]])),
        as_float(np.concatenate([ahead.T_ref_body, past])),
        as_float(ahead.sigma),
        ahead.readings,
    )


def _track(
    system: System,
    state: SlamState,
    frames: Frames,
    ahead: MotionPrediction,
    image: Image,
    generator: np.random.Generator,
    key: PRNGKeyArray,
) -> Tracked:
    interval = _interval(system, frames, state.done - 1, ahead)
    config, t, last = system.config, system.recording.t, state.done - 1
    T_world_ref, T_world_first = frames.T_world_body[last], frames.T_world_body[0]
    where = reference_frame(config.frame, float(t[last] - t[0]), T_world_ref, T_world_first, generator)
    return jax.device_get(
        system.world(state.grid).track(
            scene_params(state.map), state.map.fusion_state, state.params,
            jnp.asarray(T_world_ref, jnp.float32), where, interval, image, jnp.float32(state.far), key,
        )
    )  # fmt: skip


def _failed(system: System, state: SlamState, tracked: Tracked, reach: np.ndarray) -> bool:
    """Whether tracking went wrong: too little of the image explained, or far worse than it usually is.

    After a loss more is asked for: a wrong place may look right, and would be mapped.
    """
    frames, i = state.frames, state.done
    usual = _usual(frames.loss[:i], frames.lost[:i])
    least, most = system.config.track.minimum_valid, 2.0
    held = system.config.uses_accelerometer and max(reach) < _HELD
    if frames.lost[max(i - 2, 0) : i].any() and not held:
        least, most = _FOUND_AGAIN if np.isfinite(reach).all() else _RECOGNISED
    finite = np.isfinite(tracked.loss) and np.isfinite(tracked.T_ref_body).all()
    explained = finite and tracked.valid >= least
    # One sigma is what the sensor's own noise leaves; without noise the usual loss would be next to nothing.
    return not (explained and tracked.loss < most * max(usual, 1.0))


def _appearance_doubtful(state: SlamState, tracked: Tracked, ahead: MotionPrediction) -> bool:
    """Whether the camera may have settled beside its place: colours fit worse than usual, or none is known.

    Where there are few shapes, surfaces fit in more places than one, and colour pulls from a few cm only.
    """
    frames, i = state.frames, state.done
    if i == 1:
        return float(ahead.sigma.max()) > _PULLED
    return float(tracked.colour_error) > _WORSE_COLOUR * _usual_colour(frames, i)


def _is_appearance_outlier(frames: Frames, t: Float[np.ndarray, " n"], i: int, colour_error: float) -> bool:
    """Whether frame i fits in shape, but so badly in colour that it is at another place, or in another light.

    Nothing is mapped from a wrong place. A light stays, so after a while it is taken as one, and what follows
    is held against the first frame in it.
    """
    last = _last_found(frames, i)
    usual = max(_usual_colour(frames, i), np.nan_to_num(frames.colour_error[last]), _LEAST_COLOUR)
    return bool(colour_error > _OTHER_COLOUR * usual and t[i] - t[last] < _OTHER_LIGHT_S)


def _looks_better(other: Tracked, tracked: Tracked) -> bool:
    """Whether, of two poses that fit the surfaces, the other has the better colours and sees enough."""
    return bool(
        other.colour_error < _BETTER_COLOUR * tracked.colour_error
        and other.valid > _AS_MUCH * tracked.valid
        and other.loss < _AS_WELL * tracked.loss
    )


def _usual_colour(frames: Frames, i: int) -> float:
    return _usual(frames.colour_error[:i], (frames.lost | frames.appearance_outlier)[:i])


def _usual(values: Float[np.ndarray, " i"], doubted: Bool[np.ndarray, " i"]) -> float:
    """The median over the last 30 frames that are in no doubt; infinite before the first."""
    found = values[~doubted & np.isfinite(values)][-30:]
    return float(np.median(found)) if len(found) else np.inf
