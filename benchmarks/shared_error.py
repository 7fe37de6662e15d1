"""What it changes that tracked poses share an error: `python benchmarks/shared_error.py`, imu_slam's options.

A recording is tracked once; the batch pass then takes the poses' errors for independent, or for a walk that
is forgotten in so many seconds. Printed are the ATE, and squared errors over covariances of poses and of
moves of one second (6 is right) with the share of them in the ellipsoids that hold 90%.
"""

from dataclasses import replace

import numpy as np
import tyro

from jaxpose.estimate import smooth
from jaxpose.evaluation import trajectory_error
from jaxpose.evaluation.consistency import aligned_error, consistency, relative_error
from jaxpose.experiments.imu_slam import Config
from jaxpose.experiments.slam.options import slam_config
from jaxpose.experiments.slam.source import load
from jaxpose.slam.batch import own_covariances
from jaxpose.slam.pipeline import track_all

FORGOTTEN_S = (None, np.inf, 10.0, 4.0, 2.0, 1.0)
INDEPENDENT_S = 0.5


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    recording, settings = load(config).recording, replace(slam_config(config), refine="none")
    truth, t = recording.T_world_cam, recording.t - recording.t[0]
    assert truth is not None and recording.imu is not None, (
        "expected true poses to measure against, and an IMU"
    )
    frames = track_all(recording, settings).frames
    own, tracked = own_covariances(frames), frames.T_world_body @ recording.T_body_cam
    kept = np.isfinite(own).all(axis=(1, 2))
    imu = recording.imu._replace(t=np.asarray(recording.imu.t) - recording.t[0])
    print(f"{recording.name}, {len(t)} frames, seed {settings.seed}: tracked {ate(tracked, truth):.3f} cm")
    for forgotten_s in FORGOTTEN_S:
        known = smooth(
            t[kept], tracked[kept], own[kept], imu, noise=settings.imu_noise, T_body_cam=recording.T_body_cam,
            gravity_world=recording.gravity_world, drift=None if forgotten_s is None else own[kept],
            drift_s=forgotten_s or np.inf,
        )  # fmt: skip
        name = "independent" if forgotten_s is None else f"a walk, forgotten in {forgotten_s:g} s"
        levels = f"{known.noise.position:.2f}, {known.noise.rotation:.2f}"
        off = f"ATE {ate(known.pose(t), truth):.3f} cm"
        print(f"  {name:<28} {off}, {squares(known, t, truth)}, factors {levels}")


def ate(T, truth) -> float:
    return 100 * trajectory_error.ate(T, truth).rmse


def squares(known, t, truth) -> str:
    T, P = known.pose(t), known.covariance(t)
    aligned = trajectory_error.align(trajectory_error.ate(T, truth).alignment, T)
    count = max(int((t[-1] - t[0]) / INDEPENDENT_S), 1)
    of_poses = consistency(aligned_error(aligned, truth, P), P, independent=count)
    step = max(round(1 / float(np.median(np.diff(t)))), 1)
    moves = relative_error((T[:-step], T[step:]), (truth[:-step], truth[step:]))
    of_moves = consistency(moves, known.relative_covariance(t[:-step], t[step:]), independent=count)
    return ", ".join(
        f"NEES {found.nees:.1f} ({100 * found.inside_90:.0f}%) of {name}"
        for name, found in (("poses", of_poses), ("moves of 1 s", of_moves))
    )


if __name__ == "__main__":
    main()
