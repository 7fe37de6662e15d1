"""Where the first camera stands: by its true pose, or upright by what an accelerometer reads around it."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose.datasets.types import Recording
from jaxpose.geometry import rigid
from jaxpose.imu import Imu, integrate_gyro

_AROUND_S = 2.0  # before and after: a hand's changes of speed average out, and a gyroscope's bias, both ways
_AROUND_UNTURNED_S = 0.5  # without a gyroscope to turn the readings by
_MOST_OFF_GRAVITY = 0.2  # of the mean force's length
_LEAST_LEVEL = 0.1  # of the direction of view; below it a camera looks straight up or down


class FirstPose(NamedTuple):
    """The first camera in the world, and what is to be told of that world's frame."""

    T_world_cam: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...]


def first_pose(recording: Recording) -> FirstPose:
    """By ground truth where it is known (as in NICE-SLAM), else at the origin, upright where a sensor tells.

    Upright: gravity points where the recording states it, and the camera's heading is x (REP 103).
    """
    ground_truth = recording.T_world_cam
    if ground_truth is not None and np.isfinite(ground_truth[0]).all():
        return FirstPose(np.array(ground_truth[0], np.float64), ())
    force = first_force(recording)
    if force is None or not is_gravity(force, recording.gravity_world):
        return FirstPose(np.eye(4), ("the world's frame is the first camera's",))
    note = "the world is upright by the accelerometer, its x where the first camera looks"
    return FirstPose(_upright(force, recording.gravity_world), (note,))


def upright_pose(
    imu: Imu | None,
    t: float,
    T_body_cam: Float[np.ndarray, "4 4"],
    gravity_world: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "4 4"]:
    """T_world_cam of a camera at `t` [s], upright by readings around it; identity where they do not tell."""
    force = None if imu is None else _force_by_imu(imu, t, T_body_cam)
    if force is None or not is_gravity(force, gravity_world):
        return np.eye(4)
    return _upright(force, gravity_world)


def _upright(
    force_cam: Float[np.ndarray, "3"], gravity_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """T_world_cam at the origin in which the mean force points up, x where the camera looks."""
    up_world = -gravity_world / np.linalg.norm(gravity_world)
    up_cam = force_cam / np.linalg.norm(force_cam)
    ahead_cam = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(up_cam, ahead_cam)) < _LEAST_LEVEL:
        ahead_cam = np.array([0.0, -1.0, 0.0])  # the image's upper edge
    ahead_world = np.array([1.0, 0.0, 0.0]) if abs(up_world[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    return rigid.make(_axes(up_world, ahead_world) @ _axes(up_cam, ahead_cam).T, np.zeros(3))


def first_force(recording: Recording) -> Float[np.ndarray, "3"] | None:
    """The mean specific force [m/s^2] around the first frame, in its camera's axes; None where none was read.

    With a gyroscope of 2 s before and after, turned to the first frame; without, of 0.5 s, as read.
    """
    first = recording.t[0]
    if recording.imu is not None:
        return _force_by_imu(recording.imu, first, recording.T_body_cam)
    if recording.accelerometer is None:
        return None
    t, force_cam = recording.accelerometer
    near = np.abs(t - first) <= _AROUND_UNTURNED_S
    return force_cam[near].mean(axis=0) if near.any() else None


def _force_by_imu(
    imu: Imu, first: float, T_body_cam: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "3"] | None:
    """The mean specific force around a time [s], turned there by the gyroscope, in the camera's axes."""
    t, omega_body, force_body = (np.asarray(x, np.float64) for x in imu)
    near = np.flatnonzero(np.abs(t - first) <= _AROUND_S)
    if not len(near):
        return None
    turned = integrate_gyro(
        jnp.eye(3), jnp.asarray(t[near] - first, jnp.float32), jnp.asarray(omega_body[near], jnp.float32)
    )
    R_start_body = np.asarray(turned, np.float64)
    R_start_first = R_start_body[np.abs(t[near] - first).argmin()]
    mean_start = np.einsum("nij,nj->i", R_start_body, force_body[near]) / len(near)
    return (R_start_first @ T_body_cam[:3, :3]).T @ mean_start


def is_gravity(force: Float[np.ndarray, "3"], gravity_world: Float[np.ndarray, "3"]) -> bool:
    """Whether a mean force is about as long as gravity: the readings hold it, and in m/s^2."""
    ratio = np.linalg.norm(force) / np.linalg.norm(gravity_world)
    return bool(abs(ratio - 1) <= _MOST_OFF_GRAVITY)


def _axes(up: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Columns: ahead as far as it is level, left of it, up."""
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left)
    return np.stack([np.cross(left, up), left, up], axis=1)
