"""Events in bags of ROS 1 and 2: arrays of dvs_msgs or prophesee_event_msgs, packets of event_camera_msgs."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.events.evt import Evt2, Evt3, Evt21
from jaxpose.datasets.events.sidecar import Source, check_mosaic, with_camera
from jaxpose.datasets.events.stream import BLOCK, Block, Stream, Unit, seconds
from jaxpose.datasets.events.validate import clean
from jaxpose.datasets.images import some
from jaxpose.datasets.rgbd.ros_bag import Bag, Topic, bag_file, open_bag
from jaxpose.datasets.rgbd.ros_cameras import lens_of
from jaxpose.datasets.rgbd.ros_frames import frame_name, read_tree, stamp_ns
from jaxpose.datasets.rgbd.ros_images import ImageKind
from jaxpose.datasets.rgbd.ros_motion import Log, leading_poses, read_into
from jaxpose.datasets.rgbd.ros_topics import POSES, ImageTopic
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.files.tables import seconds as since

_KINDS = ("EventArray", "EventPacket")
_PACKETS = {"evt3": Evt3, "evt2": Evt2, "evt21": Evt21}  # Prophesee's, as its cameras' drivers send them
_FIELDS = {"x": "<u2", "y": "<u2", "s": "<u4", "ns": "<u4", "polarity": "u1"}
# An event as ROS 1 packs it, and in CDR, which pads it to its own types: the first of an array, and others.
_ROS1, _FIRST, _OTHERS = (
    np.dtype({"names": list(_FIELDS), "formats": list(_FIELDS.values()), "offsets": at, "itemsize": size})
    for at, size in (((0, 2, 4, 8, 12), 13), ((0, 2, 4, 8, 12), 13), ((0, 2, 6, 10, 14), 16))
)


def detect(path: Path) -> bool:
    """Whether a path is a bag with events, or a folder that holds one.

    Args:
        path: A file or folder.

    Returns:
        Whether `load` should read it.

    Raises:
        DataError: For a bag that cannot be opened, and without the package rosbags.
    """
    return bag_file(path) is not None and bool(_topics(open_bag(path)))


def load(
    path: Path | str,
    *,
    mosaic: Mosaic = "mono",
    size: tuple[int, int] | None = None,
    unit: Unit | None = None,
    span: tuple[float, float] | None = None,
) -> EventRecording:
    """Read the events of a bag, of the topic that has most messages. Needs the package rosbags (extra `ros`).

    The sensor's size is that of the messages, the camera that of a CameraInfo of this size, else of files
    beside the bag (`sidecar.with_camera`). Poses are those of a topic of poses that leads to the camera.

    Args:
        path: The bag, or a folder that holds one.
        mosaic: The colour of the pixels.
        size: Width and height of the sensor, which must be that of the messages.
        unit: Of the timestamps; by default as the messages state.
        span: The part to read, two increasing times [s]; by default all.

    Returns:
        The recording; its notes say what was chosen, left out or assumed.

    Raises:
        DataError: Naming the bag, and topic or event, for anything that cannot be used (`validate.clean`).
        ValueError: For another mosaic, and for a span that does not rise.
    """
    check_mosaic(mosaic)
    source, bag = find(path, size=size), open_bag(path)
    camera = source.camera
    events, stats, told = clean(source.stream, (camera.width, camera.height), unit=unit, span=span)
    zero_ns = round(seconds(stats) * 1e9) if isinstance(stats.zero, float) else int(stats.zero)
    zero_ns *= 1000 if stats.unit == "us" else 1
    t, T, truth = _poses(bag, _frame(bag, _chosen(bag)), zero_ns)
    return EventRecording(
        name=bag.path.stem,
        camera=camera,
        mosaic=mosaic,
        events=events,
        t=t,
        T_world_cam=T,
        notes=(*source.notes, *told, *truth),
    )


def find(path: Path | str, *, size: tuple[int, int] | None = None) -> Source:
    """The events and the camera that `load` reads, before it does.

    Args:
        path: As `load` takes it.
        size: Width and height of the sensor.

    Returns:
        Where the events are, and the camera that saw them.

    Raises:
        DataError: Naming the bag for anything that cannot be used.
    """
    bag = open_bag(path)
    topic = _chosen(bag)
    first = bag.first(topic.name) if topic.kind == "EventPacket" else None
    sensor = _size(bag, topic) if first is None else (int(first.width), int(first.height))
    packets = first is not None
    where = lambda row: f"{bag.path}: {topic.name}: event {row}"
    stream = Stream(
        bag.path,
        lambda: _packets(bag, topic) if packets else _arrays(bag, topic),
        where,
        "us" if packets else "ns",
        sensor if all(sensor) else None,
        unit_is_sure=True,
    )
    others = [other.name for other in _topics(bag) if other != topic]
    notes = (f"events of {topic.name}; there are also {some(others)}",) if others else ()
    for info in (other.name for other in bag.topics.values() if other.kind == "CameraInfo"):
        message = bag.first(info)
        if (int(message.width), int(message.height)) == sensor:
            image = ImageTopic(
                topic, ImageKind("grey", "events", sensor), frame_name(message.header.frame_id)
            )
            lens = lens_of(bag, info, image)
            if len(lens.coefficients):
                raise DataError(f"{bag.path}: {info}: expected a lens of plumb_bob, got another")
            return Source(stream, lens.camera, (*notes, *lens.notes))
    beside = with_camera(stream, size)
    return beside._replace(notes=(*notes, *beside.notes))


def _topics(bag: Bag) -> list[Topic]:
    return [topic for topic in bag.topics.values() if topic.kind in _KINDS]


def _chosen(bag: Bag) -> Topic:
    topics = _topics(bag)
    if not topics:
        wanted = f"a topic of events, {' or '.join(_KINDS)}"
        raise DataError(f"{bag.path}: expected {wanted}, got {some(list(bag.topics))}")
    return max(topics, key=lambda topic: topic.count)


def _frame(bag: Bag, topic: Topic) -> str:
    """The frame of reference of the events: a string behind the stamp of their header."""
    _, raw, _ = next(bag.raw(topic.name))
    (length,) = struct.unpack_from("<I", raw, 12)
    return frame_name(bytes(raw[16 : 16 + length]).rstrip(b"\0").decode("utf-8", "replace"))


def _array(where: str, raw: Any, is_cdr: bool) -> tuple[int, int, np.ndarray]:
    """Width, height and events of a message; ValueError for what is none.

    dvs_msgs/EventArray and prophesee_event_msgs/EventArray: header, height, width, events of x y ts polarity.
    """
    start = 4 if is_cdr else 0  # alignment counts from behind CDR's own header
    (length,) = struct.unpack_from("<I", raw, 12)
    at = 16 + length
    if is_cdr:
        at = start + -(-(at - start) // 4) * 4
    height, width, count = struct.unpack_from("<3I", raw, at)
    data, kind = memoryview(raw)[at + 12 :], _ROS1
    if len(data) < 13 * count:
        raise DataError(f"{where}: expected {count} events, got {len(data)} bytes")
    if not is_cdr or not count:
        return width, height, np.frombuffer(data, kind, count)
    others = bytes(data[14:]) + bytes(16)  # the last one ends where its polarity does
    first, rest = np.frombuffer(data, _FIRST, 1), np.frombuffer(others, _OTHERS, count - 1)
    return width, height, np.concatenate([first.astype(_ROS1), rest.astype(_ROS1)])


def _size(bag: Bag, topic: Topic) -> tuple[int, int]:
    _, raw, is_cdr = next(bag.raw(topic.name))
    return _array(f"{bag.path}: {topic.name}: message 0", raw, is_cdr)[:2]


def _arrays(bag: Bag, topic: Topic) -> Iterator[Block]:
    held, count = [], 0
    for number, (_, raw, is_cdr) in enumerate(bag.raw(topic.name)):
        held.append(_array(f"{bag.path}: {topic.name}: message {number}", raw, is_cdr)[2])
        count += len(held[-1])
        if count >= BLOCK:
            yield _block(np.concatenate(held))
            held, count = [], 0
    if count:
        yield _block(np.concatenate(held))


def _block(events: np.ndarray) -> Block:
    t = events["s"].astype(np.int64) * 10**9 + events["ns"].astype(np.int64)
    return Block(t, events["x"].copy(), events["y"].copy(), events["polarity"].astype(np.int8))


def _packets(bag: Bag, topic: Topic) -> Iterator[Block]:
    """event_camera_msgs/EventPacket: the bytes that a camera of Prophesee sends."""
    decoder: Any = None
    for number, (_, _, message) in enumerate(bag.messages(topic.name)):
        encoding = str(message.encoding)
        if encoding not in _PACKETS:
            where = f"{bag.path}: {topic.name}: message {number}"
            raise DataError(f"{where}: expected events in {', '.join(_PACKETS)}, got {encoding}")
        decoder = decoder or _PACKETS[encoding]()
        data = np.asarray(message.events, np.uint8)
        words = data[: len(data) // decoder.kind.itemsize * decoder.kind.itemsize].view(decoder.kind)
        yield decoder.decode(words)


def _poses(
    bag: Bag, frame: str, zero_ns: int
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 4 4"], tuple[str, ...]]:
    """The camera's poses by the first topic that leads to it, and a note."""
    logs: dict[str, Log] = {}
    topics = [topic.name for topic in bag.topics.values() if topic.kind in POSES]
    for name, recorded_ns, message in bag.messages(*topics):
        logs[name] = read_into(logs.get(name), stamp_ns(message.header) or recorded_ns, message)
    found, notes = leading_poses(logs, read_tree(bag), frame, fewest=1)
    if found is not None:
        return since(found.ns, zero_ns), found.T_world_child @ found.T_child_cam, tuple(notes)
    notes.append("no poses that lead to the camera: there is no ground truth to compare with")
    return np.zeros(0), np.zeros((0, 4, 4)), tuple(notes)
