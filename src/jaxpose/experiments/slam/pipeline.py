"""What the SLAM experiments do: track a recording, and leave its run folder."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from jaxtyping import Float

from jaxpose._memory import give_back_memory
from jaxpose.datasets.types import Recording
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.checks import own_folder
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.outcome import Outcome, cost, read_results
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.experiments.slam.checkpointing import checkpoint_callback
from jaxpose.experiments.slam.map_file import read_map
from jaxpose.experiments.slam.options import GROUPS, HIDDEN, Options, resume_fingerprint, slam_config
from jaxpose.experiments.slam.report import report, table, tracking_update
from jaxpose.experiments.slam.run_files import write_run
from jaxpose.experiments.slam.source import Source, load
from jaxpose.files import atomic, run_folder, trajectories
from jaxpose.plots import slam as slam_plots
from jaxpose.slam import ImuMode, Progress, begin_in, estimate_line_delay
from jaxpose.slam.checkpoint import load as load_checkpoint
from jaxpose.slam.pipeline import run as track
from jaxpose.slam.sessions import with_earlier

_END = Update("fitting the continuous trajectory, texturing the map")

_COMPILING = 2  # frames of a run, the first ones

Errors = Float[np.ndarray, " n"]  # [m] translation error of every frame; NaN without ground truth


def command(
    prog: str,
    config: type[Options],
    description: str | None,
    run: Callable[[Any, OnUpdate], Outcome],
    args: Sequence[str] | None,
) -> None:
    """One of the SLAM commands.

    Args:
        prog: the command as it is typed.
        config: its options.
        description: what it does.
        run: does it.
        args: the command line; None is that of this process.
    """
    execute(Command(prog, config, description, run, lambda result: report(*result), GROUPS, HIDDEN), args)


def run(experiment: str, options: Options, on_update: OnUpdate = silent) -> Outcome:
    """Track a recording and write its run folder; with `compare` one within it for each IMU mode.

    Args:
        experiment: its name, that of the folder within outputs/.
        options: the recording and how to track it.
        on_update: called with what the run is doing.

    Returns:
        The run folder, and its results; with `compare` those of each IMU mode under `modes`.

    Raises:
        DataError, OSError: for what cannot be read, tracked or written; then no folder is left behind.
    """
    started = time.perf_counter()
    path = run_folder.folder_path(experiment, name=options.name, out=options.out)
    on_update(Update(f"run folder {path}"))
    on_update(Update("making the room" if options.data is None else f"reading {options.data}"))
    source = load(options)
    with run_folder.opened(path) as folder:
        if options.compare:
            return Outcome(folder, _compare(experiment, options, source, folder, on_update, started))
        results, _ = _single(experiment, options, source, folder, on_update, started)
        return Outcome(folder, results)


def _compare(
    experiment: str, options: Options, source: Source, folder: Path, on_update: OnUpdate, started: float
) -> dict[str, Any]:
    """A run for each IMU mode, and all of them side by side."""
    by_mode, errors = {}, {}
    for mode in get_args(ImuMode):
        single = replace(options, compare=False, slam=replace(options.slam, imu=mode))
        with run_folder.opened(folder / mode) as inner:
            by_mode[mode], errors[mode] = _single(
                experiment, single, source, inner, on_update, time.perf_counter()
            )
        jax.clear_caches()  # a mode's compiled steps are of no use to the next, and fill memory
    results = {"experiment": experiment, "seed": options.slam.seed, "modes": by_mode, **cost(started)}
    recording = source.recording
    if recording.T_world_cam is not None:
        rate = f"{len(recording.t)} frames at {source.metadata['rate_hz']:.3g} Hz"
        title = f"{recording.name}, {rate}: IMU modes, errors after SE(3) alignment"
        slam_plots.comparison(folder / "comparison.png", recording.t, errors, title)
    atomic.write_json(folder / "config.json", options)
    atomic.write_text(folder / "table.md", table(by_mode) + "\n")
    atomic.write_json(folder / "results.json", results)
    return results


def _single(
    experiment: str, options: Options, source: Source, folder: Path, on_update: OnUpdate, started: float
) -> tuple[dict[str, Any], Errors]:
    """One tracked run, written: its results, and the errors of its frames."""
    recording, mode = source.recording, options.slam.imu
    checkpoint, finished = folder / "checkpoint.npz", folder / "results.json"
    settings = resume_fingerprint(options)
    own_folder(folder, folder / "settings.json", settings, options.resume, checkpoint.name, finished.name)
    if finished.exists():
        return read_results(finished, experiment), _written_errors(folder, recording)
    on_update(Update(f"compiling, IMU {mode}: the first frames are slow"))
    config, state = slam_config(options), None
    earlier = None if options.map is None else read_map(options.map / "map.npz")
    if checkpoint.exists():
        state = load_checkpoint(checkpoint, recording, config)
        state = state if earlier is None else with_earlier(state, earlier)
    elif earlier is not None:
        on_update(Update(f"looking for the first frame in the map of {options.map}"))
        state = begin_in(earlier, recording, config)
    line_delay = {}
    if "line-delay" in config.estimate:
        found = estimate_line_delay(
            recording, config, lambda p: on_update(tracking_update(f"{mode}, for the line delay", p))
        )
        delay = found.line_delay_us if found.observed else config.line_delay_us
        others = tuple(name for name in config.estimate if name != "line-delay")
        config = replace(config, line_delay_us=delay, estimate=others)
        line_delay = {"line_delay": found._asdict()}
    keep = checkpoint_callback(folder, recording, settings)

    def on_frame(progress: Progress) -> None:
        keep(progress)
        on_update(tracking_update(mode + ", second pass" * progress.state.passes, progress))
        if progress.index < _COMPILING or progress.index == progress.count - 1:
            give_back_memory()
        if progress.index == progress.count - 1:
            on_update(_END)

    def on_refined(done: int, total: int) -> None:
        on_update(_END if done == total else Update("refining", done, total, "frames"))

    result = track(recording, config, on_frame, state, on_refined)
    found, errors = write_run(folder, options, source, result, on_update)
    results = {
        "experiment": experiment,
        "data": source.metadata,
        "imu": {"mode": mode, "readings": "not used" if mode == "none" else source.imu},
        "reference_frame": options.slam.frame,
        "seed": options.slam.seed,
        "smoke": options.smoke,
        **line_delay,
        **found,
        **cost(started),
    }
    atomic.write_json(finished, results)  # with it the run counts as finished
    checkpoint.unlink(missing_ok=True)
    return results, errors


def _written_errors(folder: Path, recording: Recording) -> Errors:
    """The errors of a finished run, from its files."""
    if recording.T_world_cam is None:
        return np.full(len(recording.t), np.nan)
    estimate = trajectories.read_tum(folder / "trajectory.txt").T
    return trajectory_error.ate(estimate, recording.T_world_cam).errors
