"""Where the body will be at the next frame: at constant speed, by its inertial readings, and by features."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxpose import imu as inertial
from jaxpose.datasets.types import Frame
from jaxpose.estimate.pose_graph import CHI2_999
from jaxpose.geometry import rigid
from jaxpose.imu import Imu, ImuNoise, ResidualSigmas
from jaxpose.slam.keyframes import unlikeness
from jaxpose.slam.tracking.features import FeaturePose, Features, locate_camera
from jaxpose.slam.tracking.reference_frames import ReferenceFrame
from jaxpose.slam.types import Frames, SlamState

AHEAD = 8  # timestamps of a predicted motion
GYRO_BIAS_SIGMA = 0.1  # [rad/s] of a gyroscope of which nothing is known yet
BEHIND = 3  # frames before the last one that the field keeps to
_SMALLEST_WINDOW = 16  # readings; windows are padded to powers of two, so that few shapes are compiled

# How well a PoseNet over a few frames follows a hand's motion between them: added to the sensor's own noise.
FIELD_SIGMAS = ResidualSigmas(loose=0.004, tight=0.1, accelerometer=1.0)

_USUAL = 30  # frames that say what is usual
# Errors of poses by features that stay from frame to frame (colour beside depth, a rolling shutter), which no
# number of frames averages out.
_GO_TOGETHER = 10.0
_ENOUGH = 60  # features of keyframes: with fewer those of the last frame are taken too, which drift
_MATCHED = 3  # images that a frame's features are matched with
FIRST_FEATURE_SCALE = (
    30.0  # of the covariance of poses by features, before any has been compared: measured 6 to 200
)
_CHI2_MEDIAN = 5.35  # of 6 degrees of freedom


class MotionPrediction(NamedTuple):
    """What is expected of the motion since the last frame, before this frame's image is looked at."""

    dt: float  # [s]
    timestamps: Float[np.ndarray, " k"]  # [s] since the last frame, up to dt
    T_ref_body: Float[np.ndarray, "k 4 4"]
    covariance: Float[np.ndarray, "6 6"]  # of it at dt, over right increments of the camera [m, rad]
    support: Float[np.ndarray, "6 6"]  # the information in it that comes from features of this frame
    readings: "PreintegratedImu"

    @property
    def twist(self) -> Float[np.ndarray, "6"]:
        """Of the body [m/s, rad/s] in its own axes at dt."""
        (t, later), (T, after) = self.timestamps[-2:], self.T_ref_body[-2:]
        return rigid.log(rigid.inverse(T) @ after) / (later - t)

    @property
    def sigma(self) -> Float[np.ndarray, "2"]:
        """How far off [m, rad] it may be at dt, along the worst axis."""
        return worst_sigmas(self.covariance)


class TrackingProblem(NamedTuple):
    """What is known of the motion since the last frame (`ref`) before this frame's image is looked at."""

    t: Float[Array, ""]  # [s] of this frame, since the last
    timestamps: Float[Array, " k"]  # [s] of the predicted motion, and of earlier frames (negative)
    T_ref_body: Float[Array, "k 4 4"]
    covariance: Float[Array, "6 6"]  # of the prediction for `t`, over right increments of the camera [m, rad]
    support: Float[Array, "6 6"]  # the information in it that comes from features of this frame
    readings: "PreintegratedImu"
    imu_sigmas: ResidualSigmas
    T_world_ref: Float[Array, "4 4"]
    T_body_cam: Float[Array, "4 4"]
    twist_cam: Float[Array, "6"]  # [m/s, rad/s] of the camera in its own axes while the frame is read
    reference_frame: ReferenceFrame


class PreintegratedImu(NamedTuple):
    """Inertial readings since the last frame, padded: times [s], what was read, and what follows from it."""

    imu: Imu
    mask: Bool[Array, " s"]
    R_ref_body: Float[Array, "s 3 3"]  # the gyroscope integrated
    acceleration_body: Float[Array, "s 3"]  # free of gravity [m/s^2]
    velocity_ref: Float[Array, "s 3"]  # acceleration integrated once, from rest [m/s]
    position_ref: Float[Array, "s 3"]  # and twice [m]


@jax.jit
def preintegrate(
    imu: Imu, mask: Bool[Array, " s"], R_world_ref: Float[Array, "3 3"], gravity_world: Float[Array, "3"]
) -> PreintegratedImu:
    """Rotation, velocity and position that an interval's readings add up to, in the frame of its start."""
    R_ref_body = inertial.integrate_gyro(jnp.eye(3), jnp.asarray(imu.t), jnp.asarray(imu.omega_body), mask)
    R_world_body = jnp.matmul(R_world_ref[None], R_ref_body, precision="highest")
    acceleration_body = inertial.remove_gravity(imu, R_world_body, gravity_world)
    acceleration_ref = jnp.einsum("sij,sj->si", R_ref_body, acceleration_body, precision="highest")
    dt = jnp.where(mask[1:] & mask[:-1], jnp.diff(imu.t), 0)[:, None]
    mean = (acceleration_ref[1:] + acceleration_ref[:-1]) / 2
    velocity = jnp.cumsum(mean * dt, axis=0)
    before = jnp.concatenate([jnp.zeros((1, 3)), velocity[:-1]])
    position = jnp.cumsum((before + mean * dt / 2) * dt, axis=0)
    zero = jnp.zeros((1, 3))
    return PreintegratedImu(
        imu, mask, R_ref_body, acceleration_body,
        jnp.concatenate([zero, velocity]), jnp.concatenate([zero, position]),
    )  # fmt: skip


def readings_between(
    imu: Imu | None,
    start: float,
    end: float,
    R_world_ref: Float[np.ndarray, "3 3"],
    gyro_bias: Float[np.ndarray, "3"],
    gravity_world: Float[np.ndarray, "3"],
) -> PreintegratedImu:
    """The readings between two frames [s], preintegrated; none where the IMU does not cover the interval."""
    if imu is None or not inertial.covers(imu, start, end):
        return no_imu()
    local, mask = inertial.windows(imu, np.array([start, end]))
    size = max(_SMALLEST_WINDOW, 1 << (mask.shape[1] - 1).bit_length())
    t, omega, acceleration, used = (
        np.pad(x[0], [(0, size - mask.shape[1])] + [(0, 0)] * (x.ndim - 2), mode="edge")
        for x in (*local, mask)
    )
    used[mask.shape[1] :] = False
    local = Imu(t - start, omega - gyro_bias, acceleration)
    local = Imu(*(jnp.asarray(x, jnp.float32) for x in local))
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    return preintegrate(local, jnp.asarray(used), as_float(R_world_ref), as_float(gravity_world))


def imu_sigmas(noise: ImuNoise, imu: Imu | None, dt: float) -> ResidualSigmas:
    """The sensor's noise over an interval of `dt` [s] and the field's own stiffness together."""
    if imu is None or len(imu.t) < 2:
        return FIELD_SIGMAS
    sensor = inertial.residual_sigmas(noise, 1 / float(np.median(np.diff(imu.t))), dt)
    return ResidualSigmas(*(float(np.hypot(a, b)) for a, b in zip(sensor, FIELD_SIGMAS, strict=True)))


def no_imu() -> PreintegratedImu:
    """The readings where there are none: one masked sample."""
    zero = jnp.zeros((1, 3))
    imu = Imu(jnp.zeros(1), zero, zero)
    return PreintegratedImu(imu, jnp.zeros(1, bool), jnp.eye(3)[None], zero, zero, zero)


def predict(
    t: float,
    twist: np.ndarray,
    velocity_ref: np.ndarray,
    readings: PreintegratedImu,
    *,
    rotation: bool,
    speed: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Timestamps (k,) in (0, t] and the motion `T_ref_body` (k, 4, 4) then.

    `twist` is the last frame's motion per second, `velocity_ref` [m/s] how fast the body was at its end. With
    `rotation` the gyroscope turns the body, with `speed` the accelerometer changes its velocity; without, or
    where there are no readings, both stay as they were.
    """
    timestamps = t * np.arange(1, AHEAD + 1) / AHEAD
    steady = rigid.exp(timestamps[:, None] * twist)
    count = int(np.sum(np.asarray(readings.mask)))
    if not rotation or count < 2:
        return timestamps, steady
    nearest = np.searchsorted(np.asarray(readings.imu.t)[:count], timestamps - 1e-6).clip(0, count - 1)
    timestamps = np.asarray(readings.imu.t, np.float64)[nearest]
    position = timestamps[:, None] * velocity_ref
    if speed:
        position = position + np.asarray(readings.position_ref)[nearest]
    return timestamps, rigid.make(np.asarray(readings.R_ref_body)[nearest], position)


def prediction_sigma(
    t: float, T_ref_body: np.ndarray, *, rotation: bool, speed: bool, gyro_bias_sigma: float = 0.0
) -> np.ndarray:
    """How far off [m, rad] a predicted motion over `t` seconds may be, by what it was predicted from.

    At constant speed 40% of the motion and a little; with the gyroscope 0.2 degrees and what its bias, known
    to `gyro_bias_sigma` [rad/s], makes; with the accelerometer what a centimetre of error in the last poses
    and 0.1 m/s^2 of tilt or bias make of the speed.
    """
    angle = float(rigid.rotation_angle(np.eye(3), T_ref_body[:3, :3]))
    distance = float(np.linalg.norm(T_ref_body[:3, 3]))
    return np.array([
        0.015 + 0.1 * t**2 if speed else 0.4 * distance + 0.01,
        0.004 + gyro_bias_sigma * t if rotation else 0.4 * angle + 0.01,
    ])  # fmt: skip


def constant_velocity(
    predicted: MotionPrediction,
    found: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    support: Float[np.ndarray, "6 6"] | None = None,
) -> MotionPrediction:
    """The prediction at one speed to a motion found otherwise, with its covariance and support."""
    twist = rigid.log(found)
    share = np.arange(1, len(predicted.timestamps) + 1) / len(predicted.timestamps)
    T_ref_body = rigid.exp(share[:, None] * twist)
    return predicted._replace(
        timestamps=predicted.dt * share,
        T_ref_body=T_ref_body,
        covariance=covariance,
        support=np.zeros((6, 6)) if support is None else support,
    )


def worst_sigmas(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "2"]:
    """Standard deviations [m, rad] along the worst axes."""
    return np.sqrt([np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1] for k in (0, 3)])


def end_velocity(t: float, T_ref_body: np.ndarray, readings: PreintegratedImu, *, speed: bool) -> np.ndarray:
    """Velocity [m/s] of the body, in its axes, at the end of an interval of motion `T_ref_body`.

    With `speed`, the mean velocity is carried to the end by the accelerometer.
    """
    velocity = T_ref_body[:3, 3] / t
    count = int(np.sum(np.asarray(readings.mask)))
    if speed and count > 1:
        position, gained = (np.asarray(x)[count - 1] for x in (readings.position_ref, readings.velocity_ref))
        velocity = (T_ref_body[:3, 3] - position) / t + gained
    return T_ref_body[:3, :3].T @ velocity


def observe_acceleration(
    offset_world: np.ndarray,
    t: float,
    error_world: np.ndarray,
    *,
    sigma: float = 0.1,
    position_sigma: float = 0.01,
) -> np.ndarray:
    """The false acceleration [m/s^2] in the world, after a prediction was off by `error_world` [m].

    A tilt of the tracked world against gravity, or a bias of the sensor, pushes every prediction the same
    way, by about the false acceleration times t^2. The gain is Kalman's for an offset known to `sigma`
    [m/s^2] and positions known to `position_sigma` [m]: long intervals teach much, short ones little.
    """
    gain = (sigma * t**2) ** 2 / ((sigma * t**2) ** 2 + position_sigma**2)
    return offset_world + gain * error_world / t**2


def observe_gyro_bias(
    bias: np.ndarray,
    bias_sigma: float,
    t: float,
    R_predicted_found: np.ndarray,
    *,
    rotation_sigma: float = 0.003,
    walk: float = 2e-3,
) -> tuple[np.ndarray, float]:
    """The gyroscope's bias [rad/s] in the body and its sigma, after a predicted turn over t was off.

    What it was off by is about the bias that is left times t. Kalman's gain for turns known to
    `rotation_sigma` [rad], the bias wandering by `walk` [rad/s/sqrt(s)].
    """
    off = rigid.so3_log(R_predicted_found) / t
    before, noise = bias_sigma**2 + walk**2 * t, (rotation_sigma / t) ** 2
    gain = before / (before + noise)
    return bias - gain * off, float(np.sqrt((1 - gain) * before))


def seen_pose(
    state: SlamState, predicted: MotionPrediction, frame: Frame, features: Features
) -> FeaturePose | None:
    """The camera's pose by features of the last frame, unless it is in doubt, and of keyframes.

    Keyframes are those that look the same way from near; after a loss, those that look alike. The covariance
    is as many times larger as poses by features have been off so far.
    """
    frames, i = state.frames, state.frames.count - 1
    keyframes = np.flatnonzero(frames.keyframe)
    T_world_keyframe = frames.T_world_body[keyframes] @ state.T_body_cam
    if frames.doubted[i - 1]:
        before = []
        order = np.argsort(unlikeness(state.thumbnails, frame))
    else:
        assert state.features is not None
        before = [(state.features, frames.T_world_body[i - 1] @ state.T_body_cam)]
        away = rigid.inverse(_predicted_camera(state, frames, predicted)) @ T_world_keyframe
        off = np.linalg.norm(away[:, :3, 3], axis=1) / [f.usual_depth for f in state.keyframe_features]
        off = off + rigid.rotation_angle(away[:, :3, :3], np.eye(3))
        order = np.argsort(off)[: _MATCHED - 1]
        if i - 1 in keyframes[order]:
            before = []  # it is among them
    chosen = [(state.keyframe_features[k], T_world_keyframe[k]) for k in order[:_MATCHED]]
    seen = locate_camera(features, chosen, state.camera)
    if before and (seen is None or seen.inliers < _ENOUGH):
        seen = locate_camera(features, [*before, *chosen], state.camera)
    return seen and seen._replace(covariance=seen.covariance * _feature_scale(frames))


def feature_nis(
    state: SlamState,
    frames: Frames,
    predicted: MotionPrediction,
    seen: FeaturePose,
    T_ref_body: Float[np.ndarray, "4 4"],
    information: Float[np.ndarray, "6 6"],
) -> float:
    """Squared Mahalanobis distance between poses by features and by the image, neither knowing the other.

    The registered motion `T_ref_body` was pulled towards the prediction; by the image's information that is
    taken back.
    """
    expected, information = np.linalg.inv(predicted.covariance), np.asarray(information, np.float64)
    off = rigid.inverse(predicted.T_ref_body[-1]) @ np.asarray(T_ref_body, np.float64)
    pulled = rigid.log(rigid.inverse(state.T_body_cam) @ off @ state.T_body_cam)
    image = np.linalg.inv(information + 1e-9 * np.trace(information) * np.eye(6))
    alone = _predicted_camera(state, frames, predicted) @ rigid.exp(pulled + image @ expected @ pulled)
    away = rigid.log(rigid.inverse(seen.T_world_cam) @ alone)
    return float(away @ np.linalg.solve(image + seen.covariance / _feature_scale(frames), away))


def _feature_scale(frames: Frames) -> float:
    """How many times larger than stated the covariance of poses by features has been so far."""
    known = frames.feature_nis[np.isfinite(frames.feature_nis)][-_USUAL:]
    return max(float(np.median(known)) / _CHI2_MEDIAN, 1.0) if len(known) >= 5 else FIRST_FEATURE_SCALE


def with_features(
    state: SlamState, predicted: MotionPrediction, seen: FeaturePose
) -> tuple[SlamState, MotionPrediction]:
    """The prediction and the pose by features together, each by its information.

    Where they contradict each other the features count alone. After a loss the frames in doubt are moved to
    lead there.
    """
    frames, i, T_body_cam = state.frames, state.frames.count - 1, state.T_body_cam
    support = np.linalg.inv(seen.covariance) / _GO_TOGETHER
    if frames.doubted[i - 1]:
        T_predicted = frames.T_world_body[i - 1] @ predicted.T_ref_body[-1]
        T_world_body = seen.T_world_cam @ rigid.inverse(T_body_cam)
        frames = frames.corrected(rigid.inverse(T_predicted) @ T_world_body)
        covariance, fused = _GO_TOGETHER * seen.covariance, T_world_body
    else:
        T_world_predicted = _predicted_camera(state, frames, predicted)
        apart = rigid.log(rigid.inverse(seen.T_world_cam) @ T_world_predicted)
        both = seen.covariance + predicted.covariance
        expected = np.linalg.inv(predicted.covariance)
        if apart @ np.linalg.solve(both, apart) > CHI2_999:
            expected = np.zeros((6, 6))
        share = np.linalg.solve(_GO_TOGETHER * support + expected, expected)
        fused = seen.T_world_cam @ rigid.exp(share @ apart) @ rigid.inverse(T_body_cam)
        covariance = np.linalg.inv(support + expected)
    T_ref_body = rigid.inverse(frames.T_world_body[i - 1]) @ fused
    return state._replace(frames=frames), constant_velocity(predicted, T_ref_body, covariance, support)


def _predicted_camera(
    state: SlamState, frames: Frames, predicted: MotionPrediction
) -> Float[np.ndarray, "4 4"]:
    """The predicted pose of the camera at the last of the frames."""
    return frames.T_world_body[-2] @ predicted.T_ref_body[-1] @ state.T_body_cam
