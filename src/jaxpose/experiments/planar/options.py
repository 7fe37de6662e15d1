"""Options of the planar experiment."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from matplotlib import cbook

from jaxpose.experiments.checks import check_least, check_run_folder, check_unused
from jaxpose.experiments.planar.alignment import CHUNK
from jaxpose.experiments.planar.warps import Pose

Preset = Literal["fast", "paper"]
_STEPS, _POINTS = {"paper": 2000, "homography": 5000}, 128
_SMOKE_STEPS, _SMOKE_MOTIONS = 100, 2
# What a motion's numbers depend on, beside its own number.
_RESUME_FINGERPRINT = ("image", "setup", "preset", "pose", "seed", "steps", "points", "smoke")


# The options of the first screen of help.
GROUPS = {
    "data": ("image", "setup", "motions"),
    "method": ("preset", "pose", "compare", "steps", "seed"),
    "run": ("out", "name", "resume", "smoke", "json"),
}


@dataclass(frozen=True)
class Config:
    """Settings of a run; an image and these are all that a result depends on."""

    image: Path | None = None  # any photograph; None: matplotlib's grace_hopper.jpg
    setup: Literal["paper", "homography"] = "paper"  # 7 patches on an SE(2) path, or BARF's 5 homographies
    # Gauss-Newton on a pyramid of blurred patches, or the paper's neural image and Adam. None: fast, but the
    # paper's for homographies, spline_reset and --compare, which know no other.
    preset: Preset | None = None
    # The field of the motions; spline_reset is the paper's "B-spline": per-frame poses, reset to a smooth
    # spline every 100 steps. None: posenet; per_frame for homographies, which have no time and take no other.
    pose: Pose | None = None
    compare: bool = False  # all pose fields side by side
    motions: int = 20  # how many motions of the patches to align
    seed: int = 0  # of the motions, the networks' start, the pixels
    steps: int | None = None  # of preset paper; None: 2000, for homographies 5000
    points: int | None = None  # of preset paper: random pixels of each patch in a step; None: 128
    resume: bool = False  # keep the motions that a killed run has finished
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    out: Path | None = None  # exactly this folder; None: outputs/planar/<name or timestamp>
    name: str | None = None  # of the folder within outputs/planar
    json: bool = False  # print the results as JSON and nothing else

    def __post_init__(self):
        check_least(self, motions=1, points=1, seed=0)
        if self.steps is not None and (self.steps < CHUNK or self.steps % CHUNK):
            raise ValueError(f"--steps: expected a multiple of {CHUNK}, got {self.steps}")
        if self.setup == "homography" and (self.compare or self.pose not in (None, "per_frame")):
            raise ValueError("--setup homography: expected --pose per_frame and no --compare")
        if self.compare and self.pose is not None:
            raise ValueError(f"--compare: expected no --pose, as it runs all of them, got {self.pose}")
        preset = _preset(self)
        if preset == "fast":
            if _papers(self):
                raise ValueError(
                    "--preset fast: expected none of --compare, --setup homography, --pose spline_reset"
                )
            check_unused(self, ("steps", "points"), "with preset fast")
        check_run_folder(self, self.image)


def resume_fingerprint(config: Config) -> dict[str, Any]:
    """The settings that a resumed run must share with the one it resumes.

    Args:
        config: the config of the run.

    Returns:
        Values in JSON's types, by their names.
    """
    found = {name: getattr(config, name) for name in _RESUME_FINGERPRINT}
    return found | {"image": str(Path(found["image"]).resolve())}


def settled(config: Config) -> Config:
    """The config with every default chosen, and small if it is a smoke run.

    Args:
        config: as it was asked for.

    Returns:
        One whose image, preset and, without `compare`, pose are not None, nor with preset paper steps and
        points.
    """
    preset = _preset(config)
    if config.smoke:
        config = replace(config, motions=min(config.motions, _SMOKE_MOTIONS))
    if preset == "paper":
        steps = _SMOKE_STEPS if config.smoke else config.steps or _STEPS[config.setup]
        config = replace(config, steps=steps, points=config.points or _POINTS)
    pose = "per_frame" if config.setup == "homography" else "posenet"
    return replace(
        config,
        image=config.image or Path(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)),
        preset=preset,
        pose=None if config.compare else config.pose or pose,
    )


def _preset(config: Config) -> Preset:
    return config.preset or ("paper" if _papers(config) else "fast")


def _papers(config: Config) -> bool:
    return config.compare or config.setup == "homography" or config.pose == "spline_reset"
