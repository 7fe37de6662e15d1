"""True poses between their timestamps, where loaders need them at those of images."""

import numpy as np
from jaxtyping import Float

from jaxpose.files.association import nearest
from jaxpose.files.trajectories import Trajectory
from jaxpose.imu.simulation import interpolant

_MOST_GAP_S = 0.1  # between two true poses that one is interpolated from
_ROUNDED_S = 1e-9  # of a timestamp as float64, beyond the first or last pose
_AT_A_STAMP_S = 1e-3  # so close to a true pose, no other needs to be near


def poses_at(ground_truth: Trajectory, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """The ground truth at times [s] on its clock, cubic splines and slerp.

    NaN beyond it and in gaps above 0.1 s.
    """
    poses = np.full((len(t), 4, 4), np.nan)
    if len(ground_truth.t) < 2:
        return poses
    after = np.clip(np.searchsorted(ground_truth.t, t), 1, len(ground_truth.t) - 1)
    gap = ground_truth.t[after] - ground_truth.t[after - 1]
    known = (gap <= _MOST_GAP_S) | (np.abs(ground_truth.t[nearest(t, ground_truth.t)] - t) <= _AT_A_STAMP_S)
    asked = np.clip(t, *ground_truth.t[[0, -1]])
    inside = (np.abs(asked - t) < _ROUNDED_S) & known
    poses[inside] = interpolant(ground_truth.t, ground_truth.T).pose(asked[inside])
    return poses
