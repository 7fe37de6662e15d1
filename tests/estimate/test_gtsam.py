"""The same poses and readings smoothed by GTSAM: preintegrated factors between poses, and its marginals."""

import numpy as np
import pytest
from helpers import hand_held
from helpers.gtsam_smoother import by_gtsam

from jaxpose.estimate import smooth
from jaxpose.geometry import rigid

POSITION_M, ROTATION_RAD = 0.01, 0.005
BIAS = (np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.1, -0.08]))


@pytest.mark.slow
def test_poses_and_covariances_are_those_of_gtsam():
    rng, noise = np.random.default_rng(0), hand_held.SHEET
    t = np.arange(0.0, 12.0, 1 / 3)
    true, T = hand_held.cameras(t, rng, np.eye(4), POSITION_M, ROTATION_RAD)
    imu = hand_held.readings(12.0, 200.0, rng, *BIAS)
    theirs, P_theirs = by_gtsam(t, T, imu, noise, POSITION_M, ROTATION_RAD)
    sigmas = np.repeat([POSITION_M, ROTATION_RAD], 3)
    ours = smooth(t, T, sigmas, imu, estimate=("biases",), noise=noise, fit_noise=False)
    P, found = ours.covariance(t), ours.pose(t)
    apart = rigid.log(rigid.inverse(theirs) @ found)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert np.sqrt(np.mean((apart / sigma) ** 2)) < 0.15
    sigma_theirs = np.sqrt(np.diagonal(P_theirs, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma, sigma_theirs, rtol=0.08)
    rmse = lambda x: np.sqrt(np.mean(np.sum((x[:, :3, 3] - true[:, :3, 3]) ** 2, axis=1)))
    assert rmse(found) < 1.05 * rmse(theirs) and rmse(found) < 0.6 * rmse(T)
