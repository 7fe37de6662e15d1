"""The cameras of a bag: CameraInfo as a `Camera`, and how colour and depth are brought to one."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxpose.datasets.rgbd.rational import pixel_rays, remapped, undistortion
from jaxpose.datasets.rgbd.registration import register_depth
from jaxpose.datasets.rgbd.ros_bag import Bag
from jaxpose.datasets.rgbd.ros_frames import Tree
from jaxpose.datasets.rgbd.ros_topics import ImageTopic, camera_topic
from jaxpose.datasets.types import Frame
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera, resized

_SAME_SHAPE = 0.02  # of width by height, for images of the same view in two sizes
_BROWN = ("plumb_bob", "radtan", "brown_conrady", "inverse_brown_conrady", "none", "")
_RATIONAL = "rational_polynomial"
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4")


class View(NamedTuple):
    """The camera of a recording, and how a colour and a depth image [m] become its frame."""

    camera: Camera
    frame: Callable[[np.ndarray, np.ndarray], Frame]
    notes: tuple[str, ...]


class TopicLens(NamedTuple):
    """The camera of a topic, and the lens that has to be undone in its images for it."""

    camera: Camera
    coefficients: np.ndarray  # for `undistortion`, of what `Camera` has no model for, else none
    notes: tuple[str, ...]
    fisheye: bool = False


def common_view(bag: Bag, tree: Tree, color: ImageTopic, depth: ImageTopic) -> View:
    """The camera that colour and depth are of, or are brought to.

    Args:
        bag: An open bag.
        tree: Its frames of reference.
        color: The topic of colour.
        depth: The topic of depth, in colour's frame of reference or in another.

    Returns:
        The camera of colour: of depth's size, where depth is smaller.

    Raises:
        DataError: Without CameraInfo, for a lens that cannot be used, and for depth that is not registered
            and cannot be.
    """
    info = camera_topic(bag, color) or (camera_topic(bag, depth) if depth.frame == color.frame else None)
    if info is None:
        raise DataError(f"{bag.path}: expected a CameraInfo of {color.topic.name}, got none")
    lens = lens_of(bag, info, color)
    (width, height), (w, h) = color.kind.size, depth.kind.size
    if depth.frame != color.frame or abs(width / height / (w / h) - 1) > _SAME_SHAPE:
        return _registered(bag, tree, color, depth, lens)
    if (w, h) == (width, height):
        if not len(lens.coefficients):
            return View(lens.camera, Frame, lens.notes)
        maps = undistortion(lens.camera, lens.coefficients, fisheye=lens.fisheye)
        return View(lens.camera, lambda rgb, z: Frame(remapped(rgb, maps), remapped(z, maps)), lens.notes)
    if len(lens.coefficients):
        raise DataError(
            f"{bag.path}: {info}: expected {_BROWN[0]} with depth of another size, got another lens"
        )
    note = f"colour resized from {width}x{height} to {w}x{h}, the size of depth"
    camera = resized(lens.camera, w, h)
    return View(camera, lambda rgb, z: Frame(_resized(rgb, camera), z), (*lens.notes, note))


def _registered(bag: Bag, tree: Tree, color: ImageTopic, depth: ImageTopic, lens: TopicLens) -> View:
    """Depth of a camera of its own, registered to colour."""
    (width, height), (w, h) = color.kind.size, depth.kind.size
    other, T_color_depth = camera_topic(bag, depth), tree.static(color.frame, depth.frame)
    if other is None or T_color_depth is None:
        got = f"{w}x{h} of {depth.frame!r} beside {width}x{height} of {color.frame!r}"
        lacking = "CameraInfo of depth" if other is None else "transform in /tf_static"
        raise DataError(
            f"{bag.path}: expected depth registered to colour, or what registers it, got {got}, no {lacking}"
        )
    of_depth = lens_of(bag, other, depth)
    undone = lambda of, lens: of(lens.camera, lens.coefficients, fisheye=lens.fisheye)
    rays = undone(pixel_rays, of_depth) if len(of_depth.coefficients) else None
    camera = lens.camera
    if width > 1.5 * w:  # else most pixels of colour would stay without depth
        camera = resized(camera, w, round(w * height / width))
    register = register_depth(of_depth.camera, camera, T_color_depth, rays=rays)
    maps = undone(undistortion, lens) if len(lens.coefficients) else None
    color_of = lambda rgb: _resized(rgb if maps is None else remapped(rgb, maps), camera)
    note = f"depth of {depth.frame} ({w}x{h}) registered to {color.frame}"
    note += f", colour resized to {camera.width}x{camera.height}" if camera.width != width else ""
    return View(camera, lambda rgb, z: Frame(color_of(rgb), register(z)), (*lens.notes, note))


def lens_of(bag: Bag, topic: str, image: ImageTopic) -> TopicLens:
    """The camera of a CameraInfo, of the size of its images."""
    info, (width, height) = bag.first(topic), image.kind.size
    K, D, P = (np.array(_either(info, name), np.float64) for name in "KDP")
    model, where = str(info.distortion_model), f"{bag.path}: {topic}"
    fisheye = model.lower() in _FISHEYE
    if "rect" in image.topic.name.rsplit("/", 2)[-1] + image.topic.name.rsplit("/", 2)[-2]:
        K, D, fisheye = P.reshape(3, 4)[:, :3], np.zeros(0), False
    K = K.reshape(3, 3)
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(D).all()):
        raise DataError(f"{where}: expected positive focal lengths, got {K[0, 0]:g} and {K[1, 1]:g}")
    if D.any() and not fisheye and model not in (*_BROWN, _RATIONAL):
        known = ", ".join((_BROWN[0], _RATIONAL, _FISHEYE[0]))
        raise DataError(f"{where}: expected a distortion_model of {known}, got {model!r}: rectify its images")
    size = (int(info.width) or width, int(info.height) or height)
    lens = tuple(float(d) for d in (*D[:5], *[0.0] * 5)[:5]) if D.any() and not fisheye else ()
    fx, fy, cx, cy = (float(x) for x in K[[0, 1, 0, 1], [0, 1, 2, 2]])
    camera = resized(Camera(fx, fy, cx, cy, size[0], size[1], lens), width, height)
    note = (
        (f"{topic} is of {size[0]}x{size[1]}, scaled to {width}x{height}",) if size != (width, height) else ()
    )
    if not D[5:].any() and not fisheye:
        return TopicLens(camera, np.zeros(0), note)
    undone = f"{topic}: the lens of {model} is undone in the images, which are a pinhole's"
    if fisheye:
        D = np.append(D, np.zeros(4))[:4]
    return TopicLens(camera._replace(distortion=()), D, (*note, undone), fisheye)


def _either(message: Any, name: str) -> Any:
    """A field whose name is upper case in ROS 1 and lower case in ROS 2."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())


def _resized(rgb: np.ndarray, camera: Camera) -> np.ndarray:
    import cv2

    size = (camera.width, camera.height)
    return (
        rgb if rgb.shape[1::-1] == size else np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    )
