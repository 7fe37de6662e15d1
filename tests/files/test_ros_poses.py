"""Poses for ROS: read back by the package rosbags."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.files.ros_poses import write_ros_poses
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry import rigid

T0_NS, COUNT = 1_403_715_523_912_143_101, 4


def walk():
    rng = np.random.default_rng(3)
    rotation = Rotation.from_rotvec(rng.normal(size=(COUNT, 3)))
    T = rigid.make(rotation.as_matrix(), rng.normal(size=(COUNT, 3)))
    return Trajectory(np.arange(COUNT) / 4, T, T0_NS)


def read(path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:
        return [
            (connection.topic, ns, connection.msgtype, reader.deserialize(raw, connection.msgtype))
            for connection, ns, raw in reader.messages()
        ]


def matrix(position, orientation):
    q = [orientation.x, orientation.y, orientation.z, orientation.w]
    return rigid.make(Rotation.from_quat(q).as_matrix(), np.array([position.x, position.y, position.z]))


@pytest.mark.parametrize("form", ["mcap", "bag"])
def test_poses_come_back_to_the_nanosecond(tmp_path, form):
    trajectory, file = walk(), tmp_path / f"poses.{form}"
    write_ros_poses(file, trajectory, form=form)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    by_topic = {}
    for topic, ns, kind, message in read(file):
        by_topic.setdefault(topic, []).append((ns, kind, message))
    assert by_topic.keys() == {"/pose", "/path", "/tf"}
    wanted = [T0_NS + k * 250_000_000 for k in range(COUNT)]
    assert [ns for ns, *_ in by_topic["/pose"]] == [ns for ns, *_ in by_topic["/tf"]] == wanted
    ((_, _, path),) = by_topic["/path"]
    for k, (ns, kind, message) in enumerate(by_topic["/pose"]):
        assert kind == "geometry_msgs/msg/PoseStamped" and message.header.frame_id == "world"
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == ns
        (transform,) = by_topic["/tf"][k][2].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("world", "camera")
        for pose in (message.pose, path.poses[k].pose):
            np.testing.assert_allclose(matrix(pose.position, pose.orientation), trajectory.T[k], atol=1e-12)
        moved = transform.transform
        np.testing.assert_allclose(matrix(moved.translation, moved.rotation), trajectory.T[k], atol=1e-12)


def test_covariances_are_about_the_axes_of_the_world(tmp_path):
    """geometry_msgs/PoseWithCovariance: x, y, z and rotations about fixed axes, row by row."""
    trajectory, rng = walk(), np.random.default_rng(4)
    root = 1e-3 * rng.normal(size=(COUNT, 6, 6))
    write_ros_poses(tmp_path / "a.mcap", trajectory, root @ root.swapaxes(1, 2), form="mcap")
    messages = [message for topic, *_, message in read(tmp_path / "a.mcap") if topic == "/pose"]
    moved = root[2] @ rng.normal(size=(6, 100_000))  # increments in the axes of the camera
    R = Rotation.from_matrix(trajectory.T[2, :3, :3])
    turned = (R * Rotation.from_rotvec(moved[3:].T) * R.inv()).as_rotvec()
    sampled = np.cov(np.vstack([R.apply(moved[:3].T).T, turned.T]))
    stated = messages[2].pose.covariance.reshape(6, 6)
    assert np.abs(stated - sampled).max() < 0.02 * np.abs(sampled).max()


def test_what_ros_cannot_hold_is_refused(tmp_path):
    for change, message in (
        ({"t0_ns": -(10**12)}, "expected poses from 1970 to 2038"),
        ({"t0_ns": 3 * 10**18}, "expected poses from 1970 to 2038"),
        ({"T": np.full((COUNT, 4, 4), np.nan)}, "got none"),
    ):
        with pytest.raises(DataError, match=message):
            write_ros_poses(tmp_path / "a.bag", walk()._replace(**change), form="bag")
    assert not list(tmp_path.iterdir())
