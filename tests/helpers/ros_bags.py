"""Bags of ROS as its own writers make them, by the package rosbags."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

KINDS = ("ros1", "sqlite3", "mcap")
_TF = "geometry_msgs/TransformStamped[] transforms"
_EVENT = "uint16 x\nuint16 y\ntime ts\nbool polarity"
_EVENT_ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events"


class Message(NamedTuple):
    """A message to be written."""

    topic: str
    kind: str  # sensor_msgs/msg/Image
    recorded_ns: int
    content: object


class Maker:
    """Messages of ROS 1 or ROS 2, and the bag of them."""

    def __init__(self, kind: str):
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if kind == "ros1":
            self.store.register(get_types_from_msg(_TF, "tf2_msgs/msg/TFMessage"))

    def of(self, kind: str):
        return self.store.types[kind]

    def header(self, ns: int, frame: str):
        stamp = self.of("builtin_interfaces/msg/Time")(sec=ns // 10**9, nanosec=ns % 10**9)
        more = {"seq": 0} if self.kind == "ros1" else {}
        return self.of("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **more)

    def image(self, ns: int, frame: str, encoding: str, pixels: np.ndarray, padding: int = 0):
        height, width = pixels.shape[:2]
        rows = np.pad(np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1), ((0, 0), (0, padding)))
        return self.of("sensor_msgs/msg/Image")(
            header=self.header(ns, frame),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=int(pixels.dtype.byteorder == ">"),
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def compressed(self, ns: int, frame: str, form: str, data: bytes):
        return self.of("sensor_msgs/msg/CompressedImage")(
            header=self.header(ns, frame), format=form, data=np.frombuffer(data, np.uint8)
        )

    def camera_info(self, ns: int, frame: str, K, size, model="plumb_bob", D=()):
        region = self.of("sensor_msgs/msg/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        fx, fy, cx, cy = K
        numbers = {
            "D": np.array(D, np.float64),
            "K": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], np.float64),
            "R": np.eye(3).reshape(-1),
            "P": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], np.float64),
        }
        if self.kind != "ros1":
            numbers = {name.lower(): value for name, value in numbers.items()}
        return self.of("sensor_msgs/msg/CameraInfo")(
            header=self.header(ns, frame), width=size[0], height=size[1], distortion_model=model,
            binning_x=0, binning_y=0, roi=region, **numbers,
        )  # fmt: skip

    def vector(self, xyz, kind="Vector3"):
        return self.of(f"geometry_msgs/msg/{kind}")(**dict(zip("xyz", map(float, xyz), strict=True)))

    def quaternion(self, rotation: np.ndarray):
        xyzw = Rotation.from_matrix(rotation).as_quat() if np.isfinite(rotation).all() else np.full(4, np.nan)
        return self.of("geometry_msgs/msg/Quaternion")(**dict(zip("xyzw", map(float, xyzw), strict=True)))

    def imu(self, ns: int, frame: str, rate, force):
        quantities = ("orientation", "angular_velocity", "linear_acceleration")
        return self.of("sensor_msgs/msg/Imu")(
            header=self.header(ns, frame),
            orientation=self.quaternion(np.eye(3)),
            angular_velocity=self.vector(rate),
            linear_acceleration=self.vector(force),
            **{f"{name}_covariance": np.zeros(9) for name in quantities},
        )

    def tf(self, ns: int, parent: str, child: str, T: np.ndarray):
        transform = self.of("geometry_msgs/msg/Transform")(
            translation=self.vector(T[:3, 3]), rotation=self.quaternion(T[:3, :3])
        )
        stamped = self.of("geometry_msgs/msg/TransformStamped")(
            header=self.header(ns, parent), child_frame_id=child, transform=transform
        )
        return self.of("tf2_msgs/msg/TFMessage")(transforms=[stamped])

    def pose(self, T: np.ndarray):
        return self.of("geometry_msgs/msg/Pose")(
            position=self.vector(T[:3, 3], "Point"), orientation=self.quaternion(T[:3, :3])
        )

    def pose_stamped(self, ns: int, frame: str, T: np.ndarray):
        return self.of("geometry_msgs/msg/PoseStamped")(header=self.header(ns, frame), pose=self.pose(T))

    def odometry(self, ns: int, frame: str, child: str, T: np.ndarray):
        twist = self.of("geometry_msgs/msg/Twist")(
            linear=self.vector((0, 0, 0)), angular=self.vector((0, 0, 0))
        )
        return self.of("nav_msgs/msg/Odometry")(
            header=self.header(ns, frame),
            child_frame_id=child,
            pose=self.of("geometry_msgs/msg/PoseWithCovariance")(pose=self.pose(T), covariance=np.zeros(36)),
            twist=self.of("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=np.zeros(36)),
        )

    def write(self, folder: Path, messages: list[Message]) -> Path:
        """The bag of messages, in the order of recording."""
        if self.kind == "ros1":
            path, writer = folder / "walk.bag", Writer1(folder / "walk.bag")
            serialize = self.store.serialize_ros1
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            path, writer = folder / "walk", Writer2(folder / "walk", version=9, storage_plugin=plugin)
            serialize = self.store.serialize_cdr
        with writer:
            connections = {}
            for message in sorted(messages, key=lambda message: message.recorded_ns):
                if message.topic not in connections:
                    connections[message.topic] = writer.add_connection(
                        message.topic, message.kind, typestore=self.store
                    )
                raw = serialize(message.content, message.kind)
                writer.write(connections[message.topic], message.recorded_ns, raw)
        return path


def event_bag(folder, kind, columns, size, K, poses_ns, poses, *, D=(), package="dvs_msgs", per=100) -> Path:
    """Events (t [ns], x, y, on) in arrays of `per`, the camera that saw them, and its poses."""
    maker, messages = Maker(kind), []
    event = _EVENT if kind == "ros1" else _EVENT.replace("time", "builtin_interfaces/Time")
    maker.store.register(get_types_from_msg(event, f"{package}/msg/Event"))
    maker.store.register(get_types_from_msg(_EVENT_ARRAY, f"{package}/msg/EventArray"))
    Event, Time = maker.of(f"{package}/msg/Event"), maker.of("builtin_interfaces/msg/Time")
    for start in range(0, len(columns[0]), per):
        rows = zip(*(column[start : start + per].tolist() for column in columns), strict=True)
        events = [
            Event(x=x, y=y, ts=Time(sec=t // 10**9, nanosec=t % 10**9), polarity=bool(on))
            for t, x, y, on in rows
        ]
        ns = int(columns[0][start])
        array = maker.of(f"{package}/msg/EventArray")(
            header=maker.header(ns, "davis"), height=size[1], width=size[0], events=events
        )
        messages.append(Message("/dvs/events", f"{package}/msg/EventArray", ns, array))
    first = poses_ns[0]
    info = maker.camera_info(first, "davis", K, size, D=D)
    messages.append(Message("/dvs/camera_info", "sensor_msgs/msg/CameraInfo", first, info))
    for at, T in zip(poses_ns, poses, strict=True):
        pose = maker.pose_stamped(at, "map", T)
        messages.append(Message("/pose", "geometry_msgs/msg/PoseStamped", at, pose))
    return maker.write(folder, messages)
