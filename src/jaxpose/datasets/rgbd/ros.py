"""Bags of ROS 1 and ROS 2 as recordings: colour, depth, camera, IMU and poses by their messages' types."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxpose.datasets.images import check_some_depth
from jaxpose.datasets.rgbd.pairs import nearest_pairs, unpaired_note
from jaxpose.datasets.rgbd.ros_bag import Bag, bag_file, open_bag
from jaxpose.datasets.rgbd.ros_cameras import common_view
from jaxpose.datasets.rgbd.ros_frames import read_tree, stamp_ns
from jaxpose.datasets.rgbd.ros_images import color_of, depth_of
from jaxpose.datasets.rgbd.ros_motion import Log, inertial, read_into, true_poses
from jaxpose.datasets.rgbd.ros_topics import Chosen, ImageTopic, choose
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.tables import seconds

_MOST_APART_S = 0.02  # between the timestamps of colour and depth


class _Images(NamedTuple):
    """The images of a topic in order of their timestamps."""

    topic: ImageTopic
    ns: list[int]
    at: list[int]  # the number of each among the topic's messages
    recorded_ns: list[int]  # of all messages, in their order


def detect(path: Path) -> bool:
    """Whether a path is a bag, or a folder that holds one.

    Args:
        path: A file or folder.

    Returns:
        Whether `load` should read it.
    """
    return bag_file(path) is not None


def load(path: Path | str, *, topics: Sequence[str] = ()) -> Recording:
    """Read a bag: ROS 1, or ROS 2 with sqlite3 or MCAP. Needs the package rosbags (extra `ros`), no ROS.

    Topics are found by the types of their messages and the sizes of their images; a note says which were
    taken and which others there are. The bag is passed over once for timestamps (of headers; of recording
    where those are 0), readings and poses; images are read from it when asked for. Colour and depth are
    paired one to one, nearest first, within 0.02 s. Depth in another frame of reference than colour is
    registered to it by /tf_static. A lens that `Camera` has no model for (rational_polynomial with k4 to k6)
    is undone in the images. The ground truth is a topic of poses (PoseStamped, PoseWithCovarianceStamped,
    TransformStamped, Odometry), else what moves in /tf above the camera; its z axis is taken to point up (REP
    103).

    Args:
        path: The bag, or a folder that holds one.
        topics: Names of topics to use before others of their kind.

    Returns:
        The recording; its notes say what was chosen, left out or assumed.

    Raises:
        DataError: Naming bag and topic for anything that cannot be used.
    """
    bag = open_bag(path)
    chosen = choose(bag, topics)
    tree = read_tree(bag)
    color, depth, imus, poses, notes = _pass_over(bag, chosen)
    of_color, of_depth = (seconds(images.ns, color.ns[0]) for images in (color, depth))
    rows, partners = nearest_pairs(str(bag.path), of_color, of_depth, _MOST_APART_S)
    notes += unpaired_note("colour", "depth", [str(ns) for ns in color.ns], rows, _MOST_APART_S)
    notes += unpaired_note("depth", "colour", [str(ns) for ns in depth.ns], partners, _MOST_APART_S)
    ns, frame = [color.ns[row] for row in rows], chosen.color.frame
    view = common_view(bag, tree, chosen.color, chosen.depth)
    depth_at = lambda i: _read(bag, depth, partners[i], depth_of)
    check_some_depth(f"{bag.path}: {chosen.depth.topic.name}", len(rows), depth_at, str)
    T_world_cam, truth = true_poses(poses, tree, frame, ns)
    imu, T_body_cam, sensed = inertial(imus, tree, frame, ns[0])
    return Recording(
        name=Path(path).resolve().stem,
        camera=view.camera,
        t=seconds(ns, ns[0]),
        read=lambda i: view.frame(_read(bag, color, rows[i], color_of), depth_at(i)),
        T_world_cam=T_world_cam,
        imu=imu,
        T_body_cam=T_body_cam,
        notes=(*chosen.notes, *notes, *view.notes, *truth, *sensed),
        t0_ns=ns[0],
    )


def _pass_over(
    bag: Bag, chosen: Chosen
) -> tuple[_Images, _Images, dict[str, Log], dict[str, Log], tuple[str, ...]]:
    """Timestamps of colour and depth, all readings and poses, and notes."""
    images: dict[str, tuple[list[int], list[int]]]
    images = {image.topic.name: ([], []) for image in (chosen.color, chosen.depth)}
    names = [[topic.name for topic in topics] for topics in (chosen.imus, chosen.poses)]
    logs: list[dict[str, Log]] = [{}, {}]
    unset = 0
    for name, recorded_ns, message in bag.messages(*images, *names[0], *names[1]):
        ns = stamp_ns(message.header)
        unset += not ns
        ns = ns or recorded_ns
        if name in images:
            images[name][0].append(ns)
            images[name][1].append(recorded_ns)
        else:
            log = logs[name in names[1]]
            log[name] = read_into(log.get(name), ns, message)
    notes = [f"{unset} messages without a timestamp: took the time of their recording"] if unset else []
    ordered = []
    for topic in (chosen.color, chosen.depth):
        stamps, recorded = images[topic.topic.name]
        first: dict[int, int] = {}
        for i, ns in enumerate(stamps):
            first.setdefault(ns, i)
        if repeated := len(stamps) - len(first):
            notes.append(f"{topic.topic.name}: {repeated} images left out, of the timestamp of another")
        ordered.append(_Images(topic, sorted(first), [first[ns] for ns in sorted(first)], recorded))
    return ordered[0], ordered[1], logs[0], logs[1], tuple(notes)


def _read(bag: Bag, images: _Images, row: int, pixels: Callable[[Any], np.ndarray]) -> np.ndarray:
    """An image of a topic, of the size that its first one has."""
    topic, at = images.topic, images.at[row]
    where = f"{bag.path}: {topic.topic.name}: message {at}"
    try:
        image = pixels(bag.message(topic.topic.name, images.recorded_ns, at))
    except ValueError as error:
        raise DataError(f"{where}: {error}") from None
    if image.shape[1::-1] != topic.kind.size:
        size, other = (f"{w}x{h}" for w, h in (topic.kind.size, image.shape[1::-1]))
        raise DataError(f"{where}: expected {size}, the size of the first, got {other}")
    return image
