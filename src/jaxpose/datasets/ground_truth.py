"""True poses between their stamps, where loaders need them at those of images."""

import numpy as np
from jaxtyping import Float

from jaxpose.files.trajectories import Trajectory, nearest
from jaxpose.imu.simulation import interpolant

_MOST_GAP_S = 0.1  # between two true poses that one is interpolated from
_AT_A_STAMP_S = 1e-3  # so close to a true pose, no other needs to be near


def poses_at(truth: Trajectory, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """The truth at times [s] on its clock, cubic splines and slerp; NaN beyond it and in gaps above 0.1 s."""
    poses = np.full((len(t), 4, 4), np.nan)
    if len(truth.t) < 2:
        return poses
    after = np.clip(np.searchsorted(truth.t, t), 1, len(truth.t) - 1)
    gap = truth.t[after] - truth.t[after - 1]
    known = (gap <= _MOST_GAP_S) | (np.abs(truth.t[nearest(t, truth.t)] - t) <= _AT_A_STAMP_S)
    inside = (t >= truth.t[0]) & (t <= truth.t[-1]) & known
    poses[inside] = interpolant(*truth).pose(t[inside])
    return poses
