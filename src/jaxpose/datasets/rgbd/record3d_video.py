"""Record3D's RGBD video: one mp4 whose left half is depth, as hue, and whose right half is colour."""

import functools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from jaxpose.datasets.images import check_intrinsics
from jaxpose.datasets.rgbd.frames import Images, Poses, assembled
from jaxpose.datasets.rgbd.phones import Y_UP
from jaxpose.datasets.types import Recording
from jaxpose.datasets.video import Video, find_video
from jaxpose.errors import DataError
from jaxpose.files.opening import open_file
from jaxpose.files.schema import numbers
from jaxpose.files.untrusted import json_object, read_json

_SUFFIXES = (".mp4", ".mov", ".m4v")
_KEY, _TAIL = b'{"intrinsic', 1 << 20  # the metadata in the file, near its end
_RANGE_M = (0.0, 3.0)  # of hue from 0 to 1, unless the metadata say another
_RED = 0.03  # of hue, to both sides: no depth is the end of the range, 0 and 1 are one red
_COLOURFUL = 0.5  # of saturation and value; what compression mixes at edges has less


def detect(path: Path) -> bool:
    """Whether a path is such a video, or a folder of one with its `metadata.json`.

    Args:
        path: A file or folder.

    Returns:
        Whether `load` should read it.
    """
    file = find_video(path, _SUFFIXES)
    return file is not None and _metadata(file) is not None


def load(path: Path) -> Recording:
    """Read an RGBD video. Needs the package av (extra `phone`).

    Depth is hue times the range, 0 to 3 m unless the metadata say another; what is near the red of both its
    ends is none. Intrinsics are those of the metadata, column by column. (github.com/marek-simonik,
    "record3d-simple-wifi-streaming-demo", section 2.2.)

    Args:
        path: The file, or a folder with it.

    Returns:
        The recording, without poses.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    file = find_video(path, _SUFFIXES)
    content = None if file is None else _metadata(file)
    if file is None or content is None:
        raise DataError(f"{path}: expected Record3D's RGBD video with its metadata, got none")
    video = Video(file)
    width, height = video.size[0] // 2, video.size[1]
    where = f"{file}: metadata"
    K = numbers(where, content, "intrinsicMatrix", (9,)).reshape(3, 3).T
    near, far = _RANGE_M
    if "rangeOfEncodedDepth" in content:
        near, far = numbers(where, content, "rangeOfEncodedDepth", (2,), least=0).tolist()
    if width < 1 or not near < far:
        raise DataError(f"{where}: expected two halves and a range of depth, got {near:g} to {far:g} m")
    frame = functools.lru_cache(1)(video.read)  # its halves are asked for one after the other

    def color(i: int, to: tuple[int, int] | None) -> np.ndarray:
        half = np.ascontiguousarray(frame(i)[:, width : 2 * width])
        return half if to is None else cv2.resize(half, to, interpolation=cv2.INTER_AREA)

    return assembled(
        file,
        Images((width, height), color, lambda i: _depth(frame(i)[:, :width], near, far), str),
        lambda size, depth_size: (check_intrinsics(Path(where), K, size), ()),
        t=video.ns,
        names=[str(i) for i in range(len(video))],
        poses=Poses(None, str),
        notes=(f"depth is the hue of a video: {near:g} to {far:g} m, in steps of some millimetres",),
        gravity_world=Y_UP,
    )


def _depth(pixels: np.ndarray, near: float, far: float) -> Float32[np.ndarray, "h w"]:
    """Depth [m] of hues, 0 where they say nothing."""
    hue, saturation, value = cv2.split(cv2.cvtColor(pixels.astype(np.float32) / 255, cv2.COLOR_RGB2HSV))
    hue /= 360
    known = (np.abs(hue - 0.5) < 0.5 - _RED) & (np.minimum(saturation, value) > _COLOURFUL)
    return np.where(known, near + (far - near) * hue, 0).astype(np.float32)


def _metadata(file: Path) -> dict[str, Any] | None:
    """What the file says at its end, or `metadata.json` beside it; None for another video."""
    with open_file(file) as stream:
        stream.seek(max(0, file.stat().st_size - _TAIL))
        tail = stream.read()
    if (at := tail.rfind(_KEY)) >= 0:
        text = tail[at : tail.find(b"}", at) + 1]
        return json_object(text, f"{file}: metadata", "metadata of Record3D")
    beside = file.with_name("metadata.json")
    content = read_json(beside, "metadata of Record3D") if beside.is_file() else {}
    return content if isinstance(content, dict) and "intrinsicMatrix" in content else None
