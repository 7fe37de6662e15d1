"""Faults for `jaxpose check` to find, and what it said of them."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxpose.cli.check import command as check
from jaxpose.cli.check.command import Config
from jaxpose.files import trajectories

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes to OpenGL's
T0 = 1_403_715_524.0
T0_NS = 1_403_715_524 * 10**9


def checked(path):
    return check.run(Config(Path(path)))


def faults(result):
    """What is not ok, as one text."""
    return " | ".join(f"{f.test}: {f}" for f in result.findings if f.severity != "ok")


def named_tests(result, severity="warning"):
    return [finding.test for finding in result.findings if finding.severity == severity]


def inverted(T):
    return np.linalg.inv(T)


def flipped(T):
    return T @ FLIP


def _around():
    """A camera that is carried around a table and looks at it: T_world_cam, OpenCV axes."""
    t = np.arange(0, 20, 0.05)
    angle = 0.3 * t
    centre = np.stack([2 * np.cos(angle), 2 * np.sin(angle), 1.5 + 0.2 * np.sin(t)], -1)
    forward = -centre / np.linalg.norm(centre, axis=1)[:, None]
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1)[:, None]
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    T[:, :3, 3] = centre
    return trajectories.Trajectory(T0 + t, T)


AROUND = _around()


def write_rows(file, trajectory, order=(0, 1, 2, 3), seconds=1.0):
    quaternions = Rotation.from_matrix(trajectory.T[:, :3, :3]).as_quat()[:, list(order)]
    rows = np.column_stack([trajectory.t * seconds, trajectory.T[:, :3, 3], quaternions])
    file.write_text("".join(" ".join(f"{x:.6f}" for x in row) + "\n" for row in rows))
    return file
