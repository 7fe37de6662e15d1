"""The recording that a SLAM run tracks: read or made, given an IMU, cut and thinned."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxpose.datasets.origin import far_origin, moved
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.datasets.rgbd.imu_csv import imu_notes, with_imu
from jaxpose.datasets.synthetic import room
from jaxpose.datasets.types import Recording, prefetch, select, thin
from jaxpose.errors import DataError
from jaxpose.experiments.slam.options import FEWEST_FRAMES, SMOKE_FRAMES, Options, room_config
from jaxpose.geometry import rigid
from jaxpose.imu import ADIS16448, QUIET, Imu, ImuNoise
from jaxpose.imu.eskf import PoseNoise
from jaxpose.imu.filtering import filter_imu
from jaxpose.imu.simulation import simulate_from_poses
from jaxpose.slam.initial_pose import first_force, is_gravity

SIMULATED_HZ = 200.0  # of the IMU made for recordings that have none
_RECORDED_HZ = 30.0  # frame rate of recordings that have no timestamps and say nothing
_FAR_M = 1e3  # float32 holds 0.06 mm there
_POSE_NOISE = PoseNoise(1e-3, 2e-3)  # [m, rad] what motion capture is good for


class Source(NamedTuple):
    """A recording ready to be tracked, and where it comes from in words and numbers."""

    recording: Recording
    metadata: dict[str, Any]
    imu: str  # where the inertial readings come from
    origin: np.ndarray = np.zeros(3)  # (3,) [m] of the recording's world in that of its files


def load(options: Options) -> Source:
    """The recording that the options name: loaded or made, given an IMU if one is needed, cut and thinned.

    An IMU is simulated from the ground truth before frames are thinned, unless the recording has its own.

    Args:
        options: the settings of the run.

    Returns:
        The recording; time starts at the first frame used.

    Raises:
        DataError, OSError: for what cannot be used.
    """
    if options.data is None:
        name, recording, own_imu = "room", room(room_config(options)), options.room.along is not None
        noise = options.room.imu_noise
        imu = f"{options.room.imu_rate_hz:g} Hz, exact derivatives of the room's path, {_sheet(noise)}"
    else:
        name = options.format or rgbd_registry.find_format(options.data)
        if options.recorded_hz is not None and rgbd_registry.has_timestamps(options.data, name):
            raise DataError(f"{options.data}: expected no --recorded-hz, as its frames have timestamps")
        recording = rgbd_registry.load_recording(
            options.data, name, rate_hz=options.recorded_hz or _RECORDED_HZ, topics=options.topics
        )
        if options.imu_file is not None and options.imu_extrinsics is not None:
            recording = with_imu(recording, options.imu_file, options.imu_extrinsics)
        imu, own_imu = "none", recording.imu is not None
        if not own_imu and (options.compare or options.slam.imu != "none"):
            recording = recording._replace(imu=_simulated(recording, options))
            gravity = " ".join(f"{x:.3g}" for x in recording.gravity_world)
            imu = (
                f"simulated at {SIMULATED_HZ:g} Hz from ground truth before thinning (cubic spline "
                f"positions, {options.imu_rotation or 'slerp'} rotations, gravity {gravity} m/s^2), "
                f"{_sheet(options.slam.imu_noise)}, seed {options.slam.seed}"
            )
    if own_imu:
        if options.imu_rotation is not None:
            raise DataError(f"{recording.name}: expected no --imu-rotation, as the recording has its own IMU")
        recording, imu = _own_readings(recording, options)
    elif options.imu_filter or options.imu_offset_s:
        option = "--imu-filter" if options.imu_filter else "--imu-offset-s"
        raise DataError(f"{recording.name}: {option} expected a recording with its own IMU, got none")
    recorded = len(recording.t)
    recording, origin = _near_origin(_cut(recording, options))
    if own_imu:
        _check_gravity(recording, options)
    metadata = {
        "name": recording.name,
        "format": name,
        "path": options.data,
        "frames_recorded": recorded,
        "start": options.start,
        "rate_hz": 1 / float(np.median(np.diff(recording.t))),
        "size": (recording.camera.width, recording.camera.height),
    }
    return Source(prefetch(recording), metadata, imu, origin)


def _near_origin(recording: Recording) -> tuple[Recording, np.ndarray]:
    """The recording in a world whose origin float32 can work at, and where that is in its files."""
    origin = far_origin(recording.T_world_cam, _FAR_M)
    if recording.T_world_cam is None or not origin.any():
        return recording, origin
    at = " ".join(f"{x:.0f}" for x in origin)
    note = f"map.npz, points.ply and mesh.ply are relative to {at}, as float32 has not the digits"
    near = moved(recording.T_world_cam, -origin)
    return recording._replace(T_world_cam=near, notes=(*recording.notes, note)), origin


def _sheet(noise: ImuNoise) -> str:
    """A data sheet in words."""
    if noise == QUIET:
        return "no noise"
    return "ADIS16448's noise" if noise == ADIS16448 else f"noise {noise}"


def _own_readings(recording: Recording, options: Options) -> tuple[Recording, str]:
    """The recording with its own readings as they are to be used, and what they are in words."""
    imu = recording.imu
    assert imu is not None
    imu = imu._replace(t=np.asarray(imu.t) + options.imu_offset_s)
    recording = recording._replace(imu=imu)
    if options.compare or options.slam.imu != "none":
        notes = imu_notes(recording, options.imu_file or recording.name)
        recording = recording._replace(notes=(*recording.notes, *notes))
    source = "the recording's own" if options.imu_file is None else f"of {options.imu_file.name}"
    what = f"{1 / float(np.median(np.diff(imu.t))):.3g} Hz, {source}, as read"
    if options.imu_offset_s:
        what += f", {options.imu_offset_s:+g} s"
    if options.imu_filter:
        imu = _unbiased(recording, imu, options)
        what += ", less the biases that a Kalman filter finds on the true poses"
    return recording._replace(imu=imu), what


def _unbiased(recording: Recording, imu: Imu, options: Options) -> Imu:
    """Readings less their biases by the error-state filter on the true poses (paper section 4.3)."""
    if recording.T_world_cam is None:
        raise DataError(f"{recording.name}: --imu-filter expected true poses, got none")
    ground_truth = recording.T_world_cam @ rigid.inverse(recording.T_body_cam)
    with jax.enable_x64(True):
        found = filter_imu(
            imu,
            recording.t,
            ground_truth,
            options.slam.imu_noise,
            _POSE_NOISE,
            gravity_world=tuple(recording.gravity_world.tolist()),
        )
    known = np.isfinite(found.gyro_bias).all(axis=1)
    return Imu(
        found.t[known],
        np.asarray(imu.omega_body)[known] - found.gyro_bias[known],
        np.asarray(imu.acceleration_body)[known] - found.accelerometer_bias[known],
    )


def _simulated(recording: Recording, options: Options) -> Imu:
    """Readings of an IMU at the camera, from the true poses."""
    ground_truth = recording.T_world_cam
    if ground_truth is None or np.isfinite(ground_truth).all(axis=(1, 2)).sum() < FEWEST_FRAMES:
        mode = "--compare" if options.compare else f"--imu {options.slam.imu}"
        raise DataError(
            f"{recording.name}: {mode} expected true poses to simulate an IMU from, got none; "
            "--imu none goes without"
        )
    return simulate_from_poses(
        recording.t,
        ground_truth @ rigid.inverse(recording.T_body_cam),
        SIMULATED_HZ,
        rotation=options.imu_rotation or "slerp",
        noise=options.slam.imu_noise,
        key=jax.random.fold_in(jax.random.key(options.slam.seed), 200),
        gravity_world=recording.gravity_world,
    )


def _check_gravity(recording: Recording, options: Options) -> None:
    """Refuse real readings where nothing says which way is down: no true pose, and no gravity in them."""
    ground_truth = recording.T_world_cam
    if options.slam.imu == "none" and not options.compare:
        return
    if ground_truth is not None and np.isfinite(ground_truth[0]).all():
        return
    force, gravity = first_force(recording), np.linalg.norm(recording.gravity_world)
    if force is None or not is_gravity(force, recording.gravity_world):
        mode = "--compare" if options.compare else f"--imu {options.slam.imu}"
        got = "none there" if force is None else f"{np.linalg.norm(force):.3g}: check the units"
        raise DataError(
            f"{recording.name}: {mode} expected readings around frame {options.start}, which has no true "
            f"pose, whose mean is gravity's {gravity:.3g} m/s^2, got {got}; --imu none goes without"
        )


def _cut(recording: Recording, options: Options) -> Recording:
    """The frames asked for, thinned; the clock stays the recording's."""
    count = len(recording.t)
    if options.start >= count:
        raise DataError(
            f"{recording.name}: expected --start below {count}, the frames it has, got {options.start}"
        )
    stop = count if options.frames is None else options.start + options.frames
    if stop > count:
        raise DataError(
            f"{recording.name}: expected --frames of at most {count - options.start}, those from --start "
            f"{options.start} on, got {options.frames}"
        )
    recording = select(recording, np.arange(options.start, stop))
    if options.rate_hz is not None:
        recording = thin(recording, options.rate_hz)
    if options.smoke:
        recording = select(recording, np.arange(min(len(recording.t), SMOKE_FRAMES)))
    if len(recording.t) < FEWEST_FRAMES:
        raise DataError(
            f"{recording.name}: expected at least {FEWEST_FRAMES} frames to track, got {len(recording.t)} "
            f"from frame {options.start} at {options.rate_hz or options.recorded_hz or _RECORDED_HZ:g} Hz"
        )
    ground_truth, notes = recording.T_world_cam, recording.notes
    if ground_truth is not None and np.isfinite(ground_truth).all(axis=(1, 2)).sum() < FEWEST_FRAMES:
        ground_truth, notes = (
            None,
            (*notes, "too few true poses among the frames used: there is no ground truth to compare with"),
        )
    return recording._replace(
        T_world_cam=ground_truth,
        notes=notes,
    )
