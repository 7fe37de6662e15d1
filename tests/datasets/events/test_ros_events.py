"""Events in bags that rosbags writes, with the messages' definitions of their packages."""

import numpy as np
import pytest
from helpers import event_writers
from helpers.ros_bags import Maker, Message, event_bag
from rosbags.typesys import get_types_from_msg

from jaxpose.datasets.events import registry
from jaxpose.errors import DataError

T0_NS, COUNT, SIZE = 1_403_715_523_912_143_000, 997, (346, 260)
PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events"
)
rng = np.random.default_rng(1)
T_NS = T0_NS + np.sort(rng.integers(0, 10**9, COUNT))
X, Y, ON = rng.integers(0, 346, COUNT), rng.integers(0, 260, COUNT), rng.integers(0, 2, COUNT)


def bag(folder, kind, package="dvs_msgs", per=100):
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, 0, 3] = np.arange(5)
    return event_bag(
        folder, kind, (T_NS, X, Y, ON), SIZE, (200.0, 201.0, 170.0, 130.0),
        [T0_NS + 250_000_000 * k for k in range(5)], T,
        D=(0.1, 0.0, 0.0, 0.0, 0.0), package=package, per=per,
    )  # fmt: skip


@pytest.mark.parametrize(
    "kind, package, per",
    [("ros1", "dvs_msgs", 100), ("mcap", "dvs_msgs", 1), ("sqlite3", "prophesee_event_msgs", 7)],
)
def test_events_poses_and_camera_come_back(tmp_path, kind, package, per):
    path = bag(tmp_path, kind, package, per)
    assert registry.find_format(path) == "ros"
    read = registry.load_events(path)
    np.testing.assert_array_equal(np.rint(read.events.t * 1e9), T_NS - T_NS[0])
    np.testing.assert_array_equal(read.events.x, X)
    np.testing.assert_array_equal(read.events.y, Y)
    np.testing.assert_array_equal(read.events.polarity, 2 * ON - 1)
    assert read.camera[:6] == (200.0, 201.0, 170.0, 130.0, *SIZE) and read.camera.distortion[0] == 0.1
    np.testing.assert_allclose(read.t, (T0_NS - T_NS[0]) * 1e-9 + 0.25 * np.arange(5), atol=1e-9)
    np.testing.assert_array_equal(read.T_world_cam[:, 0, 3], np.arange(5))


def test_packets_of_prophesee_cameras(tmp_path):
    """event_camera_msgs: EVT 3.0 as the camera sends it, cut anywhere between words."""
    t = np.sort(rng.integers(0, 2 * 10**6, 500)) + 5_000_000
    x, y, on = X[:500], Y[:500], ON[:500]
    data = event_writers.evt3(np.stack([t, x, y, on], axis=1))
    maker, messages = Maker("mcap"), []
    maker.store.register(get_types_from_msg(PACKET, "event_camera_msgs/msg/EventPacket"))
    packet = maker.of("event_camera_msgs/msg/EventPacket")
    for k, start in enumerate(range(0, len(data), 222)):
        piece = np.frombuffer(data[start : start + 222], np.uint8)
        content = packet(
            header=maker.header(T0_NS + k, "cam"), height=SIZE[1], width=SIZE[0], seq=k, time_base=0,
            encoding="evt3", is_bigendian=False, events=piece,
        )  # fmt: skip
        messages.append(Message("/events", "event_camera_msgs/msg/EventPacket", T0_NS + k, content))
    read = registry.load_events(maker.write(tmp_path, messages))
    np.testing.assert_array_equal(np.rint(read.events.t * 1e6), t - t[0])
    np.testing.assert_array_equal(read.events.x, x)
    np.testing.assert_array_equal(read.events.polarity, 2 * on - 1)


def test_bags_without_events_and_damaged_ones_are_named(tmp_path):
    maker = Maker("mcap")
    pose = maker.pose_stamped(T0_NS, "map", np.eye(4))
    other = maker.write(tmp_path, [Message("/pose", "geometry_msgs/msg/PoseStamped", T0_NS, pose)])
    with pytest.raises(DataError, match="expected a recording of events"):
        registry.find_format(other)
    with pytest.raises(DataError, match="expected a topic of events, EventArray or EventPacket"):
        registry.load_events(other, "ros")
