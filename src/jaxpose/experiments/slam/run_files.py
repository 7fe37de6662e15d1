"""The files of a SLAM run: trajectory, field, map, point cloud, mesh, pictures."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxpose._memory import give_back_memory
from jaxpose.datasets.origin import moved
from jaxpose.datasets.types import Recording
from jaxpose.estimate import Sensors
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.experiments.slam.calibration import calibration_numbers
from jaxpose.experiments.slam.evaluation import (
    Measured,
    accuracy,
    freedom,
    inertial,
    map_quality,
    tracking_numbers,
)
from jaxpose.experiments.slam.map_file import write_map
from jaxpose.experiments.slam.map_rendering import Renderer, renderer, views
from jaxpose.experiments.slam.options import Options
from jaxpose.experiments.slam.source import Source
from jaxpose.fields import save, shifted
from jaxpose.fields.numpy_evaluator import load_covariance
from jaxpose.files import atomic, trajectories
from jaxpose.files.camera_json import write_camera
from jaxpose.files.ply import write_ply
from jaxpose.geometry.rigid import Similarity
from jaxpose.plots import slam as slam_plots
from jaxpose.slam import SlamResult, saved_map
from jaxpose.slam.initial_pose import first_pose
from jaxpose.slam.keyframes import keyframe_images
from jaxpose.slam.map.mesh import mesh, point_cloud


def write_run(
    folder: Path, options: Options, source: Source, result: SlamResult, on_update: OnUpdate
) -> tuple[dict[str, Any], Float[np.ndarray, " n"]]:
    """Measure a tracked recording and write all of its files but `results.json`.

    Args:
        folder: the run folder.
        options: the settings of the run.
        source: the recording.
        result: how it was tracked.
        on_update: called with what is done.

    Returns:
        What was measured, for the results, and the translation error [m] of every frame, NaN without ground
        truth.
    """
    if options.map is not None:
        source = _in_world_of_map(source, result)
    if result.posterior is not None:
        source = source._replace(recording=_as_estimated(source.recording, result.posterior.sensors))
    recording, ground_truth = source.recording, source.recording.T_world_cam

    def phase(name: str) -> None:
        give_back_memory()
        on_update(Update(name))

    phase("measuring the trajectory")
    errors = None if ground_truth is None else accuracy(result, recording.t, ground_truth)
    measured = Measured(errors, inertial(recording, result), freedom(recording, result))
    _write_trajectory(folder, source, result)
    phase("writing the map")
    write_map(folder / "map.npz", saved_map(result))
    images_folder = "." if options.data is None else options.data.resolve()
    write_camera(
        folder / "camera.json",
        recording.camera,
        recording.files,
        images_folder,
        depths=recording.depth_files,
        depth_per_metre=recording.depth_per_metre,
    )
    atomic.write_json(folder / "config.json", options)
    phase("writing the point cloud")
    _write_points(folder / "points.ply", recording, result)
    phase("writing the mesh")
    world = first_pose(recording).notes if options.map is None else _map_notes(options.map, ground_truth)
    notes = (*recording.notes, *world, *_coarser_notes(options, result))
    notes = (*notes, *_write_mesh(folder / "mesh.ply", recording, result))
    phase("rendering the map")
    render = renderer(recording, result)
    quality = map_quality(result, render)
    phase("drawing figures")
    _draw(folder, f"{recording.name}, IMU {options.slam.imu}", recording, result, render, measured)
    calibration = {} if result.posterior is None else {"calibration": calibration_numbers(result.posterior)}
    found = {**tracking_numbers(result), **measured.numbers(), **calibration, "map": quality, "notes": notes}
    return found, np.full(len(recording.t), np.nan) if errors is None else errors.translation_m


def _as_estimated(recording: Recording, found: Sensors) -> Recording:
    """The recording with the IMU where and when it was found to be; the same where neither was estimated."""
    imu = recording.imu and recording.imu._replace(t=np.asarray(recording.imu.t) - found.offset_s)
    return recording._replace(imu=imu, T_body_cam=found.T_body_cam)


def _in_world_of_map(source: Source, result: SlamResult) -> Source:
    """The recording with its true poses moved by SE(3) into the world of the map that was begun in."""
    recording = source.recording
    if (ground_truth := recording.T_world_cam) is not None:
        fit = trajectory_error.ate(ground_truth, result.T_world_cam).alignment
        recording = recording._replace(T_world_cam=trajectory_error.align(fit, ground_truth))
    return source._replace(recording=recording, origin=np.zeros(3))


def _map_notes(earlier: Path, ground_truth: Float[np.ndarray, "n 4 4"] | None) -> tuple[str, ...]:
    """In which world a run is that has begun in the map of an earlier one."""
    world = f"the world and the map are those of {earlier}, gone on with; points.ply is of this run alone"
    if ground_truth is None:
        return (world,)
    return world, "the true poses are of another world: moved onto the estimate by SE(3)"


def _coarser_notes(options: Options, result: SlamResult) -> tuple[str, ...]:
    """Where the map has reached its budget."""
    voxels = result.map_config.voxel * 0.5 ** np.arange(len(result.coarser_at))[::-1]
    budget = f"the map reached --map-budget-gb {options.slam.map_budget_gb:g}"
    return tuple(
        f"frame {i}: {budget} and was made anew from keyframes, with voxels of {100 * voxel:.1f} cm"
        for i, voxel in zip(result.coarser_at.tolist(), voxels.tolist(), strict=True)
    )


def _write_trajectory(folder: Path, source: Source, result: SlamResult) -> None:
    """The poses of the frames, the ground truth, and the continuous trajectory.

    In the world of the recording's files, and on their clock.
    """
    recording, origin = source.recording, source.origin
    ground_truth, known = recording.T_world_cam, result.covariances
    in_files = lambda T: trajectories.Trajectory(recording.t, moved(T, origin), recording.t0_ns)
    first = recording.t0_ns / 10**9 + float(recording.t[0])
    trajectories.write_tum(folder / "trajectory.txt", in_files(result.T_world_cam))
    if ground_truth is not None:
        trajectories.write_tum(folder / "reference.txt", in_files(ground_truth))
    alignment = Similarity(1.0, np.eye(3), origin) if origin.any() else None
    save(
        folder / "field.npz",
        shifted(result.field, first),
        result.field_params,
        alignment=alignment,
        covariance=known and known._replace(t=known.t + first),
    )


def _write_points(file: Path, recording: Recording, result: SlamResult) -> None:
    """What the keyframes measured, as a point cloud."""
    keyframes = keyframe_images(recording.read, result.keyframes, result.T_world_cam)
    points = point_cloud(keyframes, recording.camera, result.map_config.voxel)
    write_ply(file, points.points, points.rgb)


def _write_mesh(file: Path, recording: Recording, result: SlamResult) -> tuple[str, ...]:
    """The map as a mesh, where scikit-image is installed; a note where it is not."""
    keyframes = keyframe_images(recording.read, result.keyframes, result.T_world_cam)
    blocks, earlier = result.scene_params[0], 0 if result.earlier is None else len(result.earlier.coords)
    try:
        surface = mesh(result.map_config, blocks, keyframes, recording.camera, earlier)
    except ImportError:
        return ('no mesh.ply: pip install -e ".[mesh]" for marching cubes',)
    write_ply(file, surface.points, surface.rgb, surface.faces)
    return ()


def _covariance(recording: Recording, result: SlamResult) -> Float[np.ndarray, "n 6 6"] | None:
    """How sure the poses of the frames are, where that is known."""
    known = result.covariances
    if known is None:
        return None
    at = load_covariance({"covariance_times": known.t, "covariance": known.pose})
    return at(np.clip(recording.t - recording.t[0], known.t[0], known.t[-1]))


def _draw(
    folder: Path,
    name: str,
    recording: Recording,
    result: SlamResult,
    render: Renderer,
    measured: Measured,
) -> None:
    """The pictures of a run, poses aligned as their errors are."""
    errors, motion, freed = measured
    name = f"{name}, {len(recording.t)} frames"
    covariance = _covariance(recording, result)
    if errors is None:
        title = f"{name}: no ground truth to compare with"
        slam_plots.trajectory(
            folder / "trajectory.png", result.T_world_cam, None, result.frames.lost, title, covariance
        )
    else:
        ate = f"{name}: ATE-RMSE {100 * errors.numbers['ate_rmse_m']:.2f} cm after SE(3) alignment"
        slam_plots.trajectory(
            folder / "trajectory.png",
            errors.aligned,
            recording.T_world_cam,
            result.frames.lost,
            ate,
            covariance,
        )
        slam_plots.errors(
            folder / "errors.png",
            recording.t,
            errors.translation_m,
            errors.rotation_deg,
            result.frames.lost,
            ate,
            covariance,
        )
    slam_plots.renders(
        folder / "renders.png",
        views(recording, result, render),
        f"{name}: the map seen from the estimated poses",
    )
    if motion is not None:
        title = f"{name}: IMU against the derivatives of the final field"
        slam_plots.inertial(folder / "inertial.png", motion.t, motion.gyro, motion.accelerometer, title)
    if freed is not None:
        title = f"{recording.name}: motion from frame to frame, before and in the intrinsic frame"
        slam_plots.freedom(folder / "freedom.png", recording.t[1:], freed.before, freed.after, title)
