"""Options of the planar experiment."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from matplotlib import cbook

from jaxpose.experiments.checks import check_least, check_run_folder
from jaxpose.experiments.planar.alignment import CHUNK
from jaxpose.experiments.planar.warps import Pose

_STEPS = {"paper": 2000, "homography": 5000}
_SMOKE_STEPS, _SMOKE_MOTIONS = 100, 2
# What a motion's numbers depend on, beside its own number.
_RESUME_FINGERPRINT = ("image", "setup", "pose", "seed", "steps", "points", "smoke")


# The options of the first screen of help.
GROUPS = {
    "data": ("image", "setup", "motions"),
    "method": ("pose", "compare", "steps", "seed"),
    "run": ("out", "name", "resume", "smoke", "json"),
}


@dataclass(frozen=True)
class Config:
    """Settings of a run; an image and these are all that a result depends on."""

    image: Path | None = None  # any photograph; None: matplotlib's grace_hopper.jpg
    setup: Literal["paper", "homography"] = "paper"  # 7 patches on an SE(2) path, or BARF's 5 homographies
    # The field of the motions; spline_reset is the paper's "B-spline": per-frame poses, reset to a smooth
    # spline every 100 steps. None: posenet; per_frame for homographies, which have no time and take no other.
    pose: Pose | None = None
    compare: bool = False  # all pose fields side by side
    motions: int = 20  # how many motions of the patches to align
    seed: int = 0  # of the motions, the networks' start, the pixels
    steps: int | None = None  # None: 2000, for homographies 5000
    points: int = 128  # random pixels of each patch in a step
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
        One whose image, steps and, without `compare`, pose are not None.
    """
    if config.smoke:
        config = replace(config, steps=_SMOKE_STEPS, motions=min(config.motions, _SMOKE_MOTIONS))
    pose = "per_frame" if config.setup == "homography" else "posenet"
    return replace(
        config,
        image=config.image or Path(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)),
        pose=None if config.compare else config.pose or pose,
        steps=config.steps or _STEPS[config.setup],
    )
