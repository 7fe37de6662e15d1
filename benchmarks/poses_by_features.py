"""Poses by features alone, from many disturbed starts: how far off they end, before anything is trained.

python benchmarks/poses_by_features.py [--seeds 0 20] [--data DIR] [--rows "RM 60" unknown]

The photographs' features do not depend on the noise: they are found once. Each row of noise is drawn by
many seeds; its errors after the adjustment are printed seed by seed (`--each`) and as median and range. A
start counts as registered within 1 degree and 1% of the cameras' extent.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from jaxpose.evaluation.trajectory_error import pose_errors
from jaxpose.experiments.noisy_nerf.options import ORBIT, Config, disturbed, load, middle
from jaxpose.structure import adjust, find_tracks

REGISTERED_DEG, REGISTERED_PERCENT = 1.0, 1.0
ROWS = {  # of table 11: largest translation as a share of the cameras' extent, and turn [deg]
    "TM 20": (0.2, 0.0),
    "TM 30": (0.3, 0.0),
    "TM 40": (0.4, 0.0),
    "RM 30": (0.0, 30.0),
    "RM 60": (0.0, 60.0),
    "RM 90": (0.0, 90.0),
    "RM 60 + TM 20": (0.2, 60.0),
    "RM 90 + TM 30": (0.3, 90.0),
    "RM 120": (0.0, 120.0),
    "unknown": None,
}


@dataclass(frozen=True)
class Options:
    """What is measured."""

    data: Path = ORBIT  # photographs with poses
    width: int = 100  # [px]
    rows: tuple[str, ...] = tuple(ROWS)
    seeds: tuple[int, int] = (0, 20)  # from, and up to but not with
    each: bool = False  # a line for each seed, too


def noisy(data: Path, width: int, row: str, seed: int) -> Config:
    """The options of a run with the noise of a row."""
    config = Config(data=data, image_width=width, seed=seed)
    noise = ROWS[row]
    if noise is None:
        return replace(config, noise="unknown")
    return replace(config, noise_translation=noise[0], noise_rotation_deg=noise[1])


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    problem = load(noisy(options.data, options.width, "TM 20", 0))
    photographs, truth = problem.train, problem.train.T_world_cam
    started = time.perf_counter()
    tracks = find_tracks(photographs.rgb, photographs.camera, photographs.mask)
    print(f"{tracks.points} points in {len(tracks.view)} observations, {time.perf_counter() - started:.0f} s")
    print("| row | registered | start RE / TE% | RE [deg] | TE [%] | photographs | s |\n|" + "---|" * 7)
    for row in options.rows:
        found = []
        for seed in range(*options.seeds) if ROWS[row] is not None else (0,):
            T_start, _ = disturbed(noisy(options.data, options.width, row, seed), photographs, problem.extent)
            started = time.perf_counter()
            bundle = adjust(tracks, T_start, middle(photographs))
            took = time.perf_counter() - started
            start = pose_errors(T_start, truth)
            end = start if bundle is None else pose_errors(bundle.T_world_cam, truth)
            percent = 100 / problem.extent
            found.append((
                start.rotation_deg, percent * start.translation, end.rotation_deg, percent * end.translation,
                0 if bundle is None else int(bundle.supported.sum()), took,
            ))  # fmt: skip
            if options.each:
                print(f"| {row}, seed {seed} | | " + " | ".join(f"{x:.3f}" for x in found[-1]), flush=True)
        table = np.array(found)
        good = (table[:, 2] < REGISTERED_DEG) & (table[:, 3] < REGISTERED_PERCENT)
        spread = lambda x: f"{np.median(x):.3f} ({x.min():.3f} to {x.max():.3f})"
        print(
            f"| {row} | {good.sum()} of {len(good)} | {np.median(table[:, 0]):.1f} / "
            f"{np.median(table[:, 1]):.1f} | {spread(table[:, 2])} | {spread(table[:, 3])} | "
            f"{table[:, 4].min():.0f} to {table[:, 4].max():.0f} of {len(truth)} | "
            f"{np.median(table[:, 5]):.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
