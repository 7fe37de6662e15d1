"""NeRF from asynchronous events: a scene and the trajectory of an event camera optimised together.

Without options: the events of one turn around an object, made on the fly, its positions known at 10 instants
and linear between, PoseNet against that, a run folder under outputs/event_nerf. `--data` reads EventNeRF's
folders, DAVIS text, HDF5 (DSEC) and npz. `--study known` puts both trajectories side by side for 20, 10 and 6
known instants (table 4), `--study offset` for a turntable whose axis is wrong.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.evaluation import trajectory_error
from jaxpose.experiments import devices, training_loop
from jaxpose.experiments.command import MODULE, Command, execute
from jaxpose.experiments.devices import Job
from jaxpose.experiments.event_nerf.evaluation import PROTOCOL, GroundTruth, Measured, find_truth, measure
from jaxpose.experiments.event_nerf.model import Model, build, describe
from jaxpose.experiments.event_nerf.options import (
    GROUPS,
    ORBIT,
    Config,
    Problem,
    begin,
    load,
    read,
    resume_fingerprint,
    studies,
)
from jaxpose.experiments.event_nerf.report import describe_step, report, table
from jaxpose.experiments.outcome import Outcome, read_results
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.experiments.training_loop import Loaded, Trained
from jaxpose.fields import save
from jaxpose.files import atomic, run_folder, trajectories
from jaxpose.files.camera_json import write_camera
from jaxpose.plots import events as event_plots
from jaxpose.plots import nerf as nerf_plots
from jaxpose.training.steps import State


def run(config: Config, on_update: OnUpdate = silent) -> Outcome:
    """Train, measure and write the run folder; `resume` goes on where a killed run stopped.

    Args:
        config: the data and how to train on them.
        on_update: called with what the run is doing.

    Returns:
        The run folder, and its results; those of a study under `runs`, by label.

    Raises:
        DataError, OSError: for what cannot be read, trained on or written; then no folder is left behind.
    """
    started = time.perf_counter()
    path = run_folder.folder_path("event_nerf", name=config.name, out=config.out)
    on_update(Update(f"run folder {path}"))
    job = devices.join(config.devices, resume_fingerprint(config), on_update)
    on_update(Update("making the events" if config.data == ORBIT else f"reading {config.data}"))
    recording = read(config)
    problem = begin(config, recording, on_update)
    with devices.opened(job, path) as folder:
        if config.study is None:
            return Outcome(folder, _single(config, problem, folder, job, on_update, ""))
        results = {}
        for label, changed in studies(config, config.study).items():
            changed = replace(changed, study=None)
            with run_folder.opened(folder / label) as inner:
                begun = begin(changed, recording, on_update)
                results[label] = _single(changed, begun, inner, job, on_update, label)
        return training_loop.write_study(folder, "event_nerf", config, results, table(results), started)


def load_run(folder: Path | str) -> Loaded[Problem, Model]:
    """What a run has left in its folder.

    Args:
        folder: the run folder.

    Returns:
        Data, model and its trained state.

    Raises:
        DataError, OSError: for a folder that holds no such run.
    """
    return training_loop.load_run(folder, Config, load, build)


def main(args: Sequence[str] | None = None, prog: str = MODULE + "event_nerf") -> None:
    """The command `jaxpose events`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    execute(Command(prog, Config, __doc__, run, lambda result: report(*result), GROUPS), args)


def _single(
    config: Config, problem: Problem, folder: Path, job: Job, on_update: OnUpdate, label: str
) -> dict[str, Any]:
    """One training, measured and written; what a killed or finished run has left is used with `resume`."""
    started = time.perf_counter()
    finished = folder / "results.json"
    if job.writes:
        training_loop.set_up_run_folder(folder, config, resume_fingerprint(config))
    if devices.from_first(job, job.writes and finished.exists()):
        return read_results(finished, "event_nerf") if job.writes else devices.followed(job)
    model = build(config, problem)
    ground_truth = find_truth(problem)
    checkpoint = folder / "checkpoint.npz"
    trained = _train(config, problem, model, ground_truth, checkpoint, job, on_update, label)
    devices.leave(job)
    if not job.writes:
        return devices.followed(job)
    measured = measure(problem, model, trained.state, ground_truth, on_update)
    on_update(Update("drawing figures"))
    _draw(folder, config, problem, measured, ground_truth)
    _write_poses(folder, problem, model, trained.state, measured)
    results = training_loop.results_of(
        "event_nerf",
        config,
        trained,
        started,
        data=problem.metadata,
        training=describe(config, model),
        protocol=PROTOCOL,
        **measured.numbers,
    )
    atomic.write_json(finished, results)  # last: with it the run counts as finished
    return results


def _train(
    config: Config,
    problem: Problem,
    model: Model,
    ground_truth: GroundTruth | None,
    checkpoint: Path,
    job: Job,
    on_update: OnUpdate,
    label: str,
) -> Trained:
    devices.check_divides(job, "--events", model.train.events)
    if ground_truth is None:
        errors = lambda params: (np.nan, np.nan)
    else:
        poses = training_loop.pose_reader(model.field, ground_truth.t)
        errors = lambda params: training_loop.mean_errors(poses(params), ground_truth.T_world_cam)

    return training_loop.train(
        model,
        training_loop.initial_state(model, config.seed),
        model.data,
        errors,
        checkpoint,
        on_update,
        job=job,
        precision=config.precision,
        label=label,
        describe=describe_step,
    )


def _draw(
    folder: Path, config: Config, problem: Problem, measured: Measured, ground_truth: GroundTruth | None
) -> None:
    numbers, about, recording = measured.numbers, problem.metadata, problem.recording
    title = f"{about['data']}, {about['events']} events\n{about['poses']}"
    method = f"{config.pose}, {config.loss} loss"
    camera = recording.camera
    event_plots.windows(folder / "events.png", recording.events, camera.height, camera.width, title)
    if ground_truth is not None and measured.at_start is not None and measured.at_end is not None:
        before, after = (
            (errors.rotation_errors_deg, errors.translation_errors)
            for errors in (measured.at_start, measured.at_end)
        )
        found = (
            f"{method}: translation error {numbers['start']['translation_error']:.4f} to "
            f"{numbers['translation_error']:.4f} units, rotation "
            f"{numbers['start']['rotation_error_deg']:.2f} to {numbers['rotation_error_deg']:.2f} deg"
        )
        event_plots.errors(folder / "pose_errors.png", ground_truth.t, before, after, f"{title}\n{found}")
    if measured.held_out:
        about_views = f"{title}\n{method}, held-out PSNR {numbers['psnr']:.2f} dB"
        nerf_plots.held_out(folder / "held_out.png", measured.held_out, about_views)
    if measured.frames:
        about_views = f"{title}\n{method}, PSNR {numbers['frames']['psnr']:.2f} dB"
        nerf_plots.held_out(
            folder / "frames.png", measured.frames, about_views, photograph="the camera's own image"
        )


def _write_poses(folder: Path, problem: Problem, model: Model, state: State, measured: Measured) -> None:
    """The trajectory, aligned with ground truth where there is any.

    At its timestamps and as a continuous field.
    """
    recording, (first, last) = problem.recording, problem.span
    t = recording.t[(recording.t >= first) & (recording.t <= last)]
    if len(t) < 2:
        t = np.linspace(first, last, 100)
    else:
        reference = recording.T_world_cam[np.isin(recording.t, t)]
        trajectories.write_tum(folder / "reference.txt", trajectories.Trajectory(t, reference))
    estimate = trajectory_error.align(
        measured.alignment, training_loop.pose_reader(model.field, t)(state.pose)
    )
    trajectories.write_tum(folder / "trajectory.txt", trajectories.Trajectory(t, estimate))
    trajectories.write_tum(folder / "start.txt", problem.start)
    save(folder / "field.npz", model.field, state.pose, alignment=measured.alignment)
    write_camera(folder / "camera.json", recording.camera, (), ".")
