"""Which topics of a bag are what: colour, depth, their camera, the IMU and the true poses."""

from collections.abc import Sequence
from difflib import get_close_matches
from typing import NamedTuple

from jaxpose.datasets.rgbd.ros_bag import Bag, Topic
from jaxpose.datasets.rgbd.ros_frames import frame_name
from jaxpose.datasets.rgbd.ros_images import ImageKind, image_kind
from jaxpose.errors import DataError

_IMAGES = ("Image", "CompressedImage")
POSES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry")
_REGISTERED = ("aligned", "registered")


class ImageTopic(NamedTuple):
    """A topic of images."""

    topic: Topic
    kind: ImageKind
    frame: str  # of reference

    def __str__(self) -> str:
        width, height = self.kind.size
        return f"{self.topic.name} ({self.kind.encoding} {width}x{height}, {self.topic.count} images)"


class Chosen(NamedTuple):
    """The topics that a recording is made of."""

    color: ImageTopic
    depth: ImageTopic
    imus: list[Topic]
    poses: list[Topic]
    notes: tuple[str, ...]  # what was chosen, and among what


def choose(bag: Bag, wanted: Sequence[str] = ()) -> Chosen:
    """Choose topics by type and size; those that are wanted go before others of their kind.

    Colour is the largest image of three channels, else of one; depth is the one that belongs to it: in its
    frame of reference, of its size, said to be aligned or registered, with most images, in this order.

    Args:
        bag: An open bag.
        wanted: Names of topics to use.

    Returns:
        The topics.

    Raises:
        DataError: For a wanted topic that is not there, and without colour or depth.
    """
    for name in wanted:
        if name not in bag.topics:
            near = get_close_matches(name, bag.topics, 1, 0.0)
            raise DataError(
                f"{bag.path}: expected a topic {name}, got {_listing(bag)}; the nearest is {near[0]}"
            )
    images, unreadable = _images(bag)
    colors = _wanted([i for i in images if i.kind.role != "depth"], wanted)
    depths = _wanted([i for i in images if i.kind.role == "depth"], wanted)
    if not colors or not depths:
        lacking = "colour" if not colors else "depth"
        got = "; ".join(map(str, images)) or _listing(bag)
        got += f"; of encodings that are not read: {', '.join(unreadable)}" if unreadable else ""
        raise DataError(f"{bag.path}: expected topics of colour and of depth, got no {lacking} in {got}")
    area = lambda image: image.kind.size[0] * image.kind.size[1]
    color = max(colors, key=lambda i: (i.kind.role == "color", area(i), i.topic.count))
    depth = max(
        depths,
        key=lambda i: (
            i.frame == color.frame,
            i.kind.size == color.kind.size,
            any(word in i.topic.name for word in _REGISTERED),
            i.topic.count,
        ),
    )
    kinds = lambda *kinds: [topic for topic in bag.topics.values() if topic.kind in kinds]
    others = [str(image) for image in images if image not in (color, depth)]
    others += [f"{topic.name} ({topic.kind}, {topic.count})" for topic in kinds("Imu", *POSES)]
    note = f"used {color} with {depth}"
    note += f"; --topics chooses among {', '.join(others)}" if others else ""
    named = lambda topics: [topic for topic in topics if topic.name in wanted] or topics
    return Chosen(color, depth, named(kinds("Imu")), named(kinds(*POSES)), (note,))


def camera_topic(bag: Bag, image: ImageTopic) -> str | None:
    """The CameraInfo of an image topic: beside it, else the one of its frame of reference and size."""
    infos = [topic.name for topic in bag.topics.values() if topic.kind == "CameraInfo"]
    name = image.topic.name
    for _ in range(2):  # a compressed image is one level below the image that it is of
        name = name.rpartition("/")[0]
        if f"{name}/camera_info" in infos:
            return f"{name}/camera_info"
    for info in infos:
        message = bag.first(info)
        if frame_name(message.header.frame_id) == image.frame and (
            (int(message.width), int(message.height)) == image.kind.size
        ):
            return info
    return infos[0] if len(infos) == 1 else None


def _images(bag: Bag) -> tuple[list[ImageTopic], list[str]]:
    """Topics of images that can be read, and those that cannot."""
    images, unreadable = [], []
    for topic in bag.topics.values():
        if topic.kind in _IMAGES:
            message = bag.first(topic.name)
            try:
                kind = image_kind(message)
            except ValueError as error:
                raise DataError(f"{bag.path}: {topic.name}: {error}") from None
            if kind is None:
                unreadable.append(f"{topic.name} ({message.encoding})")
            else:
                images.append(ImageTopic(topic, kind, frame_name(message.header.frame_id)))
    return images, unreadable


def _wanted(images: list[ImageTopic], wanted: Sequence[str]) -> list[ImageTopic]:
    return [image for image in images if image.topic.name in wanted] or images


def _listing(bag: Bag) -> str:
    return ", ".join(f"{topic.name} ({topic.kind}, {topic.count})" for topic in bag.topics.values())
