"""Planar alignment: the motions of patches of one photograph, and the neural image that they make together.

Without options: 20 motions of the paper's set-up on a photograph that matplotlib ships, PoseNet, a run
folder under outputs/planar. `--setup homography` is BARF's own set-up, `--compare` puts all pose fields side
by side.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Float
from matplotlib import cbook

from jaxpose.experiments import command
from jaxpose.experiments.planar import alignment
from jaxpose.experiments.planar import task as planar_task
from jaxpose.experiments.planar.alignment import CHUNK, Aligned, Aligner
from jaxpose.experiments.planar.report import (
    SUCCESS_PX,
    Progress,
    progress_bar,
    protocol,
    report,
    summary,
    table,
)
from jaxpose.experiments.planar.task import Photo, Task
from jaxpose.experiments.planar.warps import Pose, homography_warps, motion_warps
from jaxpose.fields import PoseNetConfig
from jaxpose.files import atomic, run_folder
from jaxpose.plots import planar as planar_plots
from jaxpose.scenes._image import ImageConfig, image

_STEPS = {"paper": 2000, "homography": 5000}
_SMOKE_STEPS, _SMOKE_MOTIONS = 100, 2
_SMOKE_IMAGE, _SMOKE_NET = ImageConfig(layers=3, width=32), PoseNetConfig(layers=2, width=32)
# What a motion's numbers depend on, beside its own number.
_RESUME_FINGERPRINT = ("image", "setup", "pose", "seed", "steps", "points", "smoke")


@dataclass(frozen=True)
class Config:
    """Settings of a run; an image and these are all that a result depends on."""

    image: Path | None = None  # any photograph; None: matplotlib's grace_hopper.jpg
    setup: Literal["paper", "homography"] = "paper"  # 7 patches on an SE(2) path, or BARF's 5 homographies
    # The field of the motions; spline_reset is the paper's "B-spline": a table that is reset to a smooth
    # spline every 100 steps. None: posenet; a table for homographies, which have no time and take no other.
    pose: Pose | None = None
    compare: bool = False  # all pose fields side by side
    motions: int = 20
    seed: int = 0
    steps: int | None = None  # None: 2000, for homographies 5000
    points: int = 128  # random pixels of each patch in a step
    resume: bool = False  # keep the motions that a killed run has finished
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    out: Path | None = None  # exactly this folder; None: outputs/planar/<name or timestamp>
    name: str | None = None  # of the run folder

    def __post_init__(self):
        command.check_least(self, motions=1, points=1)
        if self.seed < 0:
            raise ValueError(f"--seed: expected 0 or more, got {self.seed}")
        if self.steps is not None and (self.steps < CHUNK or self.steps % CHUNK):
            raise ValueError(f"--steps: expected a multiple of {CHUNK}, got {self.steps}")
        if self.setup == "homography" and (self.compare or self.pose not in (None, "table")):
            raise ValueError("--setup homography: expected --pose table and no --compare")
        if self.compare and self.pose is not None:
            raise ValueError(f"--compare: expected no --pose, as it runs all of them, got {self.pose}")
        command.check_resume(self)


class Outcome(NamedTuple):
    """Where a run was written, and its results; with `compare` those of each pose field under `fields`."""

    folder: Path
    results: dict[str, Any]


def run(config: Config, on_progress: Callable[[Progress], None] | None = None) -> Outcome:
    """Align all motions and write the run folder; motions are kept as they finish, and `resume` skips them.

    Raises DataError or OSError for what cannot be used.
    """
    started = time.perf_counter()
    config = _settled(config)
    assert config.image is not None
    photo = planar_task.read_photo(config.image)
    planar_task.draw(config.setup, photo, config.seed, 0)  # refuses an image before there is a folder
    with run_folder.opened(run_folder.folder_path("planar", name=config.name, out=config.out)) as folder:
        if config.compare:
            return Outcome(folder, _compare(config, photo, folder, on_progress, started))
        return Outcome(folder, _field(config, photo, folder, on_progress))


def _compare(
    config: Config,
    photo: Photo,
    folder: Path,
    on_progress: Callable[[Progress], None] | None,
    started: float,
) -> dict[str, Any]:
    """All motions with each pose field, and the fields side by side."""
    assert config.image is not None
    by_field, curves = {}, {}
    for pose in get_args(Pose):
        single = replace(config, compare=False, pose=pose)
        with run_folder.opened(folder / pose) as inner:
            by_field[pose] = _field(single, photo, inner, on_progress)
        curves[pose] = _curves(_finished(folder / pose, config.motions))
    title = f"{config.image.name}, {config.motions} motions of the paper's set-up, seed {config.seed}"
    steps = CHUNK * np.arange(curves["posenet"].shape[1], dtype=float)
    planar_plots.corner_errors(folder / "comparison.png", steps, curves, SUCCESS_PX, title)
    results = {
        "experiment": "planar",
        "seed": config.seed,
        "smoke": config.smoke,
        "fields": by_field,
        "versions": run_folder.versions(),
        "wall_s": time.perf_counter() - started,
        "peak_rss_bytes": run_folder.peak_rss_bytes(),
    }
    atomic.write_json(folder / "config.json", config)
    atomic.write_text(folder / "table.md", table(by_field) + "\n")
    atomic.write_json(folder / "results.json", results)
    return results


def main(args: Sequence[str] | None = None) -> None:
    """The command: `python -m jaxpose.experiments.planar`."""
    config = command.parse("planar", Config, __doc__, args)
    command.guarded("planar", lambda: report(*run(config, progress_bar())))


def _settled(config: Config) -> Config:
    """The config with nothing left open, and small if it is a smoke run."""
    if config.smoke:
        config = replace(config, steps=_SMOKE_STEPS, motions=min(config.motions, _SMOKE_MOTIONS))
    pose = "table" if config.setup == "homography" else "posenet"
    return replace(
        config,
        image=config.image or Path(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)),
        pose=None if config.compare else config.pose or pose,
        steps=config.steps or _STEPS[config.setup],
    )


def _field(
    config: Config, photo: Photo, folder: Path, on_progress: Callable[[Progress], None] | None
) -> dict[str, Any]:
    """All motions with one pose field, written."""
    started = time.perf_counter()
    assert config.image is not None and config.pose is not None and config.steps is not None
    (folder / "motions").mkdir(exist_ok=True)
    _prepare(folder, config)
    net, network = (_SMOKE_NET, _SMOKE_IMAGE) if config.smoke else (PoseNetConfig(), ImageConfig())
    patches, homographies = planar_task.PATCHES[config.setup], config.setup == "homography"
    warps = homography_warps(patches) if homographies else motion_warps(config.pose, patches, net)
    compiled = alignment.aligner(photo, image(network), warps, steps=config.steps, points=config.points)
    for motion in range(config.motions):
        if not _file(folder, motion).exists():
            _motion(config, photo, folder, compiled, motion, on_progress)
    motions = _finished(folder, config.motions)
    title = f"{config.image.name}, {config.setup} set-up, seed {config.seed}"
    curves = _curves(motions)
    steps = CHUNK * np.arange(curves.shape[1], dtype=float)
    planar_plots.corner_errors(folder / "corner_errors.png", steps, {config.pose: curves}, SUCCESS_PX, title)
    results = {
        "experiment": "planar",
        "setup": config.setup,
        "pose": config.pose,
        "seed": config.seed,
        "smoke": config.smoke,
        "protocol": protocol(config.setup, photo, config.image, config.steps, config.points, warps),
        **summary(motions),
        "versions": run_folder.versions(),
        "wall_s": time.perf_counter() - started,
        "peak_rss_bytes": run_folder.peak_rss_bytes(),
    }
    atomic.write_json(folder / "results.json", results)
    return results


def _motion(
    config: Config,
    photo: Photo,
    folder: Path,
    compiled: Aligner,
    motion: int,
    on_progress: Callable[[Progress], None] | None,
) -> None:
    """Align one motion and keep what came of it."""
    began = time.perf_counter()
    pose, steps = config.pose, config.steps
    assert pose is not None and steps is not None
    task = planar_task.draw(config.setup, photo, config.seed, motion)

    def on_chunk(step: int, loss: float, corner_px: float) -> None:
        if on_progress is not None:
            on_progress(Progress(pose, motion, config.motions, step, steps, loss, corner_px))

    key = jax.random.fold_in(jax.random.key(config.seed), motion)
    aligned = alignment.align(compiled, photo, task, key, steps, on_chunk)
    numbers = {"motion": motion, "seconds": time.perf_counter() - began, **_measured(photo, task, aligned)}
    _draw(folder / f"motion_{motion:02d}.png", config, photo, task, compiled, aligned, numbers)
    atomic.write_json(_file(folder, motion), numbers)  # last: with it the motion counts as finished


def _prepare(folder: Path, config: Config) -> None:
    """Leave in the folder the config, and finished motions only if they are to be kept and are this run's."""
    resume_fingerprint = {
        name: value for name, value in asdict(config).items() if name in _RESUME_FINGERPRINT
    }
    resume_fingerprint["image"] = str(Path(resume_fingerprint["image"]).resolve())
    stored = folder / "motions" / "settings.json"
    if not command.resumes(folder, stored, resume_fingerprint, config.resume):
        for file in (folder / "motions").glob("*.json"):
            file.unlink()
        atomic.write_json(stored, resume_fingerprint)
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
    compiled: Aligner,
    aligned: Aligned,
    numbers: dict[str, Any],
) -> None:
    """The neural image of one motion beside the photograph."""
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
    title = (
        f"{config.pose}, motion {numbers['motion']}: corner error {before:.1f} px at the start, "
        f"{after:.3f} px after {config.steps} steps, PSNR {numbers['psnr']:.1f} dB"
    )
    neural = alignment.picture(compiled, photo, aligned)
    seen = planar_task.covered(photo, task.H_image_patch)
    planar_plots.reconstruction(path, photo.rgb, neural, seen, outlines, title)


def _file(folder: Path, motion: int) -> Path:
    return folder / "motions" / f"{motion:02d}.json"


def _finished(folder: Path, motions: int) -> list[dict[str, Any]]:
    return [json.loads(_file(folder, motion).read_text()) for motion in range(motions)]


def _curves(motions: list[dict[str, Any]]) -> Float[np.ndarray, "m c"]:
    return np.array([motion["corner_error_curve_px"] for motion in motions], float)
