"""A hand-held motion in closed form, what an IMU reads along it, noisy camera poses: no estimator's code."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxpose.imu import Imu, ImuNoise

GRAVITY = np.array([0.0, 0.0, -9.80665])
SHEET = ImuNoise(5e-4, 5e-3, 1e-5, 1e-4)  # a phone's
PHASES = np.array([[0.3, 1.1, 2.0], [0.7, 2.9, 1.3], [1.9, 0.2, 2.4]])
HZ = np.array([0.31, 0.83, 1.7])


def wave(t, amplitude):
    """Three sines an axis, (n, 3), and their first two derivatives."""
    w = 2 * np.pi * HZ
    angle = w * t[:, None, None] + PHASES
    size = amplitude * np.array([1.0, 0.35, 0.08])
    return (
        (size * np.sin(angle)).sum(2),
        (size * w * np.cos(angle)).sum(2),
        -(size * w**2 * np.sin(angle)).sum(2),
    )


def body(t):
    """Poses (n, 4, 4), body rates and specific forces along the motion."""
    position, _, acceleration = wave(t, 0.4)
    angles, _, _ = wave(t + 0.4, 0.5)
    rotation = Rotation.from_euler("ZYX", angles)
    step = 1e-5
    either = [Rotation.from_euler("ZYX", wave(t + 0.4 + s, 0.5)[0]) for s in (-step, step)]
    omega = (either[0].inv() * either[1]).as_rotvec() / (2 * step)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rotation.as_matrix(), position
    return T, omega, rotation.inv().apply(acceleration - GRAVITY)


def readings(duration_s, rate_hz, rng, gyro_bias=(0.0, 0.0, 0.0), accelerometer_bias=(0.0, 0.0, 0.0)):
    """An IMU's readings with white noise of `SHEET` and constant biases."""
    t = np.arange(-0.5, duration_s + 0.5, 1 / rate_hz)
    _, omega, force = body(t)
    noise = np.sqrt(rate_hz) * rng.normal(size=(2, len(t), 3))
    return Imu(
        t,
        omega + gyro_bias + SHEET.gyro_density * noise[0],
        force + accelerometer_bias + SHEET.accelerometer_density * noise[1],
    )


def cameras(t, rng, T_body_cam, position_m, rotation_rad):
    """Camera poses with white noise on their right, as a tracker's errors are."""
    T = body(t)[0] @ T_body_cam
    noisy = T.copy()
    noisy[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, :3], position_m * rng.normal(size=(len(t), 3)))
    turn = Rotation.from_rotvec(rotation_rad * rng.normal(size=(len(t), 3))).as_matrix()
    noisy[:, :3, :3] = T[:, :3, :3] @ turn
    return T, noisy
