"""SLAM with a real IMU or its stand-in where no pose is known: ground truth is taken away, and only measures.

Options are those of `python -m jaxpose.experiments.imu_slam`. Printed are the world's tilt against the true
vertical, the ATE after SE(3) alignment, frames lost and uncertain, and how the errors of colour compare to
their median: at frames within 4 cm of the true motion from the last one, and at the others.

    python benchmarks/without_truth.py --help
"""

import numpy as np
import tyro

from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.imu_slam import Config
from jaxpose.experiments.slam.options import slam_config
from jaxpose.experiments.slam.source import load
from jaxpose.geometry import rigid
from jaxpose.slam.initial_pose import first_pose
from jaxpose.slam.pipeline import run

RIGHT = 0.04  # [m] of a motion from one frame to the next


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    recording = load(config).recording
    ground_truth = recording.T_world_cam
    assert ground_truth is not None, "expected a recording with true poses to measure against"
    recording = recording._replace(T_world_cam=None)
    up = first_pose(recording).T_world_cam[2, :3]
    result = run(recording, slam_config(config))
    ate = trajectory_error.ate(result.T_world_cam, ground_truth)
    moved, moved_true = (rigid.inverse(T[:-1]) @ T[1:] for T in (result.T_world_cam, ground_truth))
    right = np.linalg.norm((moved - moved_true)[:, :3, 3], axis=1) < RIGHT
    ratio = result.frames.colour_error[1:] / np.nanmedian(result.frames.colour_error)
    print(f"{recording.name}, {len(recording.t)} frames, IMU {config.slam.imu}, seed {config.slam.seed}")
    tilt = rigid.vector_angle(up, ground_truth[0, 2, :3])
    print(f"  tilt {np.rad2deg(tilt):.2f} deg, ATE {100 * ate.rmse:.2f} cm")
    print(f"  {result.frames.lost.sum()} frames lost, {result.frames.uncertain.sum()} uncertain")
    print(f"  colour at {right.sum()} right motions: at most {np.nanmax(ratio[right]):.2f} times the median")
    if not right.all():
        print(f"  colour at the others: {np.round(ratio[~right], 2).tolist()}")


if __name__ == "__main__":
    main()
