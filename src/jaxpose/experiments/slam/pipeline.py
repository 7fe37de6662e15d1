"""What the SLAM experiments do: run, measure, draw, and write the run folder."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments import command
from jaxpose.experiments.slam.callbacks import checkpoint_callback
from jaxpose.experiments.slam.evaluation import Measured, accuracy, cost, freedom, inertial
from jaxpose.experiments.slam.map_files import Renderer, SavedMap, map_quality, renderer, views, write_map
from jaxpose.experiments.slam.options import Options, Source, load, resume_fingerprint, slam_config
from jaxpose.experiments.slam.report import table
from jaxpose.fields import Params, PoseField, bspline
from jaxpose.fields.serialization import bspline_factor, write_field
from jaxpose.files import atomic, run_folder, trajectories
from jaxpose.files.camera_json import write_camera
from jaxpose.files.ply import write_ply
from jaxpose.plots import slam as slam_plots
from jaxpose.slam import ImuMode, Progress, SlamResult
from jaxpose.slam.checkpoint import load as load_checkpoint
from jaxpose.slam.initial_pose import first_pose
from jaxpose.slam.keyframes import keyframe_images
from jaxpose.slam.map.mesh import mesh, point_cloud
from jaxpose.slam.pipeline import run as track

OnFrame = Callable[[ImuMode, Progress], None]


class Outcome(NamedTuple):
    """Where a run was written, and its results; with `compare` those of each IMU mode under `modes`."""

    folder: Path
    results: dict[str, Any]


def run(experiment: str, options: Options, on_frame: OnFrame | None = None) -> Outcome:
    """Track the recording that the options name and write the run folder.

    With `compare` the folder holds one run folder for each IMU mode. Raises DataError or OSError for what
    cannot be used; then no folder is left behind.
    """
    started = time.perf_counter()
    source = load(options)
    path = run_folder.folder_path(experiment, name=options.name, out=options.out)
    with run_folder.opened(path) as folder:
        if options.compare:
            return Outcome(folder, _compare(experiment, options, source, folder, on_frame, started))
        results, _ = _single(experiment, options, source, folder, on_frame, started)
        return Outcome(folder, results)


def _compare(
    experiment: str, options: Options, source: Source, folder: Path, on_frame: OnFrame | None, started: float
) -> dict[str, Any]:
    """A run for each IMU mode, and all of them side by side."""
    by_mode, errors = {}, {}
    for mode in get_args(ImuMode):
        single = replace(options, compare=False, slam=replace(options.slam, imu=mode))
        with run_folder.opened(folder / mode) as inner:
            by_mode[mode], errors[mode] = _single(
                experiment, single, source, inner, on_frame, time.perf_counter()
            )
        jax.clear_caches()  # a mode's compiled steps are of no use to the next, and fill memory
    results = {
        "experiment": experiment,
        "seed": options.slam.seed,
        "modes": by_mode,
        "wall_s": time.perf_counter() - started,
        "peak_rss_bytes": run_folder.peak_rss_bytes(),
    }
    recording = source.recording
    if recording.T_world_cam is not None:
        rate = f"{len(recording.t)} frames at {source.about['rate_hz']:.3g} Hz"
        title = f"{recording.name}, {rate}: IMU modes, errors after SE(3) alignment"
        slam_plots.comparison(folder / "comparison.png", recording.t, errors, title)
    atomic.write_json(folder / "config.json", options)
    atomic.write_text(folder / "table.md", table(by_mode) + "\n")
    atomic.write_json(folder / "results.json", results)
    return results


def _single(
    experiment: str, options: Options, source: Source, folder: Path, on_frame: OnFrame | None, started: float
) -> tuple[dict[str, Any], Float[np.ndarray, " n"]]:
    """One tracked run, written: its results, and the translation error [m] of every frame."""
    recording, mode = source.recording, options.slam.imu
    checkpoint, finished = folder / "checkpoint.npz", folder / "results.json"
    if not command.resumes(folder, folder / "settings.json", resume_fingerprint(options), options.resume):
        checkpoint.unlink(missing_ok=True)
        finished.unlink(missing_ok=True)
    if finished.exists():
        return json.loads(finished.read_text()), _written_errors(folder, recording)
    config, state = slam_config(options), None
    if checkpoint.exists():
        state = load_checkpoint(checkpoint, recording, config)
    keep = checkpoint_callback(folder, recording, resume_fingerprint(options))

    def done(progress: Progress) -> None:
        keep(progress)
        if on_frame is not None:
            on_frame(mode, progress)

    result = track(recording, config, done, state)
    results, errors = _written(experiment, options, source, folder, result, started)
    atomic.write_json(finished, results)  # with it the run counts as finished
    checkpoint.unlink(missing_ok=True)
    return results, errors


def _written(
    experiment: str, options: Options, source: Source, folder: Path, result: SlamResult, started: float
) -> tuple[dict[str, Any], Float[np.ndarray, " n"]]:
    """A tracked recording measured and written, all but its results; the translation error of every frame."""
    recording, mode, ground_truth = source.recording, options.slam.imu, source.recording.T_world_cam
    errors = None if ground_truth is None else accuracy(result, recording.t, ground_truth)
    measured = Measured(errors, inertial(recording, result), freedom(recording, result))
    render = renderer(recording, result)
    _draw(folder, f"{recording.name}, IMU {mode}", recording, result, render, measured)
    trajectories.write_tum(
        folder / "trajectory.txt", trajectories.Trajectory(recording.t, result.T_world_cam)
    )
    if ground_truth is not None:
        trajectories.write_tum(folder / "reference.txt", trajectories.Trajectory(recording.t, ground_truth))
    span = (0.0, float(recording.t[-1] - recording.t[0]))
    write_field(folder / "field.npz", span, [bspline_factor(span, result.field_params)])
    values, texture = jax.tree.map(np.asarray, result.scene_params)
    write_map(folder / "map.npz", SavedMap(result.grid, values, texture, result.keyframes))
    images_folder = "." if options.data is None else options.data.resolve()
    notes = (*recording.notes, *first_pose(recording).notes, *_write_surface(folder, recording, result))
    write_camera(folder / "camera.json", recording.camera, recording.files, images_folder)
    atomic.write_json(folder / "config.json", options)
    results = {
        "experiment": experiment,
        "data": source.about,
        "imu": {"mode": mode, "readings": "not used" if mode == "none" else source.imu},
        "frame_of_reference": options.slam.frame,
        "seed": options.slam.seed,
        "smoke": options.smoke,
        **cost(result),
        **measured.numbers(),
        "map": map_quality(result, render),
        "notes": notes,
        "versions": run_folder.versions(),
        "wall_s": time.perf_counter() - started,
        "peak_rss_bytes": run_folder.peak_rss_bytes(),
    }
    return results, np.full(len(recording.t), np.nan) if errors is None else errors.translation_m


def _written_errors(folder: Path, recording: Recording) -> Float[np.ndarray, " n"]:
    """The translation errors [m] of a finished run, from its files."""
    if recording.T_world_cam is None:
        return np.full(len(recording.t), np.nan)
    return trajectory_error.ate(
        trajectories.read_tum(folder / "trajectory.txt").T, recording.T_world_cam
    ).errors


def _write_surface(folder: Path, recording: Recording, result: SlamResult) -> tuple[str, ...]:
    """The map as a point cloud and, where scikit-image is installed, as a mesh; a note where it is not."""
    keyframes = partial(keyframe_images, recording.read, result.keyframes, result.T_world_cam)
    points = point_cloud(keyframes(), recording.camera, result.grid.voxel)
    write_ply(folder / "points.ply", points.points, points.rgb)
    try:
        values, _ = result.scene_params
        surface = mesh(result.grid, np.asarray(values), keyframes(), recording.camera)
    except ImportError:
        return ('no mesh.ply: pip install "jaxpose[mesh]" for marching cubes',)
    write_ply(folder / "mesh.ply", surface.points, surface.rgb, surface.faces)
    return ()


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
    if errors is None:
        title = f"{name}: no ground truth to compare with"
        slam_plots.trajectory(folder / "trajectory.png", result.T_world_cam, None, result.frames.lost, title)
    else:
        ate = f"{name}: ATE-RMSE {100 * errors.numbers['ate_rmse_m']:.2f} cm after SE(3) alignment"
        slam_plots.trajectory(
            folder / "trajectory.png", errors.aligned, recording.T_world_cam, result.frames.lost, ate
        )
        slam_plots.errors(
            folder / "errors.png",
            recording.t,
            errors.translation_m,
            errors.rotation_deg,
            result.frames.lost,
            ate,
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


def load_field(folder: Path | str) -> tuple[PoseField, Params]:
    """The trajectory of a run folder as a field and its parameters: `field.pose(params, t)` is T_world_cam.

    `t` is in seconds on the clock of `trajectory.txt`, anywhere between its first and last. DataError for the
    folder of no SLAM run, or of one of before version 1 of the file (`io_field`).
    """
    path = Path(folder) / "field.npz"
    with np.load(path) as file:
        if "0.control_points" not in file:
            raise DataError(f"{path}: expected a B-spline in a trajectory of version 1, got neither")
        params, (first, last) = jnp.asarray(file["0.control_points"], jnp.float32), file["0.span"]
    return bspline((float(first), float(last)), params.shape[0] - 3), params
