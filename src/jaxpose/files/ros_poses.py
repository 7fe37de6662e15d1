"""Poses as messages of ROS, in a bag of ROS 1 or in MCAP, by the package `rosbags`."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.files.atomic import atomic
from jaxpose.files.timestamps import whole_ns
from jaxpose.files.trajectories import Trajectory

EXTRA = 'pip install -e ".[ros]"'
WORLD, CAMERA = "world", "camera"  # frames of reference
_LATEST_NS = 2**31 * 10**9  # seconds are int32 in ROS 2
_TF = "geometry_msgs/TransformStamped[] transforms"


class _Message(NamedTuple):
    topic: str
    kind: str
    ns: int
    content: Any


def write_ros_poses(
    path: Path | str,
    trajectory: Trajectory,
    covariance: Float[np.ndarray, "n 6 6"] | None = None,
    *,
    form: Literal["mcap", "bag"],
) -> None:
    """Write poses for RViz, Foxglove and other programs of ROS. Needs the package rosbags (extra `ros`).

    `/pose` has geometry_msgs/PoseStamped, or PoseWithCovarianceStamped, `/path` one nav_msgs/Path of all,
    `/tf` the camera in the world. The camera's axes are right, down, forward, those of ROS's optical frames.

    Args:
        path: The file, MCAP of ROS 2 or a bag of ROS 1, written whole or not at all.
        trajectory: Poses `T_world_cam`; those with NaN are left out.
        covariance: Of increments [translation, rotation] (m, rad) on the right, as `field.npz` has them. ROS
            has them about the world's axes.
        form: What the file is.

    Raises:
        DataError: Without the package, without poses, and for timestamps that ROS has no numbers for.
        ValueError: For arrays of other shapes.
    """
    path, poses = Path(path), (trajectory.t, trajectory.T)
    check_shapes(t=(poses[0], "n"), T=(poses[1], "n 4 4"))
    finite = np.flatnonzero(np.isfinite(trajectory.T).all((1, 2)))
    ns = [whole_ns(trajectory.t, trajectory.t0_ns)[i] for i in finite]
    if not ns or ns[0] < 0 or ns[-1] >= _LATEST_NS:
        got = f"{ns[0]} to {ns[-1]} ns" if ns else "none"
        raise DataError(f"{path}: expected poses from 1970 to 2038, as ROS counts seconds, got {got}")
    if covariance is not None:
        check_shapes(t=(poses[0], "n"), covariance=(covariance, "n 6 6"))
        covariance = _about_world(covariance[finite], trajectory.T[finite, :3, :3])
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise DataError(f"{path}: a bag of ROS needs the package rosbags: {EXTRA}") from None
    store = get_typestore(Stores.ROS2_HUMBLE if form == "mcap" else Stores.ROS1_NOETIC)
    if form == "bag":
        store.register(get_types_from_msg(_TF, "tf2_msgs/msg/TFMessage"))
    messages = _messages(_maker(store.types, form), ns, trajectory.T[finite], covariance)
    with atomic(path) as temporary:
        _write(temporary, store, messages, form)


def _about_world(
    covariance: Float[np.ndarray, "n 6 6"], rotation: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of increments in the camera's axes as those in the world's."""
    turn = np.zeros_like(covariance)
    turn[:, :3, :3] = turn[:, 3:, 3:] = rotation
    return turn @ covariance @ turn.swapaxes(1, 2)


def _maker(types: dict[str, Any], form: str) -> Callable[..., Any]:
    """A function that makes a message, of whose timestamps and frames only the values are given."""

    def make(kind: str, **values: Any) -> Any:
        if kind == "std_msgs/msg/Header":
            seconds, rest = divmod(values.pop("ns"), 10**9)
            values["stamp"] = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
            values |= {} if form == "mcap" else {"seq": 0}
        return types[kind](**values)

    return make


def _messages(
    make: Callable[..., Any],
    ns: list[int],
    T: Float[np.ndarray, "n 4 4"],
    covariance: Float[np.ndarray, "n 6 6"] | None,
) -> Iterator[_Message]:
    """All messages in the order of time; the path of all poses stands at the first."""
    geometry = "geometry_msgs/msg"
    xyz = lambda kind, p: make(f"{geometry}/{kind}", x=p[0], y=p[1], z=p[2])
    header = lambda at: make("std_msgs/msg/Header", ns=at, frame_id=WORLD)
    poses, transforms = [], []
    for at, p, q in zip(ns, T[:, :3, 3].tolist(), Rotation.from_matrix(T[:, :3, :3]).as_quat(), strict=True):
        turn = make(f"{geometry}/Quaternion", **dict(zip("xyzw", q.tolist(), strict=True)))
        pose = make(f"{geometry}/Pose", position=xyz("Point", p), orientation=turn)
        poses.append(make(f"{geometry}/PoseStamped", header=header(at), pose=pose))
        moved = make(f"{geometry}/Transform", translation=xyz("Vector3", p), rotation=turn)
        transforms.append(
            make(f"{geometry}/TransformStamped", header=header(at), child_frame_id=CAMERA, transform=moved)
        )
    path = make("nav_msgs/msg/Path", header=header(ns[0]), poses=poses)
    yield _Message("/path", "nav_msgs/msg/Path", ns[0], path)
    for i, (at, pose, transform) in enumerate(zip(ns, poses, transforms, strict=True)):
        kind = "PoseStamped"
        if covariance is not None:
            both = make(
                f"{geometry}/PoseWithCovariance", pose=pose.pose, covariance=covariance[i].reshape(-1)
            )
            kind = "PoseWithCovarianceStamped"
            pose = make(f"{geometry}/{kind}", header=pose.header, pose=both)
        yield _Message("/pose", f"{geometry}/{kind}", at, pose)
        tf = make("tf2_msgs/msg/TFMessage", transforms=[transform])
        yield _Message("/tf", "tf2_msgs/msg/TFMessage", at, tf)


def _write(file: Path, store: Any, messages: Iterator[_Message], form: str) -> None:
    """The file of messages. `rosbags` writes MCAP into a folder of its own, out of which it is taken."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    with tempfile.TemporaryDirectory(dir=file.parent, prefix=".") as scratch:
        folder = Path(scratch) / "poses"
        if form == "bag":
            writer, serialize = Writer1(folder), store.serialize_ros1
        else:
            writer = Writer2(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            serialize = store.serialize_cdr
        with writer:
            connections = {}
            for topic, kind, ns, content in messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], ns, serialize(content, kind))
        written = folder if form == "bag" else next(folder.glob("*.mcap"))
        written.replace(file)
