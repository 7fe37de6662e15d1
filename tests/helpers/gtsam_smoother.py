"""Poses and readings smoothed by GTSAM: priors on poses, preintegrated factors between them, marginals."""

import gtsam
import numpy as np

GRAVITY_M_S2 = 9.80665
BIAS_SIGMA = (0.3, 1.0)  # what `jaxpose.estimate.smooth` expects of biases before: rad/s, m/s^2


def by_gtsam(t, T, imu, noise, position_m, rotation_rad):
    """Poses at t and their covariances, of increments [translation, rotation] on their right.

    GTSAM turns a force by the orientation at the start of its step, so that steps are an eighth of a sample.
    """
    X, V, B = (lambda k, c=c: gtsam.symbol(c, k) for c in "xvb")
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(np.eye(3) * noise.gyro_density**2)
    params.setAccelerometerCovariance(np.eye(3) * noise.accelerometer_density**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    params.setBiasOmegaCovariance(np.eye(3) * noise.gyro_walk**2)
    params.setBiasAccCovariance(np.eye(3) * noise.accelerometer_walk**2)
    none = gtsam.imuBias.ConstantBias()
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    of_pose = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([rotation_rad, position_m], 3))
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
    P = np.array([marginals.marginalCovariance(X(k)) for k in range(len(T))])
    return poses, np.roll(P, 3, axis=(1, 2))
