"""How well photographs tell calibrated poses from rough ones.

python benchmarks/stated_poses.py [--fern DIR] [--lego DIR]

The share of right observations that agree with poses which are off by smooth noise (`Bundle.start_agrees`),
how far off these are, and how far those by features.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from jaxpose.datasets.synthetic import pose_noise
from jaxpose.evaluation.trajectory_error import pose_errors
from jaxpose.experiments.noisy_nerf.options import Config, load, middle
from jaxpose.structure import adjust, find_tracks

TURNS_DEG = 0.0, 0.5, 1.0, 2.0, 3.0  # at most
SHIFTS = 0.01, 0.03  # of the cameras' extent, at most


@dataclass(frozen=True)
class Options:
    """What is looked at beside the orbit."""

    fern: Path | None = None
    lego: Path | None = None


def main() -> None:
    """Print a line for each data set and noise."""
    options = tyro.cli(Options, description=__doc__)
    trials = {
        "orbit": Config(noise="none"),
        "orbit, 40 of 64 px": Config(noise="none", orbit_views=40, image_width=64),
    }
    for name in ("fern", "lego"):
        if (folder := getattr(options, name)) is not None:
            trials[name] = Config(noise="none", data=folder)
    for name, config in trials.items():
        problem = load(config)
        photographs, truth = problem.train, problem.train.T_world_cam
        tracks = find_tracks(
            photographs.rgb, photographs.camera, photographs.mask, lambda what, done, total: None
        )
        noises = [(0.0, deg, 1) for deg in TURNS_DEG] + [(share * problem.extent, 0.0, 2) for share in SHIFTS]
        for translation, deg, seed in noises:
            noise = pose_noise.correlated(photographs.t, translation=translation, rotation_deg=deg, seed=seed)
            start = truth @ noise
            found = adjust(tracks, start, middle(photographs))
            at_start, by_features, agrees = pose_errors(start, truth).rotation_deg, np.nan, np.nan
            if found is not None:
                by_features, agrees = pose_errors(found.T_world_cam, truth).rotation_deg, found.start_agrees
            print(
                f"{name}: {deg:g} deg, {100 * translation / problem.extent:g}% at most: {agrees:.3f} agree, "
                f"start off {at_start:.2f} deg, by features {by_features:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
