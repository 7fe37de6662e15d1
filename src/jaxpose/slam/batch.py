"""The end of a run: one continuous trajectory, by tracked poses and all readings at once, and how sure it is.

A registered pose has two errors: its own beside the map (`Tracked.covariance`), and the map's, to which it
adds its own with what is mapped from it, so that the map's walks.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.estimate import Posterior, smooth
from jaxpose.estimate.posterior import table_times
from jaxpose.evaluation.consistency import variance_factor
from jaxpose.fields import Covariances, Params, PoseField, bspline, fit
from jaxpose.geometry import rigid
from jaxpose.imu import Imu
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.loops.types import Proposal
from jaxpose.slam.types import Frames, SlamState, TrackingStatus

_FEWEST = 4  # poses that an estimate can be made of
_UNKNOWN = 1.0  # [m, rad] sigma of a pose that ends the run and is in doubt
SEEN_AGAIN_S = 4.0  # in which the map's error is forgotten: experiments/estimate.md
_RESOLVED = 1e-5  # [m, rad] that poses in float32 resolve
_OF_MOTION = 1 / 3  # a motion between keyframes has both's own errors in it, and the step of the map's
_SAME_TIME = 1e-6  # [s]
_ALIKE = 4  # registered frames to either side whose covariances are averaged: that of one is of 16 numbers


class FinalTrajectory(NamedTuple):
    """Poses of the camera at the frames, and a field over seconds since the first of them."""

    T_world_cam: Float[np.ndarray, "n 4 4"]
    field: PoseField
    field_params: Params
    field_rmse_m: float  # of the field at the frames' times to the tracked poses
    field_rmse_deg: float
    posterior: Posterior | None
    covariances: Covariances | None  # of it; None where a PoseNet tracked, and of too few registered frames


def final_trajectory(state: SlamState, imu: Imu | None, adjusted: Proposal | None = None) -> FinalTrajectory:
    """The most likely trajectory where readings tell more than poses, else a field through all poses.

    A field through poses is a B-spline with a knot a frame: a PoseNet over the same 12 s of the default room
    stayed 1.5 cm from the poses, and where the camera had turned once around it took the other way.

    Args:
        state: a run of at least two frames.
        imu: all readings, on the clock of the frames.
        adjusted: what features said of the keyframes; None: nothing.

    Returns:
        The trajectory.
    """
    frames = state.frames
    posterior, by_images = estimate_trajectory(state, imu, adjusted)
    tracked, t = frames.T_world_body @ state.T_body_cam, frames.t - frames.t[0]
    if posterior is None:
        intervals = max(round(t[-1] / float(np.median(np.diff(t)))), 1)
        fitted = fit(bspline((0.0, float(t[-1])), intervals), t, tracked)
        off_m, off_deg = fitted.translation_rmse_m, fitted.rotation_rmse_deg
        return FinalTrajectory(tracked, fitted.field, fitted.params, off_m, off_deg, None, by_images)
    T_world_cam = posterior.pose(t)
    turned = np.degrees(rigid.rotation_angle(T_world_cam[:, :3, :3], tracked[:, :3, :3]))
    moved = np.linalg.norm(T_world_cam[:, :3, 3] - tracked[:, :3, 3], axis=1)
    off_m, off_deg = (float(np.sqrt(np.mean(x**2))) for x in (moved, turned))
    known = posterior.covariances() if by_images is None else by_images
    return FinalTrajectory(T_world_cam, *posterior.field(), off_m, off_deg, posterior, known)


def estimate_trajectory(
    state: SlamState, imu: Imu | None, adjusted: Proposal | None = None
) -> tuple[Posterior | None, Covariances | None]:
    """The trajectory that poses and readings together make most likely, on the clock of the first frame.

    Frames that were not registered say nothing: the readings bridge them. Both sensors together take the
    map's drift off, unless they contradict the poses by more than these say of themselves. Then, as with one
    of them alone, they only lead from one frame to the next, and the images say how sure the trajectory is.

    Args:
        state: a run.
        imu: all readings, on the clock of the frames.
        adjusted: what features said of the keyframes; None: nothing.

    Returns:
        The posterior: None without readings that the run uses, with too few registered frames, and where a
        PoseNet tracks (Ma et al.'s own way, whose trajectory is a fit to its poses). And covariances by the
        images: None where the posterior's are right, and where nothing is known.
    """
    config, frames = state.config, state.frames
    own = own_covariances(frames)
    kept = np.isfinite(own).all(axis=(1, 2))
    if config.uses_field or kept.sum() < _FEWEST:
        return None, None
    own, t = own[kept], frames.t[kept] - frames.t[0]
    T_world_cam = frames.T_world_body[kept] @ state.T_body_cam
    by_images, of_map = own, None
    if adjusted is not None:
        by_images = adjusted.inflation * own
        if adjusted.agrees:
            by_images = np.where(frames.keyframe[kept, None, None], _OF_MOTION * own, own)
            of_map = _of_keyframes(frames.t, adjusted)[kept]
    if imu is None or not config.uses_gyroscope:
        return None, tracked_covariances(t, T_world_cam, by_images, of_map)
    use = {"accelerometer": ("accelerometer",), "combined": ("gyroscope", "accelerometer")}
    estimated = partial(
        smooth,
        t,
        T_world_cam,
        own,
        imu._replace(t=np.asarray(imu.t, np.float64) - frames.t[0]),
        use=use.get(config.imu, ("gyroscope",)),
        estimate=estimated_beside_poses(config),
        noise=config.imu_noise,
        T_body_cam=state.T_body_cam,
        gravity_world=state.gravity_world,
        offset_s=state.imu_offset_s,
    )
    if config.imu == "combined":
        posterior = estimated(drift=own, drift_s=SEEN_AGAIN_S)
        if max(posterior.noise.position, posterior.noise.rotation) < 1:
            return posterior, None
    return estimated(), tracked_covariances(t, T_world_cam, by_images, of_map)


def estimated_beside_poses(config: SlamConfig) -> tuple[str, ...]:
    """What the final trajectory's estimate finds of the sensors."""
    return ("biases", "gravity", *(x for x in config.estimate if x != "line-delay"))


def own_covariances(frames: Frames) -> Float[np.ndarray, "n 6 6"]:
    """Covariances (n, 6, 6) of the registered frames beside the map, NaN of the others.

    Over right increments of the camera; that of each frame is the mean of those around it.
    """
    registered = (frames.status <= TrackingStatus.WEAK) & np.isfinite(frames.covariance).all(axis=(1, 2))
    found = np.full((frames.count, 6, 6), np.nan)
    measured, index = frames.covariance[registered], np.flatnonzero(registered)
    measured = (measured + np.swapaxes(measured, 1, 2)) / 2 + _RESOLVED**2 * np.eye(6)
    for k, i in enumerate(index):
        found[i] = measured[max(k - _ALIKE, 0) : k + _ALIKE + 1].mean(axis=0)
    if len(index):
        found[0] = found[index[0]]  # the first pose is as it was told, and the map is made from it
        if np.isnan(found[-1]).any():
            found[-1] = _UNKNOWN**2 * np.eye(6)
    return found


def inflation(
    frames: Frames,
    T_world_cam: Float[np.ndarray, "n 4 4"],
    keyframes: Int[np.ndarray, " k"],
    T_other: Float[np.ndarray, "k 4 4"],
) -> float:
    """What covariances of tracked poses are to be multiplied by, so that they explain what others differ by.

    Errors that all frames of a camera have in common leave no trace in how well each fits the map. Poses by
    other means show them: the squared distances of moves of a second, or of the longest that there is, over
    the covariances of these.

    Args:
        frames: of a run.
        T_world_cam: their poses as tracked.
        keyframes: which frames are also known otherwise.
        T_other: their poses by these means.

    Returns:
        1 or more.
    """
    own = own_covariances(frames)
    of_map = _of_map(T_world_cam, np.nan_to_num(own))
    places = np.flatnonzero(np.isfinite(own[keyframes]).all(axis=(1, 2)))
    if len(places) < 2:
        return 1.0
    i, t = keyframes[places], frames.t[keyframes[places]]
    later = np.searchsorted(t, t + 1.0 - _SAME_TIME)
    first = np.flatnonzero(later < len(i)) if later[0] < len(i) else np.zeros(1, int)
    last = np.minimum(later[first], len(i) - 1)
    a, b = i[first], i[last]
    moved = rigid.inverse(T_world_cam[a]) @ T_world_cam[b]
    otherwise = rigid.inverse(T_other[places[first]]) @ T_other[places[last]]
    off = rigid.log(rigid.inverse(moved) @ otherwise)
    known = _of_move((T_world_cam[a], T_world_cam[b]), of_map[b] - of_map[a], (own[a], own[b]))
    return variance_factor(off, known)


def _of_map(
    T_world_cam: Float[np.ndarray, "n 4 4"], own: Float[np.ndarray, "n 6 6"]
) -> Float[np.ndarray, "n 6 6"]:
    """The walk of the map's error since the first pose, over increments on the left of poses."""
    added = np.cumsum(rigid.carried(T_world_cam, own)[1:], axis=0)
    return np.concatenate([np.zeros((1, 6, 6)), added])


def _of_move(
    T: tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "n 4 4"]],
    walked: Float[np.ndarray, "n 6 6"],
    own: tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "n 6 6"]],
) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of moves by those of both poses beside the map, and by how far that has walked between."""
    T_b_world = rigid.inverse(T[1])
    return rigid.carried(T_b_world, walked) + rigid.carried(T_b_world @ T[0], own[0]) + own[1]


def _of_keyframes(t: Float[np.ndarray, " n"], adjusted: Proposal) -> Float[np.ndarray, "n 6 6"]:
    """How far off keyframes that were adjusted together are, and frames between, on the left of poses."""
    known, at = rigid.carried(adjusted.T_world_cam, adjusted.covariance), t[adjusted.keyframes]
    j = np.clip(np.searchsorted(at, t, side="right"), 1, len(at) - 1)
    share = np.clip((t - at[j - 1]) / (at[j] - at[j - 1]), 0, 1)[:, None, None]
    return (1 - share) * known[j - 1] + share * known[j]


def tracked_covariances(
    t: Float[np.ndarray, " n"],
    T_world_cam: Float[np.ndarray, "n 4 4"],
    own: Float[np.ndarray, "n 6 6"],
    of_map: Float[np.ndarray, "n 6 6"] | None = None,
) -> Covariances:
    """How sure a trajectory through tracked poses is, at them and between.

    Between frames the motion is one whose acceleration is white noise, as strong as it looks at the frames:
    there the middle of an interval dt is sqrt(q dt^3 / 96) off (integrated Wiener process, positions known at
    the ends and beyond).

    Args:
        t: times of the poses [s].
        T_world_cam: the poses.
        own: covariance of each beside the map.
        of_map: covariance of the map where each was taken, over increments on the left of the poses; None:
            it walks by steps as large as `own`, as it does for moves of one second.

    Returns:
        Covariances of poses, and of moves of one second.
    """
    added = _of_map(T_world_cam, own)
    of_poses = added if of_map is None else of_map
    step, dt = rigid.log(rigid.inverse(T_world_cam[:-1]) @ T_world_cam[1:]), np.diff(t)
    change = (step[1:] / dt[1:, None] - step[:-1] / dt[:-1, None]) / ((dt[1:] + dt[:-1]) / 2)[:, None]
    density = (
        np.mean(change**2 * dt[1:, None], axis=0) * 1.5
    )  # a second difference averages over two intervals

    def at(times):
        i = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
        u = ((times - t[i]) / dt[i])[:, None]
        T = T_world_cam[i] @ rigid.exp(u * step[i])
        between = lambda x: (1 - u[..., None]) * x[i] + u[..., None] * x[i + 1]
        bridged = density * (dt[i, None] ** 3 * (u * (1 - u)) ** 2 / 6)
        alone = between(own) + bridged[:, :, None] * np.eye(6)
        return T, alone, between(added), between(of_poses)

    times, early = table_times((float(t[0]), float(t[-1])))
    T, alone, _, shared = at(times)
    (T_a, alone_a, shared_a, _), (T_b, alone_b, shared_b, _) = at(early), at(early + 1.0)
    second = _of_move((T_a, T_b), shared_b - shared_a, (alone_a, alone_b))
    return Covariances(times, rigid.carried(rigid.inverse(T), shared) + alone, second)
