"""Planar alignment: the motions of patches of one photograph, and the image that they make together.

Without options: 20 motions of the paper's set-up on a photograph that matplotlib ships, PoseNet, a run
folder under outputs/planar. `--preset paper` optimises a neural image along, as the paper does; `--setup
homography` is BARF's own set-up, `--compare` puts all pose fields side by side.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from jaxtyping import Float

from jaxpose.experiments.checks import own_folder
from jaxpose.experiments.command import MODULE, Command, execute
from jaxpose.experiments.outcome import Outcome, cost
from jaxpose.experiments.planar import alignment, pyramid
from jaxpose.experiments.planar import task as planar_task
from jaxpose.experiments.planar.alignment import CHUNK, Align, Aligned
from jaxpose.experiments.planar.options import GROUPS, Config, resume_fingerprint, settled
from jaxpose.experiments.planar.report import SUCCESS_PX, protocol, report, summary, table
from jaxpose.experiments.planar.task import Photo, Task
from jaxpose.experiments.planar.warps import Pose, homography_warps, motion_warps
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.fields import PoseNetConfig
from jaxpose.files import atomic, run_folder
from jaxpose.files.untrusted import read_json
from jaxpose.plots import planar as planar_plots
from jaxpose.scenes._image import ImageConfig, image

_SMOKE_IMAGE, _SMOKE_NET = ImageConfig(layers=3, width=32), PoseNetConfig(layers=2, width=32)


def run(config: Config, on_update: OnUpdate = silent) -> Outcome:
    """Align all motions and write the run folder; motions are kept as they finish, and `resume` skips them.

    Args:
        config: the image and how to align.
        on_update: called with what the run is doing.

    Returns:
        The run folder, and its results; with `compare` those of each pose field under `fields`.

    Raises:
        DataError, OSError: for what cannot be read or written; then no folder is left behind.
    """
    started = time.perf_counter()
    path = run_folder.folder_path("planar", name=config.name, out=config.out)
    on_update(Update(f"run folder {path}"))
    config = settled(config)
    assert config.image is not None
    photo = planar_task.read_photo(config.image)
    planar_task.draw(config.setup, photo, config.seed, 0)  # refuses an image before there is a folder
    with run_folder.opened(path) as folder:
        if config.compare:
            return Outcome(folder, _compare(config, photo, folder, on_update, started))
        return Outcome(folder, _field(config, photo, folder, on_update))


def _compare(
    config: Config,
    photo: Photo,
    folder: Path,
    on_update: OnUpdate,
    started: float,
) -> dict[str, Any]:
    """All motions with each pose field, and the fields side by side."""
    assert config.image is not None
    by_field, curves = {}, {}
    for pose in get_args(Pose):
        single = replace(config, compare=False, pose=pose)
        with run_folder.opened(folder / pose) as inner:
            by_field[pose] = _field(single, photo, inner, on_update)
        curves[pose] = _curves(_finished(folder / pose, config.motions))
    title = f"{config.image.name}, {config.motions} motions of the paper's set-up, seed {config.seed}"
    steps = CHUNK * np.arange(curves["posenet"].shape[1], dtype=float)
    planar_plots.corner_errors(folder / "comparison.png", steps, curves, SUCCESS_PX, title)
    results = {
        "experiment": "planar",
        "seed": config.seed,
        "smoke": config.smoke,
        "fields": by_field,
        **cost(started),
    }
    atomic.write_json(folder / "config.json", config)
    atomic.write_text(folder / "table.md", table(by_field) + "\n")
    atomic.write_json(folder / "results.json", results)
    return results


def main(args: Sequence[str] | None = None, prog: str = MODULE + "planar") -> None:
    """The command `jaxpose planar`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    execute(Command(prog, Config, __doc__, run, lambda result: report(*result), GROUPS), args)


def _field(config: Config, photo: Photo, folder: Path, on_update: OnUpdate) -> dict[str, Any]:
    """All motions with one pose field, written."""
    started = time.perf_counter()
    assert config.image is not None and config.pose is not None
    _prepare(folder, config)
    net, network = (_SMOKE_NET, _SMOKE_IMAGE) if config.smoke else (PoseNetConfig(), ImageConfig())
    patches, homographies = planar_task.PATCHES[config.setup], config.setup == "homography"
    warps = homography_warps(patches) if homographies else motion_warps(config.pose, patches, net)
    on_update(Update(f"compiling {config.pose}"))
    if config.preset == "paper":
        assert config.steps is not None and config.points is not None
        scene = image(network)
        align = alignment.by_adam(photo, scene, warps, steps=config.steps, points=config.points)
    else:
        align = pyramid.by_gauss_newton(photo, warps)
    for motion in range(config.motions):
        if not _file(folder, motion).exists():
            _motion(config, photo, folder, align, motion, on_update)
    motions = _finished(folder, config.motions)
    title = f"{config.image.name}, {config.setup} set-up, seed {config.seed}"
    curves = _curves(motions)
    steps = (CHUNK if config.preset == "paper" else 1) * np.arange(curves.shape[1], dtype=float)
    planar_plots.corner_errors(folder / "corner_errors.png", steps, {config.pose: curves}, SUCCESS_PX, title)
    results = {
        "experiment": "planar",
        "setup": config.setup,
        "preset": config.preset,
        "pose": config.pose,
        "seed": config.seed,
        "smoke": config.smoke,
        "protocol": protocol(config, photo, warps),
        **summary(motions),
        **cost(started),
    }
    atomic.write_json(folder / "results.json", results)
    return results


def _motion(
    config: Config,
    photo: Photo,
    folder: Path,
    align: Align,
    motion: int,
    on_update: OnUpdate,
) -> None:
    """Align one motion and keep what came of it."""
    began = time.perf_counter()
    pose, steps = config.pose, config.steps or pyramid.count(photo.crop)
    task = planar_task.draw(config.setup, photo, config.seed, motion)

    def on_step(step: int, loss: float, corner_px: float) -> None:
        state = {"loss": f"{loss:.5f}", "corners": f"{corner_px:.2f} px"}
        on_update(Update(f"{pose} {motion + 1}/{config.motions}", step, steps, state=state))

    key = jax.random.fold_in(jax.random.key(config.seed), motion)
    aligned = align(task, key, on_step)
    numbers = {"motion": motion, "seconds": time.perf_counter() - began, **_measured(photo, task, aligned)}
    _draw(folder / f"motion_{motion:02d}.png", config, photo, task, aligned, numbers)
    atomic.write_json(_file(folder, motion), numbers)  # last: with it the motion counts as finished


def _prepare(folder: Path, config: Config) -> None:
    """Leave in the folder the config, and finished motions only if they are to be kept and are this run's."""
    settings, stored = resume_fingerprint(config), folder / "motions" / "settings.json"
    names = "results.json", "motions/[0-9][0-9]*.json"
    if not own_folder(folder, stored, settings, config.resume, *names):
        stored.parent.mkdir(exist_ok=True)
        atomic.write_json(stored, settings)
    atomic.write_json(folder / "config.json", config)


def _measured(photo: Photo, task: Task, aligned: Aligned) -> dict[str, Any]:
    """The numbers of one motion; those on corners are of the patches that may move."""
    per_patch = planar_task.corner_errors(photo, aligned.H_image_patch, task.H_image_patch)[1:]
    error = float(per_patch.mean())
    return {
        "corner_error_px": error,
        "success": error < SUCCESS_PX,
        "psnr": aligned.psnr,
        "start_corner_error_px": aligned.corner_px[0],
        "corner_error_per_patch_px": per_patch,
        "corner_error_curve_px": aligned.corner_px,
        "loss_curve": aligned.loss,
        "H_image_patch": aligned.H_image_patch,
        "H_image_patch_true": task.H_image_patch,
    }


def _draw(
    path: Path,
    config: Config,
    photo: Photo,
    task: Task,
    aligned: Aligned,
    numbers: dict[str, Any],
) -> None:
    """The image that was found with one motion, beside the photograph."""
    height, width = photo.rgb.shape[:2]
    start = np.eye(3)[None]
    outlines = {
        name: planar_task.apply(H, planar_task.corners(photo)) * photo.unit + [width / 2, height / 2]
        for name, H in (
            ("ground_truth", task.H_image_patch),
            ("start", start),
            ("estimate", aligned.H_image_patch),
        )
    }
    before, after = numbers["start_corner_error_px"], numbers["corner_error_px"]
    steps = config.steps or pyramid.count(photo.crop)
    title = (
        f"{config.pose}, motion {numbers['motion']}: corner error {before:.1f} px at the start, "
        f"{after:.3g} px after {steps} steps, PSNR {numbers['psnr']:.1f} dB"
    )
    seen = planar_task.covered(photo, task.H_image_patch)
    planar_plots.reconstruction(path, photo.rgb, aligned.picture, seen, outlines, title)


def _file(folder: Path, motion: int) -> Path:
    return folder / "motions" / f"{motion:02d}.json"


def _finished(folder: Path, motions: int) -> list[dict[str, Any]]:
    return [read_json(_file(folder, motion), "the result of a motion") for motion in range(motions)]


def _curves(motions: list[dict[str, Any]]) -> Float[np.ndarray, "m c"]:
    return np.array([motion["corner_error_curve_px"] for motion in motions], float)
