"""Loops while a run goes on: looked for at each keyframe, and closed once two agree on a correction.

Candidates are keyframes that look alike and may be in reach by the trajectory's own drift, and only where
that drift could have moved a surface by a voxel of the map: less cannot make a second wall. Closing moves all
keyframes by a pose graph, the frames between them with them, and the map is integrated anew.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.datasets.types import Frame
from jaxpose.estimate.pose_graph import CHI2_999, Edges, optimise_pose_graph
from jaxpose.geometry import rigid
from jaxpose.slam.config import LoopConfig
from jaxpose.slam.keyframes import FrameReader, overlap, seen_shares, unlikeness
from jaxpose.slam.loops.drift import drift_to_last, may_be_doubled, motion_sigmas
from jaxpose.slam.loops.rebuild import rebuilt
from jaxpose.slam.loops.verify import Verified, verify
from jaxpose.slam.map.backend import seen_points
from jaxpose.slam.tracking.features import locate_camera
from jaxpose.slam.tracking.predict import FIRST_FEATURE_SCALE
from jaxpose.slam.types import Frames, SlamState

_LEAST_SIGMA = 1e-5  # [m, rad] of a motion
_SAME = 1e-6  # [m, rad] by which a motion may differ from the poses that it leads to
_AT_ONCE = 12  # keyframes that a corrected map is made of before the next frame
_JUMP = 3.0  # sigmas of the motions' drift from which poses have jumped


def with_loops(state: SlamState, frame: Frame, read: FrameReader) -> SlamState:
    """The run after its last frame, a keyframe, was compared with earlier ones that may show the same place.

    Where there are such, the map holds the place from before a loop, and a camera registered to it jumps:
    then the motion since the last keyframe is taken from the two images themselves.

    Args:
        state: a run whose last frame is a keyframe.
        frame: that keyframe.
        read: earlier keyframes.

    Returns:
        The state with a loop more, if there is one, and corrected where two loops ask for it.
    """
    assert state.features is not None
    keyframes, last = np.flatnonzero(state.frames.keyframe), state.frames.count - 1
    candidates = _candidates(state, frame)
    if not len(candidates):
        return state
    before = _compared(state, frame, read, [len(keyframes) - 2])
    if before is not None:
        T_body_cam = state.T_body_cam
        motion = T_body_cam @ before.T_a_b @ rigid.inverse(T_body_cam)
        T_odometry = state.frames.T_odometry[keyframes[-2]] @ motion
        state = state._replace(frames=state.frames.put(last, T_odometry=T_odometry))
    found = _compared(state, frame, read, candidates.tolist())
    if found is None:
        return state
    loops = state.loops.appended(found.frame, last, found.T_a_b, found.information)
    state = state._replace(loops=loops)
    return _settled(state, frame, read)


class _Again(NamedTuple):
    """An earlier keyframe that a frame shows again."""

    frame: int
    T_a_b: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]


def _compared(state: SlamState, frame: Frame, read: FrameReader, places: list[int]) -> _Again | None:
    """Which of some keyframes, counted among themselves, the last frame shows again; None without such.

    Features are those of a keyframe and of its neighbours, whose places to it are known.
    """
    assert state.features is not None
    keyframes, best = np.flatnonzero(state.frames.keyframe), None
    T_world_cam = state.frames.T_world_body[keyframes] @ state.T_body_cam
    for k in places:
        beside = [j for j in (k - 1, k, k + 1) if 0 <= j < len(keyframes) - 1]
        T_k_beside = rigid.inverse(T_world_cam[k]) @ T_world_cam[beside]
        known = [(state.keyframe_features[j], T) for j, T in zip(beside, T_k_beside, strict=True)]
        seen = locate_camera(state.features, known, state.camera)
        if seen is not None and (best is None or seen.inliers > best[1].inliers):
            best = k, seen
    if best is None:
        return None
    a = int(keyframes[best[0]])
    verified = verify(read(a), frame, best[1], state.camera)
    if not is_same_place(verified, state.config.loop):
        return None
    return _Again(a, verified.T_a_b, verified.information)


def is_same_place(verified: Verified, policy: LoopConfig) -> bool:
    """Whether depth, colour and features of two images agree, and hold all of their relative pose.

    Args:
        verified: the images' comparison.
        policy: what is asked for.

    Returns:
        False for what is in any doubt.
    """
    compared, features = verified.compared, verified.features
    covariance = np.linalg.inv(verified.information)
    apart = rigid.log(rigid.inverse(features.T_world_cam) @ verified.T_a_b)
    worst = max(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1] for k in (0, 3))
    return bool(
        compared.overlap > policy.overlap
        and compared.agreement > policy.agreement
        and compared.conflict < policy.conflict
        and compared.colour > policy.colour
        and np.sqrt(worst) < policy.sigma
        and apart @ np.linalg.solve(FIRST_FEATURE_SCALE * features.covariance, apart) < CHI2_999
    )


def _candidates(state: SlamState, frame: Frame) -> Int[np.ndarray, " c"]:
    """Keyframes, counted among themselves, that may show what the last one shows; most alike first."""
    frames, policy = state.frames, state.config.loop
    assert state.features is not None
    keyframes = np.flatnonzero(frames.keyframe)
    depth, drift = state.features.usual_depth, drift_to_last(state, keyframes)
    doubled = may_be_doubled(state, keyframes, drift, depth)
    if not doubled.any():
        return np.zeros(0, int)
    T_world_cam = frames.T_world_body[keyframes] @ state.T_body_cam
    points = seen_points(frame, state.camera, T_world_cam[-1])
    near = doubled & (seen_shares(points, T_world_cam, state.keyframe_depths, state.camera) > policy.share)
    order = np.argsort(unlikeness(state.thumbnails, frame))
    return order[near[order]][: policy.candidates]


def _settled(state: SlamState, frame: Frame, read: FrameReader) -> SlamState:
    """The state with its loops settled, if the last two agree; corrected, if by more than a voxel."""
    loops, frames, c = state.loops, state.frames, state.settled
    asked = np.flatnonzero(loops.believed & (loops.b > c))[-2:]
    if len(asked) < 2:
        return state
    assert state.grid is not None and state.features is not None
    T = poses_by_motions(state) @ state.T_body_cam
    correction = T[loops.a[asked]] @ loops.T_a_b[asked] @ rigid.inverse(T[loops.b[asked]])
    place, depth = T[loops.b[asked[-1]]], state.features.usual_depth
    first, last = rigid.inverse(place) @ correction @ place
    apart = rigid.log(rigid.inverse(first) @ last)
    if apart @ np.linalg.solve(np.linalg.inv(loops.information[asked]).sum(0), apart) > CHI2_999:
        return state
    size = lambda off: np.linalg.norm(off[:3, 3]) + depth * rigid.rotation_angle(off[:3, :3], np.eye(3))
    if min(size(first), size(last)) > state.grid.voxel:
        return corrected(state, frame, read)
    return state._replace(settled=frames.count - 1)


def poses_by_motions(state: SlamState) -> Float[np.ndarray, "n 4 4"]:
    """Poses of the body: since loops were settled, where motions lead, if the camera has jumped from there.

    A camera that is registered to the map of another time jumps; what differs less from motions that are of
    two images each (`with_loops`) is their own drift.

    Args:
        state: a run whose last frame is a keyframe.

    Returns:
        (n, 4, 4) `T_world_body` of all frames.
    """
    frames, c = state.frames, state.settled
    T, odometry = frames.T_world_body, frames.T_odometry
    keyframes = np.flatnonzero(frames.keyframe)
    since = keyframes[keyframes >= c]
    motions = rigid.inverse(odometry[since[:-1]]) @ odometry[since[1:]]
    off = rigid.log(rigid.inverse(motions) @ rigid.inverse(T[since[:-1]]) @ T[since[1:]])
    other = np.flatnonzero(np.abs(off).max(axis=1) > _SAME)
    if not len(other):
        return T
    start = since[other[0]]
    drift, k = drift_to_last(state, keyframes), np.searchsorted(keyframes, start)
    jump = rigid.log(rigid.inverse(odometry[-1]) @ odometry[start] @ rigid.inverse(T[start]) @ T[-1])
    metres, radians = np.linalg.norm(jump.reshape(2, 3), axis=1)
    if metres < _JUMP * drift.translation[k] and radians < _JUMP * drift.rotation[k]:
        return T
    return np.concatenate([T[:c], T[c] @ rigid.inverse(odometry[c]) @ odometry[c:]])


def corrected(state: SlamState, frame: Frame | None, read: FrameReader) -> SlamState:
    """The run with its poses, its map and what it goes on with as its loops have them.

    Args:
        state: a run with loops. Its map is no longer usable.
        frame: its last frame, where `read` does not know it yet.
        read: keyframes.

    Returns:
        The state, whose loops are marked that the others speak against. Of the map it has what the last frame
        shows; the rest follows beside the frames that come (`rebuild.resumed`).
    """
    frames, keyframes = state.frames, np.flatnonzero(state.frames.keyframe)
    T_world_cam = frames.T_world_body[keyframes] @ state.T_body_cam
    edges = _edges(state, keyframes)
    found = optimise_pose_graph(T_world_cam, edges)
    believed = found.weight[len(keyframes) - 1 :] > 0.5
    moved = found.T @ rigid.inverse(T_world_cam)
    after = followed(frames, keyframes, moved)
    turn = moved[-1, :3, :3]
    motion = state.motion._replace(accelerometer_bias_world=turn @ state.motion.accelerometer_bias_world)
    last, loops = frames.count - 1, state.loops._replace(believed=believed)
    state = state._replace(frames=after, motion=motion, loops=loops, settled=last)
    now = read if frame is None else lambda i: frame if i == last else read(i)
    poses = after.T_world_body[keyframes] @ state.T_body_cam
    shares = overlap(seen_points(now(last), state.camera, poses[-1]), poses, state.camera, state.max_depth)
    away = np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1)
    return rebuilt(state, keyframes[np.lexsort((away, -shares))], now, _AT_ONCE)


def _edges(state: SlamState, keyframes: Int[np.ndarray, " k"]) -> Edges:
    """Motions from keyframe to keyframe as they were tracked, and the loops."""
    loops, count = state.loops, len(keyframes)
    odometry = state.frames.T_odometry[keyframes] @ state.T_body_cam
    motions = rigid.inverse(odometry[:-1]) @ odometry[1:]
    metres, radians = np.maximum(motion_sigmas(state, keyframes), _LEAST_SIGMA).T
    diagonal = np.concatenate([np.repeat(1 / x[:, None] ** 2, 3, axis=1) for x in (metres, radians)], axis=1)
    place = lambda frame: np.searchsorted(keyframes, frame)
    return Edges(
        np.concatenate([np.arange(count - 1), place(loops.a)]),
        np.concatenate([np.arange(1, count), place(loops.b)]),
        np.concatenate([motions, loops.T_a_b]),
        np.concatenate([diagonal[:, :, None] * np.eye(6), loops.information]),
        np.repeat([False, True], [count - 1, len(loops.a)]),
    )


def followed(frames: Frames, keyframes: Int[np.ndarray, " k"], moved: Float[np.ndarray, "k 4 4"]) -> Frames:
    """All frames moved with their keyframes: those between two by their share of what moved both.

    Args:
        frames: of a run.
        keyframes: which of them are.
        moved: (k, 4, 4) what the pose of each is to be multiplied by on the left.

    Returns:
        The frames.
    """
    before = np.clip(np.searchsorted(keyframes, np.arange(frames.count), side="right") - 1, 0, None)
    after = np.minimum(before + 1, len(keyframes) - 1)
    t, start, end = frames.t, frames.t[keyframes[before]], frames.t[keyframes[after]]
    share = np.where(end > start, (t - start) / np.where(end > start, end - start, 1), 0)
    between = rigid.log(rigid.inverse(moved[before]) @ moved[after])
    poses = moved[before] @ rigid.exp(np.clip(share, 0, 1)[:, None] * between) @ frames.T_world_body
    poses[:, :3, :3] = rigid.nearest_rotation(poses[:, :3, :3])
    return frames._replace(T_world_body=poses)
