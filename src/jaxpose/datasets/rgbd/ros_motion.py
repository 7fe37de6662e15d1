"""The motion in a bag: true poses of the camera, and the readings of its IMU."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.ground_truth import poses_at
from jaxpose.datasets.images import usable_poses
from jaxpose.datasets.rgbd.ros_frames import Tree, frame_name, pose_matrix
from jaxpose.files.tables import seconds
from jaxpose.files.trajectories import Trajectory
from jaxpose.imu import Imu

_LACK = "none near its timestamp"


class Log(NamedTuple):
    """What a topic of readings or of poses says, by timestamp [ns]; of equal ones the first counts."""

    frame: str  # of reference: the sensor's, or the one whose poses these are; empty where not said
    values: dict[int, np.ndarray]  # (6,) rates [rad/s] and forces [m/s^2], or (4, 4)


def read_into(log: Log | None, ns: int, message: Any) -> Log:
    """The log with one more message.

    Args:
        log: Of the messages before, None for the first.
        ns: The message's timestamp.
        message: `sensor_msgs/Imu`, or one of the types that have a pose.

    Returns:
        The log.
    """
    if hasattr(message, "angular_velocity"):
        rate, force = message.angular_velocity, message.linear_acceleration
        value, frame = np.array([rate.x, rate.y, rate.z, force.x, force.y, force.z]), message.header.frame_id
    else:
        pose = getattr(message, "pose", None)
        if pose is None:
            value = pose_matrix(message.transform.translation, message.transform.rotation)
        else:
            pose = getattr(pose, "pose", pose)
            value = pose_matrix(pose.position, pose.orientation)
        frame = getattr(message, "child_frame_id", "")
    log = Log(frame_name(frame), {}) if log is None else log
    log.values.setdefault(ns, value)
    return log


class LeadingPoses(NamedTuple):
    """Poses of a topic, of a frame of reference from which a camera's place is known."""

    ns: list[int]  # (k,)
    T_world_child: Float[np.ndarray, "k 4 4"]
    T_child_cam: Float[np.ndarray, "4 4"]


def leading_poses(
    logs: dict[str, Log], tree: Tree, camera_frame: str, *, fewest: int
) -> tuple[LeadingPoses | None, list[str]]:
    """Find the first topic of poses that leads to a camera.

    Args:
        logs: Topics of poses.
        tree: Frames of reference.
        camera_frame: The camera's.
        fewest: Poses that it has to have.

    Returns:
        The poses, or None; notes on what they are and what was left out.
    """
    notes = []
    for topic, (child, values) in logs.items():
        stamps = [at for at in sorted(values) if np.isfinite(values[at]).all()]
        T_child_cam = tree.static(child, camera_frame) if child else np.eye(4)
        if T_child_cam is None:
            notes.append(f"{topic} left out: no transform from {child} to {camera_frame} in /tf_static")
        elif len(stamps) >= fewest:
            notes.append(f"ground truth: {topic}, poses of {child or f'{camera_frame}, as it does not say'}")
            if lost := len(values) - len(stamps):
                notes.append(f"{lost} of {len(values)} poses of {topic} left out, with NaN or no quaternion")
            return LeadingPoses(stamps, np.stack([values[at] for at in stamps]), T_child_cam), notes
    return None, notes


def true_poses(
    logs: dict[str, Log], tree: Tree, camera_frame: str, ns: list[int]
) -> tuple[Float[np.ndarray, "n 4 4"] | None, tuple[str, ...]]:
    """Find the camera's true poses: the first topic of poses that leads to the camera, else /tf.

    Args:
        logs: Topics of poses.
        tree: Frames of reference.
        camera_frame: The camera's.
        ns: Timestamps (n,) of the images.

    Returns:
        T_world_cam interpolated to the images, NaN where nothing is near; notes on what it is.
    """
    names = [str(timestamp) for timestamp in ns]
    found, notes = leading_poses(logs, tree, camera_frame, fewest=2)
    if found is not None:
        known = Trajectory(seconds(found.ns, ns[0]), found.T_world_child)
        poses = poses_at(known, seconds(ns, ns[0])) @ found.T_child_cam
    else:
        poses = tree.at(camera_frame, ns)
        if poses is None:
            return None, (
                *notes,
                "no poses that lead to the camera: there is no ground truth to compare with",
            )
        notes.append(f"ground truth: /tf from {tree.chain(camera_frame)[-1]} to {camera_frame}")
    checked, lacking = usable_poses(poses, names, lambda i: names[i], _LACK)
    return checked, (*notes, *lacking)


def inertial(
    logs: dict[str, Log], tree: Tree, camera_frame: str, t0_ns: int
) -> tuple[Imu | None, Float[np.ndarray, "4 4"], tuple[str, ...]]:
    """Find the IMU: a topic with both sensors, else the two of a camera that has a topic for each.

    Args:
        logs: Topics of readings; one with rates of exactly 0 throughout has no gyroscope.
        tree: Frames of reference.
        camera_frame: The camera's.
        t0_ns: Where time is 0.

    Returns:
        Readings, T_body_cam, and notes; no readings where the camera's place on the sensor is not known.
    """
    tables = {}
    for topic, log in logs.items():
        stamps = sorted(ns for ns, row in log.values.items() if np.isfinite(row).all())
        if len(stamps) > 1:
            tables[topic] = (stamps, np.array([log.values[at] for at in stamps]))
    most = lambda names: max(names, key=lambda name: len(tables[name][0]), default=None)
    gyros = {name for name, (_, values) in tables.items() if values[:, :3].any()}
    forces = {name for name, (_, values) in tables.items() if values[:, 3:].any()}
    both = most(gyros & forces)
    gyro, force = both or most(gyros), both or most(forces)
    if gyro is None or force is None:
        return None, np.eye(4), ()
    frame, named = logs[gyro].frame, gyro if gyro == force else f"{gyro} with {force}"
    T_body_cam = tree.static(frame, camera_frame)
    if T_body_cam is None:
        note = f"IMU {named} left out: no transform from {frame} to {camera_frame} in /tf_static"
        return None, np.eye(4), (note,)
    stamps, values = tables[gyro]
    t, acceleration = seconds(stamps, t0_ns), values[:, 3:]
    if gyro != force:
        of_force = seconds(tables[force][0], t0_ns)
        inside = (t >= of_force[0]) & (t <= of_force[-1])
        t, values = t[inside], values[inside]
        acceleration = np.stack([np.interp(t, of_force, x) for x in tables[force][1][:, 3:].T], axis=-1)
    return Imu(t, values[:, :3], acceleration), T_body_cam, (f"IMU: {named}, in {frame}",)
