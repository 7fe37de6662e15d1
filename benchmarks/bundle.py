"""What it changes that keyframes are adjusted together: `python benchmarks/bundle.py`, imu_slam's options.

A recording is tracked once. Printed are the ATE of keyframes as tracked and as all that they share would have
them, how many times as far apart depth images are there, and whether that is taken; then the ATE of all
frames, and how long making the map anew took.
"""

import time

import numpy as np
import tyro

from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.imu_slam import Config
from jaxpose.experiments.slam.options import slam_config
from jaxpose.experiments.slam.source import load
from jaxpose.slam.loops.bundle import adopt, propose
from jaxpose.slam.pipeline import track_all


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    recording = load(config).recording
    truth = recording.T_world_cam
    assert truth is not None, "expected true poses to measure against"
    state = track_all(recording, slam_config(config))
    found = propose(state, recording.read)
    of_all, k = ate(poses(state), truth), np.flatnonzero(state.frames.keyframe)
    print(f"{recording.name}, {len(truth)} frames, {len(k)} keyframes, seed {config.slam.seed}")
    if found is None:
        print(f"  ATE {of_all:.3f} cm; too little is shared")
        return
    before, after = (ate(T, truth[k]) for T in (poses(state)[k], found.T_world_cam))
    taken = "taken" if found.agrees else "left"
    apart = f"depths {found.depths_apart:.2f} times as far apart"
    print(f"  keyframes {before:.3f} -> {after:.3f} cm, {apart}: {taken}")
    if not found.agrees:
        return
    started = time.perf_counter()
    now = ate(poses(adopt(state, found, recording.read)), truth)
    seconds = time.perf_counter() - started
    print(f"  all frames {of_all:.3f} -> {now:.3f} cm, the map anew in {seconds:.1f} s")


def poses(state):
    return state.frames.T_world_body @ state.T_body_cam


def ate(T, truth) -> float:
    return 100 * trajectory_error.ate(T, truth).rmse


if __name__ == "__main__":
    main()
