"""NeRF from noisy or unknown poses: a scene and the cameras' trajectory optimised together from photographs.

Without options: 100 views of an object on an orbit made on the fly, poses disturbed by smooth noise of 20%
of the orbit's diameter, PoseNet against it, a run folder under outputs/noisy_nerf. `--data DIR` reads
photographs with poses (Blender, nerfstudio, instant-ngp, LLFF). `--study fields` puts all pose fields side
by side.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float

from jaxpose.datasets.lens import as_camera
from jaxpose.datasets.origin import moved
from jaxpose.datasets.photos import blender
from jaxpose.datasets.photos.registry import find_format, images_folder
from jaxpose.datasets.photos.sigmas import write_sigmas
from jaxpose.datasets.photos.transforms_json import stated, write_transforms
from jaxpose.evaluation.trajectory_error import align, procrustes
from jaxpose.experiments import devices, training_loop
from jaxpose.experiments.command import MODULE, Command, execute
from jaxpose.experiments.devices import Job
from jaxpose.experiments.noisy_nerf import registration
from jaxpose.experiments.noisy_nerf.evaluation import (
    CONTRADICTED_PROTOCOL,
    PROTOCOL,
    UNPOSED_PROTOCOL,
    Measured,
    measure,
)
from jaxpose.experiments.noisy_nerf.model import (
    Model,
    build,
    describe,
    found_shutter,
    splined,
)
from jaxpose.experiments.noisy_nerf.options import (
    GROUPS,
    ORBIT,
    Config,
    Problem,
    load,
    resume_fingerprint,
    studies,
)
from jaxpose.experiments.noisy_nerf.registration import Registered
from jaxpose.experiments.noisy_nerf.report import describe_step, report, table
from jaxpose.experiments.outcome import Outcome, read_results
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.experiments.training_loop import Loaded, Trained
from jaxpose.fields import save
from jaxpose.files import atomic, run_folder, trajectories
from jaxpose.files.camera_json import write_camera
from jaxpose.plots import nerf as nerf_plots
from jaxpose.plots.nerf import History

_REGISTRATION = "registration.npz"


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
    path = run_folder.folder_path("noisy_nerf", name=config.name, out=config.out)
    on_update(Update(f"run folder {path}"))
    job = devices.join(config.devices, resume_fingerprint(config), on_update)
    on_update(Update("making the photographs" if config.data == ORBIT else f"reading {config.data}"))
    problem = load(config)
    with devices.opened(job, path) as folder:
        if config.study is None:
            return Outcome(folder, _single(config, problem, folder, job, on_update, ""))
        results, histories = {}, {}
        for label, changed in studies(config, config.study).items():
            with run_folder.opened(folder / label) as inner:
                results[label] = _single(replace(changed, study=None), problem, inner, job, on_update, label)
            histories[label] = _history(np.array(results[label]["history"], float))
        nerf_plots.curves(folder / "curves.png", histories, f"{_title(problem)}: {config.study}")
        return training_loop.write_study(folder, "noisy_nerf", config, results, table(results), started)


def train(
    config: Config,
    problem: Problem,
    model: Model,
    checkpoint: Path,
    job: Job,
    on_update: OnUpdate,
    label: str,
) -> Trained:
    """Train to the end, from the checkpoint if there is one, and keep one as it goes."""
    devices.check_divides(job, "--rays", model.train.rays)
    poses = training_loop.pose_reader(model.field, problem.train.t)

    def between(state):
        smooth = splined(state.pose, problem.train.t, config.spline_knots, config.spline_smoothing)
        return state._replace(pose=smooth)

    return training_loop.train(
        model,
        training_loop.initial_state(model, config.seed),
        model.views,
        lambda params: training_loop.mean_errors(poses(params), problem.train.T_world_cam),
        checkpoint,
        on_update,
        job=job,
        precision=config.precision,
        label=label,
        describe=partial(describe_step, problem.extent),
        between=between if config.pose == "spline_reset" else model.between,
    )


def load_run(folder: Path | str) -> Loaded[Problem, Model]:
    """What a run has left in its folder.

    Args:
        folder: the run folder.

    Returns:
        Data, model and its trained state.

    Raises:
        DataError, OSError: for a folder that holds no such run.
    """

    def rebuilt(config: Config, problem: Problem) -> Model:
        return build(config, problem, _stored(Path(folder), problem))

    return training_loop.load_run(folder, Config, load, rebuilt)


def main(args: Sequence[str] | None = None, prog: str = MODULE + "noisy_nerf") -> None:
    """The command `jaxpose nerf`.

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
    checkpoint, finished = folder / "checkpoint.npz", folder / "results.json"
    if job.writes:
        training_loop.set_up_run_folder(folder, config, resume_fingerprint(config))
    if devices.from_first(job, job.writes and finished.exists()):
        return read_results(finished, "noisy_nerf") if job.writes else devices.followed(job)
    registered = _registered(config, problem, folder, job, on_update)
    model = build(config, problem, registered)
    trained = train(config, problem, model, checkpoint, job, on_update, label)
    devices.leave(job)
    if not job.writes:
        return devices.followed(job)
    poses_at = lambda t: training_loop.pose_reader(model.field, t)(trained.state.pose)
    contradicted = config.noise == "none" and registered is not None and not registered.given
    T_held_out = poses_at(problem.held_out.t) if contradicted else None
    T_world_cam = poses_at(problem.train.t)
    measured = measure(config, problem, model, trained.state, T_world_cam, T_held_out, on_update)
    if contradicted and registered and problem.sigmas is not None:  # which hold the world
        to_world = procrustes(T_world_cam, registered.T_world_cam)
        measured = measured._replace(T_estimate=align(to_world, T_world_cam), alignment=to_world)
    protocol = CONTRADICTED_PROTOCOL if contradicted else PROTOCOL
    on_update(Update("drawing figures"))
    _draw(folder, config, problem, measured, trained)
    _write_poses(folder, config, problem, measured)
    sigmas = None if registered is None else registration.final_sigmas(registered, measured.T_estimate)
    if sigmas is not None:
        write_sigmas(folder / "sigmas.csv", problem.train.files, sigmas.of_poses)
    to_data = measured.alignment._replace(translation=measured.alignment.translation + problem.origin)
    save(folder / "field.npz", model.field, trained.state.pose, alignment=to_data)
    results = training_loop.results_of(
        "noisy_nerf",
        config,
        trained,
        started,
        data=problem.metadata,
        registration=registration.summary(problem, registered),
        training=describe(config, model),
        protocol=protocol if measured.posed else UNPOSED_PROTOCOL,
        sigmas=None if sigmas is None else sigmas.numbers(),
        shutter=found_shutter(config, model, trained.state.pose),
        **measured.numbers,
    )
    atomic.write_json(finished, results)  # last: with it the run counts as finished
    return results


def _registered(
    config: Config, problem: Problem, folder: Path, job: Job, on_update: OnUpdate
) -> Registered | None:
    """The registration that a killed run has left, or a new one; None with presets that do without."""
    if config.preset != "fast" or config.smoke:
        return None
    found = _stored(folder, problem)
    if found is None:
        found = registration.register(config, problem, on_update)
        if found is None:
            unused = "" if problem.sigmas is None else "; --pose-sigmas then weighs nothing"
            on_update(
                Update(f"too few features are shared: poses by the colours, as with --preset joint{unused}")
            )
        elif job.writes:
            registration.save(folder / _REGISTRATION, found)
    return found


def _stored(folder: Path, problem: Problem) -> Registered | None:
    stored = folder / _REGISTRATION
    return registration.load(stored, len(problem.train.t)) if stored.exists() else None


def _draw(folder: Path, config: Config, problem: Problem, measured: Measured, trained: Trained) -> None:
    numbers, title = measured.numbers, _title(problem)
    start, stated = numbers["start"], config.noise == "none"  # the start is then what one compares with
    if not measured.posed:
        found = f"{config.pose}: no poses are known to compare with"
    elif stated:
        found = (
            f"{config.pose}: away from the poses of the data by {numbers['rotation_error_deg']:.3f} deg and "
            f"{numbers['translation_error_percent']:.3f}% of the cameras' extent"
        )
    else:
        found = (
            f"{config.pose}: rotation {start['rotation_error_deg']:.2f} to "
            f"{numbers['rotation_error_deg']:.3f} deg, translation "
            f"{start['translation_error_percent']:.2f} to "
            f"{numbers['translation_error_percent']:.3f}% of the cameras' extent"
        )
    ground_truth = problem.train.T_world_cam if measured.posed and not stated else None
    nerf_plots.cameras(
        folder / "cameras.png", ground_truth, measured.T_start, measured.T_estimate, f"{title}\n{found}"
    )
    kind = "held-out" if measured.posed else "training"
    psnr = f"{config.pose}, {kind} PSNR {numbers['psnr']:.2f} dB"
    nerf_plots.held_out(
        folder / f"{kind.replace('-', '_')}.png",
        measured.views,
        f"{title}\n{psnr}",
        photograph=f"{kind} photograph",
    )
    nerf_plots.curves(folder / "curves.png", {config.pose: _history(trained.history)}, f"{title}\n{found}")


def _write_poses(folder: Path, config: Config, problem: Problem, measured: Measured) -> None:
    """The refined poses, aligned with the data's own world, as a trajectory and as transforms.json."""
    photographs = problem.train
    in_data = lambda T: moved(T, problem.origin)
    refined = photographs._replace(T_world_cam=in_data(measured.T_estimate))
    poses = {"trajectory.txt": measured.T_estimate}
    if measured.posed:
        poses["reference.txt"] = photographs.T_world_cam
    for name, T in poses.items():
        trajectories.write_tum(folder / name, trajectories.Trajectory(photographs.t, in_data(T)))
    with atomic.atomic(folder / "start.npz") as temporary:
        np.savez(temporary, t=photographs.t, T_world_cam=in_data(problem.T_start))
    images = images_folder(config.data).resolve() if photographs.lenses else "."
    # The camera of the run is that of the files only where they were not brought to another.
    own = len(set(photographs.lenses)) == 1 and as_camera(photographs.lenses[0]) is not None
    names = photographs.files if own or not photographs.lenses else ()
    write_camera(folder / "camera.json", photographs.camera, names, images)
    for part in () if photographs.lenses else (photographs, problem.held_out):  # on no disk yet
        for name, rgb in zip(part.files, part.rgb, strict=True):
            (folder / name).parent.mkdir(exist_ok=True)
            imageio.imwrite(folder / name, rgb)
    if config.data == ORBIT:
        write_transforms(folder / "transforms_test.json", problem.held_out)
        write_transforms(folder / "transforms_train.json", refined)
    elif find_format(config.data) == "transforms":
        write_transforms(folder / "transforms.json", refined, source=blender.transforms_file(config.data))
    elif all(stated(seen) is not None for seen in refined.lenses):  # else a note of `load` says so
        write_transforms(folder / "transforms.json", refined)


def _title(problem: Problem) -> str:
    width, height = problem.metadata["size"]
    about = problem.metadata
    return f"{about['data']}, {about['images']} views of {width}x{height}\nnoise {about['noise']}"


def _history(rows: Float[np.ndarray, "c 5"]) -> History:
    """For a picture: with the PSNR that a mean squared colour error is."""
    step, loss, rotation_deg, translation, _ = rows.T
    return History(step.astype(int), loss, -10 * np.log10(loss), rotation_deg, translation)
