"""A box seen by a moving camera, in closed form: frames, photographs, events and readings of an IMU.

Colour is a function of place. The camera turns steadily about one axis, and moves along an arc.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

K, SIZE = (60.0, 60.0, 39.5, 29.5), (80, 60)  # fx fy cx cy; width, height
COUNT, STEP_S = 8, 0.1  # 4 cm and 2 degrees a frame
LOWER, UPPER = np.array([-2.0, -1.5, -1.0]), np.array([2.0, 1.5, 3.0])
TURN, MOVE = np.array([0.1, 0.35, 0.0]), np.array([0.3, 0.1, 0.2])  # [rad/s, m/s]
SWAY, RATE = np.array([0.0, 0.06, -0.04]), 4.0  # [m, rad/s], beside the way
UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # the box, whose y points down, in a world whose z is up


class Walk(NamedTuple):
    """Frames, as the fixture of this name has them."""

    rgb: np.ndarray  # (n, h, w, 3) uint8
    counts: np.ndarray  # (n, h, w) uint16 [mm]
    T_world_cam: np.ndarray  # (n, 4, 4)


def poses(t):
    """Poses (n, 4, 4) at times [s]."""
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(t, TURN)).as_matrix()
    T[:, :3, 3] = np.outer(t, MOVE) + np.outer(np.cos(RATE * np.asarray(t)), SWAY)
    return T


def pinhole(K=K, size=SIZE):
    """Rays of all pixels, z = 1."""
    v, u = np.mgrid[0 : size[1], 0 : size[0]]
    return np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones(u.shape)], axis=-1)


def look(T, rays):
    """Colour (h, w, 3) in [0, 1] and depth (h, w) [m] along z."""
    direction = rays @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        depth = np.where(direction > 0, UPPER - T[:3, 3], LOWER - T[:3, 3]) / direction
    depth = np.min(np.where(np.isfinite(depth), depth, np.inf), axis=-1)
    return 0.5 + 0.4 * np.sin(3 * (T[:3, 3] + depth[..., None] * direction)), depth


def walk(count=COUNT) -> Walk:
    """The first frames, 10 a second."""
    T = poses(STEP_S * np.arange(count))
    seen = [look(pose, pinhole()) for pose in T]
    rgb, depth = (np.stack(part) for part in zip(*seen, strict=True))
    return Walk((255 * rgb).astype(np.uint8), np.rint(1000 * depth).astype(np.uint16), T)


def readings(t, R_body_cam):
    """Rates [rad/s] and specific forces [m/s^2] of an IMU at times [s]: (n, 3) each."""
    rate = np.tile(R_body_cam @ TURN, (len(t), 1))
    force = UP @ (-(RATE**2) * np.outer(np.cos(RATE * t), SWAY))[..., None] + [[0.0], [0.0], [9.81]]
    R_up_body = UP @ poses(t)[:, :3, :3] @ R_body_cam.T
    return rate, (R_up_body.transpose(0, 2, 1) @ force)[..., 0]


def events(duration_s=0.7, threshold=0.1, every_s=0.002):
    """Rows (t [us], x, y, p) sorted by time: where the logarithm of green crosses levels."""
    t = np.arange(0, duration_s, every_s)
    level = lambda k: np.log(0.1 + look(poses(t[k : k + 1])[0], pinhole())[0][..., 1]) / threshold
    before, rows = level(0), []
    last = np.floor(before)
    for k in range(1, len(t)):
        after = level(k)
        while len(cells := np.argwhere(np.abs(after - last - 0.5) > 1)):
            y, x = cells.T
            up = after[y, x] > last[y, x]
            crossed = last[y, x] + np.where(up, 1.5, -0.5)
            share = (crossed - before[y, x]) / (after[y, x] - before[y, x])
            us = np.rint(1e6 * (t[k - 1] + every_s * np.clip(share, 0, 1)))
            rows.append(np.stack([us, x, y, up], axis=1))
            last[y, x] += np.where(up, 1, -1)
        before = after
    rows = np.concatenate(rows).astype(np.int64)
    return rows[np.argsort(rows[:, 0], kind="stable")]
