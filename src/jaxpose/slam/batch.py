"""The end of a run: one continuous trajectory, by tracked poses and all readings at once."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.estimate import Posterior, smooth
from jaxpose.fields import Params, PoseField, bspline, fit
from jaxpose.geometry import rigid
from jaxpose.imu import Imu
from jaxpose.slam.types import Frames, SlamState, TrackingStatus

_FEWEST = 4  # poses that an estimate can be made of
_UNKNOWN = 1.0  # [m, rad] sigma of a pose that ends the run and is in doubt


class FinalTrajectory(NamedTuple):
    """Poses of the camera at the frames, and a field over seconds since the first of them."""

    T_world_cam: Float[np.ndarray, "n 4 4"]
    field: PoseField
    field_params: Params
    field_rmse_m: float  # of the field at the frames' times to the tracked poses
    field_rmse_deg: float
    posterior: Posterior | None


def final_trajectory(state: SlamState, imu: Imu | None) -> FinalTrajectory:
    """The most likely trajectory where readings tell more than poses, else a field through all poses.

    A field through poses is a B-spline with a knot a frame: a PoseNet over the same 12 s of the default room
    stayed 1.5 cm from the poses, and where the camera had turned once around it took the other way.

    Args:
        state: a run of at least two frames.
        imu: all readings, on the clock of the frames.

    Returns:
        The trajectory.
    """
    frames, posterior = state.frames, estimate_trajectory(state, imu)
    tracked, t = frames.T_world_body @ state.T_body_cam, frames.t - frames.t[0]
    if posterior is None:
        intervals = max(round(t[-1] / float(np.median(np.diff(t)))), 1)
        fitted = fit(bspline((0.0, float(t[-1])), intervals), t, tracked)
        off = fitted.translation_rmse_m, fitted.rotation_rmse_deg
        return FinalTrajectory(tracked, fitted.field, fitted.params, *off, None)
    T_world_cam = posterior.pose(t)
    turned = np.degrees(rigid.rotation_angle(T_world_cam[:, :3, :3], tracked[:, :3, :3]))
    moved = np.linalg.norm(T_world_cam[:, :3, 3] - tracked[:, :3, 3], axis=1)
    moved_rms, turned_rms = (float(np.sqrt(np.mean(x**2))) for x in (moved, turned))
    return FinalTrajectory(T_world_cam, *posterior.field(), moved_rms, turned_rms, posterior)


def estimate_trajectory(state: SlamState, imu: Imu | None) -> Posterior | None:
    """The trajectory that poses and readings together make most likely, on the clock of the first frame.

    Frames that were not registered say nothing: the readings bridge them.

    Args:
        state: a run.
        imu: all readings, on the clock of the frames.

    Returns:
        The posterior; None without readings that the run uses, with too few registered frames, and where a
        PoseNet tracks (Ma et al.'s own way, whose trajectory is a fit to its poses).
    """
    config, frames = state.config, state.frames
    if imu is None or not config.uses_gyroscope or config.uses_field:
        return None
    sigma = registered_sigmas(frames)
    kept = np.isfinite(sigma).all(axis=1)
    if kept.sum() < _FEWEST:
        return None
    t0, T_world_cam = frames.t[0], frames.T_world_body @ state.T_body_cam
    use = {"accelerometer": ("accelerometer",), "combined": ("gyroscope", "accelerometer")}
    return smooth(
        frames.t[kept] - t0,
        T_world_cam[kept],
        np.repeat(sigma[kept], 3, axis=1),
        imu._replace(t=np.asarray(imu.t, np.float64) - t0),
        use=use.get(config.imu, ("gyroscope",)),
        estimate=("biases", "gravity", *(x for x in config.estimate if x != "line-delay")),
        noise=config.imu_noise,
        T_body_cam=state.T_body_cam,
        gravity_world=state.gravity_world,
    )


def registered_sigmas(frames: Frames) -> Float[np.ndarray, "n 2"]:
    """One sigma (n, 2) of position [m] and rotation [rad] of the registered frames, NaN of the others."""
    registered = (frames.status <= TrackingStatus.WEAK) & np.isfinite(frames.sigma).all(axis=1)
    sigma = np.where(registered[:, None], frames.sigma, np.nan)
    if registered.any():
        sigma[0] = np.median(sigma[registered], axis=0)  # the first pose is as it was told
    if np.isnan(sigma[-1]).any():
        sigma[-1] = _UNKNOWN
    return sigma
