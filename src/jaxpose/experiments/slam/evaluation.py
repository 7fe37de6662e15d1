"""What is measured on a tracked recording: cost, errors, the field's own derivatives."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.evaluation import image_quality, trajectory_error
from jaxpose.experiments.slam.map_rendering import VIEW_WIDTH, Renderer, evenly
from jaxpose.fields import body_to_camera
from jaxpose.fields.derivatives import motion
from jaxpose.fields.intrinsic_motion import THRESHOLD, effective_dof
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import angle_of_view
from jaxpose.imu import Imu, remove_gravity
from jaxpose.slam import SlamResult

_MOST_READINGS = 4000  # compared with the field; more are thinned
_WRONG_M, _WRONG_DEG = 0.10, 5.0  # a pose that is farther off is wrong, and should be marked
_MAP_FRAMES = 10  # of each kind that the map is measured at
MAP_PROTOCOL = (
    f"map rendered from estimated poses of at most {_MAP_FRAMES} frames of each kind, about {VIEW_WIDTH} px "
    "wide; PSNR over pixels where it shows a surface, depth L1 where the frame has depth too; held out: "
    "tracked, never mapped"
)


class Inertial(NamedTuple):
    """IMU and field at the same times, in body axes: (read, field) of both sensors, and RMS differences."""

    t: Float[np.ndarray, " s"]
    gyro: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]  # rad/s
    accelerometer: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]  # m/s^2, free of gravity
    gyro_rms: float
    accelerometer_rms: float


class Freedom(NamedTuple):
    """Degrees of freedom of each motion from frame to frame: the body's own, and in the intrinsic frame."""

    before: Int[np.ndarray, " n"]
    after: Int[np.ndarray, " n"]
    numbers: dict[str, Any]


class Accuracy(NamedTuple):
    """Errors against ground truth after SE(3) alignment, frame by frame and as numbers for the results."""

    aligned: Float[np.ndarray, "n 4 4"]
    translation_m: Float[np.ndarray, " n"]
    rotation_deg: Float[np.ndarray, " n"]
    numbers: dict[str, Any]


class Measured(NamedTuple):
    """What there was to measure.

    Errors against ground truth, an IMU against the field, the intrinsic motion.
    """

    errors: Accuracy | None
    inertial: Inertial | None
    freedom: Freedom | None

    def numbers(self) -> dict[str, Any]:
        """All of them for the results."""
        found: dict[str, Any] = {}
        if self.freedom is not None:
            found["degrees_of_freedom"] = self.freedom.numbers
        if self.errors is not None:
            found |= self.errors.numbers
        if self.inertial is not None:
            found["field_gyro_rms_rad_s"] = self.inertial.gyro_rms
            found["field_accelerometer_rms_m_s2"] = self.inertial.accelerometer_rms
        return found


def tracking_numbers(result: SlamResult) -> dict[str, Any]:
    """What tracking cost and how it went."""
    settled = result.frames.seconds[2:]  # the first two compile
    return {
        "frames": len(result.frames.lost),
        "frames_lost": int(result.frames.lost.sum()),
        "lost_frames": np.flatnonzero(result.frames.lost),
        "frames_uncertain": int(result.frames.uncertain.sum()),
        "uncertain_frames": np.flatnonzero(result.frames.uncertain),
        "pose_sigma_median": _medians(result.frames.sigma),
        "seconds_per_frame": float(np.median(settled)),
        "seconds_per_frame_mean_with_compilation": float(result.frames.seconds.mean()),
        "iterations_mean": float(result.frames.iterations[1:].mean()),
        "depth_error_median_m": trajectory_error.statistics(result.frames.depth_error).median,
        "keyframes": result.keyframes,
        "loops": loop_numbers(result),
        "bundle": bundle_numbers(result),
        "field_rmse_m": result.field_rmse_m,
        "field_rmse_deg": result.field_rmse_deg,
    }


def loop_numbers(result: SlamResult) -> dict[str, Any]:
    """What loops there were, and how far they have moved the camera."""
    moved = result.frames.T_world_body[:, :3, 3] - result.frames.T_odometry[:, :3, 3]
    believed = result.loops.believed
    return {
        "found": len(believed),
        "believed": int(believed.sum()),
        "frames": np.stack([result.loops.a, result.loops.b], axis=1)[believed],
        "moved_max_m": float(np.linalg.norm(moved, axis=1).max()) if believed.any() else 0.0,
    }


def bundle_numbers(result: SlamResult) -> dict[str, Any] | None:
    """What adjusting keyframes together found, and whether it was taken; None where it was not tried."""
    found = result.bundle
    if found is None:
        return None
    return {
        "keyframes": len(found.keyframes),
        "moved_max_m": found.moved_max,
        "depths_apart": found.depths_apart,
        "taken": found.agrees,
        "inflation": found.inflation,
    }


def freedom(recording: Recording, result: SlamResult) -> Freedom | None:
    """The effective degrees of freedom before and after (paper figure 6); None but for `intrinsic`."""
    if not np.isfinite(result.frames.T_inner[1:]).all():
        return None
    T_world_body = result.T_world_cam @ rigid.inverse(recording.T_body_cam)
    view = angle_of_view(recording.camera)[0]
    motions = (rigid.inverse(T_world_body[:-1]) @ T_world_body[1:], result.frames.T_inner[1:])
    before, after = (np.asarray(effective_dof(jnp.asarray(motion, jnp.float32), view)) for motion in motions)
    numbers = {"threshold": THRESHOLD, "before_mean": float(before.mean()), "after_mean": float(after.mean())}
    return Freedom(before, after, numbers)


def _medians(sigma: Float[np.ndarray, "n 2"]) -> dict[str, float]:
    """Medians over the frames of which something is known, NaN without any."""
    known = sigma[np.isfinite(sigma).all(axis=1)]
    metres, radians = np.median(known, axis=0) if len(known) else (np.nan, np.nan)
    return {"translation_m": float(metres), "rotation_deg": float(np.rad2deg(radians))}


def accuracy(
    result: SlamResult, t: Float[np.ndarray, " n"], T_world_true: Float[np.ndarray, "n 4 4"]
) -> Accuracy:
    """The usual trajectory errors of the tracked poses, and of the final field read at the frames' times."""
    ate = trajectory_error.ate(result.T_world_cam, T_world_true)
    aligned = trajectory_error.align(ate.alignment, result.T_world_cam)
    rotation_deg = np.degrees(rigid.rotation_angle(aligned[:, :3, :3], T_world_true[:, :3, :3]))
    turned_deg = orientation_error_deg(result.T_world_cam, T_world_true)
    wrong = (ate.errors > _WRONG_M) | (turned_deg > _WRONG_DEG)  # NaN, without ground truth, is neither
    field = jax.jit(jax.vmap(result.field.pose, (None, 0)))
    since_first = jnp.asarray(t - t[0], jnp.float32)
    field_poses = np.asarray(field(result.field_params, since_first), np.float64)
    numbers = {
        "alignment": "se3",
        "ate_rmse_m": ate.rmse,
        "ate_max_m": ate.max,
        "ate_rmse_without_loops_m": trajectory_error.ate(result.T_world_cam_odometry, T_world_true).rmse,
        "rotation_rmse_deg": trajectory_error.statistics(rotation_deg).rmse,
        "frames_with_ground_truth": ate.frames,
        "frames_wrong": int(wrong.sum()),
        "frames_wrong_and_marked": int((wrong & result.frames.uncertain).sum()),
        "rpe": _drift(result.T_world_cam, T_world_true),
        "field_ate_rmse_m": trajectory_error.ate(field_poses, T_world_true).rmse,
    }
    return Accuracy(aligned, ate.errors, rotation_deg, numbers)


def orientation_error_deg(
    T_world_cam: Float[np.ndarray, "n 4 4"], T_world_true: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, " n"]:
    """Errors of orientations less their mean.

    An alignment of positions turns the trajectory of a camera that hardly moves as it likes; this does not.

    Args:
        T_world_cam: estimated poses.
        T_world_true: ground truth, rows of NaN where there is none.

    Returns:
        Errors [deg], NaN where there is no ground truth.
    """
    known = np.isfinite(T_world_true).all(axis=(1, 2))
    R, R_true = T_world_cam[:, :3, :3], T_world_true[:, :3, :3]
    mean = rigid.nearest_rotation((R_true[known] @ np.swapaxes(R[known], 1, 2)).mean(0))
    turned = np.full(len(R), np.nan)
    turned[known] = np.degrees(rigid.rotation_angle(mean @ R[known], R_true[known]))
    return turned


def _drift(T_world_cam: Float[np.ndarray, "n 4 4"], T_world_true: Float[np.ndarray, "n 4 4"]):
    try:
        rpe = trajectory_error.rpe(T_world_cam, T_world_true)
    except DataError:  # no two frames in a row have a ground truth
        return None
    return {
        "delta_frames": 1,
        "translation_rmse_m": rpe.translation_m.rmse,
        "rotation_rmse_deg": rpe.rotation_deg.rmse,
        "pairs": rpe.pairs,
    }


def inertial(recording: Recording, result: SlamResult) -> Inertial | None:
    """The field's own body rate and acceleration beside what the IMU read; None without an IMU."""
    imu = recording.imu
    if imu is None:
        return None
    t, read_omega, read_force = (np.asarray(x) for x in imu)
    inside = np.flatnonzero((t >= recording.t[0]) & (t <= recording.t[-1]))
    if len(inside) == 0:
        return None
    chosen = inside[:: -(-len(inside) // _MOST_READINGS)]
    t, read_omega, read_force = t[chosen], read_omega[chosen], read_force[chosen]
    T_cam_body = jnp.asarray(rigid.inverse(recording.T_body_cam), jnp.float32)
    gravity_world = jnp.asarray(recording.gravity_world, jnp.float32)

    @jax.jit
    def derivatives(params, imu):
        body = body_to_camera(partial(result.field.pose, params), T_cam_body)  # here from camera to body
        at = jax.vmap(partial(motion, body))(imu.t)
        R_world_body = at.pose[:, :3, :3]
        field = jnp.einsum("nji,nj->ni", R_world_body, at.acceleration_world, precision="highest")
        return at.omega_body, remove_gravity(imu, R_world_body, gravity_world), field

    since_first = t - recording.t[0]
    readings = Imu(*(jnp.asarray(x, jnp.float32) for x in (since_first, read_omega, read_force)))
    omega, read, field = (np.asarray(x, np.float64) for x in derivatives(result.field_params, readings))
    gyro, accelerometer = (read_omega, omega), (read, field)
    rms = [float(np.sqrt(np.mean((a - b) ** 2))) for a, b in (gyro, accelerometer)]
    return Inertial(t, gyro, accelerometer, *rms)


def map_quality(result: SlamResult, render: Renderer) -> dict[str, Any]:
    """PSNR [dB] and mean depth error [m] of the map at mapped and at held-out frames; None without such."""
    kinds = {
        "mapped": result.frames.mapped & ~result.frames.lost,
        "held_out": ~result.frames.mapped & ~result.frames.lost,
    }
    return {"protocol": MAP_PROTOCOL} | {kind: _quality(render, chosen) for kind, chosen in kinds.items()}


def _quality(render: Renderer, chosen: Bool[np.ndarray, " n"]) -> dict[str, Any] | None:
    rows = []
    for i in evenly(np.flatnonzero(chosen), _MAP_FRAMES):
        seen = render(i)
        there = seen.depth > 0
        both = there & (seen.frame_depth > 0)
        if both.any():
            psnr = image_quality.psnr(np.clip(seen.rgb[there], 0, 1), seen.frame_rgb[there])
            error = np.abs(seen.depth - seen.frame_depth)[both].mean()
            rows.append((psnr, error, both.sum() / max((seen.frame_depth > 0).sum(), 1)))
    if not rows:
        return None
    psnr, error, share = np.mean(rows, axis=0)
    return {"psnr": psnr, "depth_l1_m": error, "depth_coverage": share, "frames": len(rows)}
