"""Seconds without images: how far a run with an IMU is off in them, and one second after.

Options are those of `python -m jaxpose.experiments.imu_slam`. From 10 s on, for 3 s, frames are black and
without depth. Printed are distances to the true positions, not aligned: the run starts at the true pose.

    python benchmarks/without_images.py --help
"""

import numpy as np
import tyro

from jaxpose.datasets.types import Frame
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.imu_slam import Config
from jaxpose.experiments.slam.options import slam_config
from jaxpose.experiments.slam.source import load
from jaxpose.slam.pipeline import run

FIRST_S, LAST_S = 10.0, 13.0


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    recording = load(config).recording
    truth, t = recording.T_world_cam, recording.t - recording.t[0]
    assert truth is not None and t[-1] > LAST_S + 1, "expected true poses, and frames for 14 s"
    dark = (t >= FIRST_S) & (t < LAST_S)

    def read(i: int) -> Frame:
        frame = recording.read(i)
        return Frame(0 * frame.rgb, 0 * frame.depth) if dark[i] else frame

    result = run(recording._replace(read=read), slam_config(config))
    off = 100 * np.linalg.norm((result.T_world_cam - truth)[:, :3, 3], axis=1)
    later = np.flatnonzero(t >= t[dark][-1] + 1)[0]
    print(
        f"{recording.name}, IMU {config.slam.imu}, seed {config.slam.seed}: ATE "
        f"{100 * trajectory_error.ate(result.T_world_cam, truth).rmse:.2f} cm; without images at most "
        f"{off[dark].max():.1f} cm off, a second later {off[later]:.2f} cm; lost {result.frames.lost.sum()} "
        f"of {len(t)}, {dark.sum()} of them dark"
    )


if __name__ == "__main__":
    main()
