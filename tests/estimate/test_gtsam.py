"""The same poses and readings smoothed by GTSAM: preintegrated factors between poses, and its marginals."""

import gtsam
import numpy as np
import pytest
from helpers import hand_held

from jaxpose.estimate import smooth
from jaxpose.geometry import rigid

POSITION_M, ROTATION_RAD = 0.01, 0.005
BIAS = (np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.1, -0.08]))
BIAS_SIGMA = (0.3, 1.0)  # what `smooth` expects of biases before


def by_gtsam(t, T, imu, noise):
    """Poses at t and their covariances, of the increment [rotation, translation] as GTSAM has it."""
    X, V, B = (lambda k, c=c: gtsam.symbol(c, k) for c in "xvb")
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(-hand_held.GRAVITY[2])
    params.setGyroscopeCovariance(np.eye(3) * noise.gyro_density**2)
    params.setAccelerometerCovariance(np.eye(3) * noise.accelerometer_density**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    params.setBiasOmegaCovariance(np.eye(3) * noise.gyro_walk**2)
    params.setBiasAccCovariance(np.eye(3) * noise.accelerometer_walk**2)
    none = gtsam.imuBias.ConstantBias()
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    of_pose = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([ROTATION_RAD, POSITION_M], 3))
    for k, pose in enumerate(T):
        graph.add(gtsam.PriorFactorPose3(X(k), gtsam.Pose3(pose), of_pose))
        start.insert(X(k), gtsam.Pose3(pose))
        j = min(k, len(T) - 2)
        start.insert(V(k), (T[j + 1, :3, 3] - T[j, :3, 3]) / (t[j + 1] - t[j]))
        start.insert(B(k), none)
    of_bias = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(BIAS_SIGMA[::-1], 3))
    graph.add(gtsam.PriorFactorConstantBias(B(0), none, of_bias))
    for k in range(len(T) - 1):
        summed = gtsam.PreintegratedCombinedMeasurements(params, none)
        inside = imu.t[(imu.t > t[k] + 1e-9) & (imu.t < t[k + 1] - 1e-9)]
        grid = np.concatenate([t[k : k + 1], inside, t[k + 1 : k + 2]])
        grid = np.interp(np.arange(8 * len(grid) - 7) / 8, np.arange(len(grid)), grid)
        middle = (grid[1:] + grid[:-1]) / 2
        at = lambda x, middle=middle: np.stack([np.interp(middle, imu.t, column) for column in x.T], axis=1)
        for omega, force, dt in zip(
            at(imu.omega_body), at(imu.acceleration_body), np.diff(grid), strict=True
        ):
            summed.integrateMeasurement(force, omega, dt)
        graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), summed))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, found)
    poses = np.array([found.atPose3(X(k)).matrix() for k in range(len(T))])
    return poses, np.array([marginals.marginalCovariance(X(k)) for k in range(len(T))])


@pytest.mark.slow
def test_poses_and_covariances_are_those_of_gtsam():
    """It turns forces by the orientation at the start of a step, so that steps are an eighth of a sample."""
    rng, noise = np.random.default_rng(0), hand_held.SHEET
    t = np.arange(0.0, 12.0, 1 / 3)
    true, T = hand_held.cameras(t, rng, np.eye(4), POSITION_M, ROTATION_RAD)
    imu = hand_held.readings(12.0, 200.0, rng, *BIAS)
    theirs, P_theirs = by_gtsam(t, T, imu, noise)
    sigmas = np.repeat([POSITION_M, ROTATION_RAD], 3)
    ours = smooth(t, T, sigmas, imu, estimate=("biases",), noise=noise, fit_noise=False)
    P, found = ours.covariance(t), ours.pose(t)
    apart = rigid.log(rigid.inverse(theirs) @ found)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert np.sqrt(np.mean((apart / sigma) ** 2)) < 0.15
    sigma_theirs = np.sqrt(np.diagonal(P_theirs, axis1=1, axis2=2))[:, [3, 4, 5, 0, 1, 2]]
    np.testing.assert_allclose(sigma, sigma_theirs, rtol=0.08)
    rmse = lambda x: np.sqrt(np.mean(np.sum((x[:, :3, 3] - true[:, :3, 3]) ** 2, axis=1)))
    assert rmse(found) < 1.05 * rmse(theirs) and rmse(found) < 0.6 * rmse(T)
