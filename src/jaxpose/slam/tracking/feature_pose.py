"""Poses by sparse features: how much they are worth, and what they say together with the prediction."""

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.types import Frame
from jaxpose.estimate.pose_graph import CHI2_999
from jaxpose.geometry import rigid
from jaxpose.slam.keyframes import unlikeness
from jaxpose.slam.tracking.features import FeaturePose, Features, locate_camera
from jaxpose.slam.tracking.predict import MotionPrediction, constant_velocity
from jaxpose.slam.tracking.register import Tracked
from jaxpose.slam.types import Frames, SlamState

_USUAL = 30  # frames that say what is usual
# Errors of poses by features that stay from frame to frame (colour beside depth, a rolling shutter), which no
# number of frames averages out.
_GO_TOGETHER = 10.0
_ENOUGH = 60  # features of keyframes: with fewer those of the last frame are taken too, which drift
_MATCHED = 3  # images that a frame's features are matched with
FIRST_SCALE = 30.0  # of the covariance of poses by features, before any has been compared: measured 6 to 200
_CHI2_MEDIAN = 5.35  # of 6 degrees of freedom


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
    state: SlamState, frames: Frames, predicted: MotionPrediction, seen: FeaturePose, tracked: Tracked
) -> float:
    """Squared Mahalanobis distance between poses by features and by the image, neither knowing the other.

    The registered pose was pulled towards the prediction; by its information that is taken back.
    """
    expected, information = np.linalg.inv(predicted.covariance), np.asarray(tracked.information, np.float64)
    T_ref_body = rigid.inverse(predicted.T_ref_body[-1]) @ np.asarray(tracked.T_ref_body, np.float64)
    pulled = rigid.log(rigid.inverse(state.T_body_cam) @ T_ref_body @ state.T_body_cam)
    image = np.linalg.inv(information + 1e-9 * np.trace(information) * np.eye(6))
    alone = _predicted_camera(state, frames, predicted) @ rigid.exp(pulled + image @ expected @ pulled)
    away = rigid.log(rigid.inverse(seen.T_world_cam) @ alone)
    return float(away @ np.linalg.solve(image + seen.covariance / _feature_scale(frames), away))


def _feature_scale(frames: Frames) -> float:
    """How many times larger than stated the covariance of poses by features has been so far."""
    known = frames.feature_nis[np.isfinite(frames.feature_nis)][-_USUAL:]
    return max(float(np.median(known)) / _CHI2_MEDIAN, 1.0) if len(known) >= 5 else FIRST_SCALE


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
