"""Record3D's `.r3d` of a phone: a zip of `metadata` (JSON) and of `rgbd/N.jpg`, `N.depth` and `N.conf`."""

import io
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.datasets.images import Pinhole, check_intrinsics, found, some
from jaxpose.datasets.photos.common import OPENGL
from jaxpose.datasets.rgbd.frames import Images, Poses, assembled, visible
from jaxpose.datasets.rgbd.phones import UNSURE, Y_UP, middle, sure
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.schema import numbers
from jaxpose.files.timestamps import nanoseconds
from jaxpose.files.untrusted import json_object, read_json, reading
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, resized

EXTRA = 'pip install -e ".[phone]"'
_METADATA = re.compile(r"(.*/)?metadata")
_ENTRY = re.compile(r"rgbd/(\d{1,18})\.(jpg|depth|conf)")
_MOST_BYTES = 1 << 28  # of an entry


class _Source(NamedTuple):
    """An archive, or the folder of an unpacked one."""

    path: Path
    names: list[str]
    read: Callable[[str], bytes]
    content: dict[str, Any]  # of `metadata`


def detect(path: Path) -> bool:
    """Whether a path is an archive of Record3D, or an unpacked one.

    Args:
        path: A file or folder.

    Returns:
        Whether `load` should read it.
    """
    if path.is_dir():
        return (path / "metadata").is_file() and (path / "rgbd").is_dir()
    if path.suffix.lower() == ".zip" and zipfile.is_zipfile(path):
        with reading(path, "a zip"), zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        return any(_METADATA.fullmatch(name) for name in names) and any("rgbd/" in name for name in names)
    return path.suffix.lower() == ".r3d" and path.is_file()


def load(path: Path | str) -> Recording:
    """Read a video of Record3D. Its depth, where compressed, needs the package lzfse (extra `phone`).

    Nothing is unpacked to disk; a zip may hold its folder. Poses are ARKit's, quaternion xyzw and position,
    of a camera with OpenGL's axes that is turned as the images are; its world's y points up. Intrinsics are
    the median of those of each frame, where there are any, else K, column by column. Depth is in metres, 0
    where the confidence is 0; colour is resized to it. Times are `frameTimestamps`, else those of `fps`.

    Args:
        path: The `.r3d`, or the folder of an unpacked one.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    source = _open(Path(path))
    entries: dict[str, set[int]] = {"jpg": set(), "depth": set(), "conf": set()}
    for name in source.names:
        if match := _ENTRY.fullmatch(name):
            entries[match[2]].add(int(match[1]))
    frames = sorted(entries["jpg"] & entries["depth"])
    if not frames:
        raise DataError(
            f"{path}: expected rgbd/N.jpg with rgbd/N.depth, got {some(source.names) or 'nothing'}"
        )
    depth_side = lambda key: int(numbers(source.path, source.content, key, whole=True, least=1))
    width, height = depth_side("dw"), depth_side("dh")
    size = _decode(source, f"rgbd/{frames[0]}.jpg").size
    images = Images(
        size,
        lambda i, to: _color(source, f"rgbd/{frames[i]}.jpg", to),
        lambda i: _depth(source, frames[i], (height, width), frames[i] in entries["conf"]),
        lambda i: f"{frames[i]}.depth",
    )
    lost = [str(frame) for frame in sorted(entries["jpg"] ^ entries["depth"])]
    notes = [f"{len(lost)} frames left out, without colour or depth: {some(lost)}"] if lost else []
    return assembled(
        source.path,
        images,
        lambda size, depth_size: _intrinsics(source, frames, size),
        t=_times(source, frames),
        names=[str(frame) for frame in frames],
        poses=_poses(source, frames),
        first_color=f"{frames[0]}.jpg",
        notes=(*notes, *([UNSURE] if entries["conf"] else [])),
        gravity_world=Y_UP,
    )


def _open(path: Path) -> _Source:
    if path.is_dir():
        names = [f"rgbd/{file.name}" for file in visible(path / "rgbd")] if (path / "rgbd").is_dir() else []
        read = lambda name: (path / name).read_bytes()
        return _Source(path, names, read, read_json(path / "metadata", "the metadata of Record3D"))
    if not path.is_file():
        raise DataError(f"{path}: expected an archive of Record3D, got {found(path)}")
    with reading(path, "an archive of Record3D (a zip)"):
        archive = zipfile.ZipFile(path)
        names = archive.namelist()
    top = next((name.removesuffix("metadata") for name in names if _METADATA.fullmatch(name)), "")

    def read(name: str) -> bytes:
        with reading(f"{path}: {name}", "an entry that can be read"):
            if archive.getinfo(top + name).file_size > _MOST_BYTES:
                raise ValueError(f"{archive.getinfo(top + name).file_size} bytes")
            return archive.read(top + name)

    names = [name.removeprefix(top) for name in names]
    return _Source(
        path, names, read, json_object(read("metadata"), f"{path}: metadata", "metadata of Record3D")
    )


def _decode(source: _Source, name: str) -> Image.Image:
    data = source.read(name)
    with reading(f"{source.path}: {name}", "an image"), Image.open(io.BytesIO(data)) as image:
        return image.convert("RGB")


def _color(source: _Source, name: str, to: tuple[int, int] | None) -> np.ndarray:
    image = _decode(source, name)
    return np.asarray(image if to is None else image.resize(to, Image.Resampling.BILINEAR))


def _depth(source: _Source, frame: int, shape: tuple[int, int], has_confidence: bool) -> np.ndarray:
    depth = _plane(source, f"rgbd/{frame}.depth", np.dtype("<f4"), shape)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    if not has_confidence:
        return depth
    name = f"rgbd/{frame}.conf"
    return sure(depth, _plane(source, name, np.dtype(np.uint8), shape), f"{source.path}: {name}")


def _plane(source: _Source, name: str, kind: np.dtype, shape: tuple[int, int]) -> np.ndarray:
    """An array of bytes, compressed by LZFSE or not."""
    data, size = source.read(name), shape[0] * shape[1] * kind.itemsize
    if len(data) != size:
        try:
            import lzfse
        except ImportError:
            raise DataError(f"{source.path}: compressed depth needs the package lzfse: {EXTRA}") from None
        with reading(f"{source.path}: {name}", "LZFSE"):
            if (there := _unpacked_size(data)) != size:  # the package allots whatever a damaged one fills
                raise ValueError(f"{there} bytes, not {size}")
            try:
                data = lzfse.decompress(data)
            except MemoryError:  # so the package calls damage
                raise ValueError("damaged blocks") from None
    if len(data) != size:
        wanted = f"{shape[1]}x{shape[0]} of {kind.name}, {size} bytes"
        raise DataError(f"{source.path}: {name}: expected {wanted}, got {len(data)}")
    return np.frombuffer(data, kind).reshape(shape)


def _unpacked_size(data: bytes) -> int:
    """How many bytes the blocks of LZFSE say that they hold, by their headers (Apple's lzfse_internal.h)."""
    at, raw = 0, 0
    while (kind := data[at : at + 4]) != b"bvx$":
        (count,) = struct.unpack_from("<I", data, at + 4)
        if kind == b"bvx-":
            length = 8 + count
        elif kind == b"bvxn":
            length = 12 + struct.unpack_from("<I", data, at + 8)[0]
        elif kind == b"bvx2":
            literals, matches, header = struct.unpack_from("<3Q", data, at + 8)
            length = (header & 0xFFFFFFFF) + (literals >> 20 & 0xFFFFF) + (matches >> 40 & 0xFFFFF)
        else:
            raise ValueError(f"a block of kind {kind!r}")
        at, raw = at + max(length, 8), raw + count
    return raw


def _intrinsics(source: _Source, frames: list[int], size: tuple[int, int]) -> tuple[Pinhole, tuple[str, ...]]:
    """Those for images of a size, scaled from the size that the metadata state."""
    path, content = source.path, source.content
    w, h = (float(numbers(path, content, key, above=0)) for key in ("w", "h"))
    if content.get("perFrameIntrinsicCoeffs"):
        each = numbers(path, content, "perFrameIntrinsicCoeffs", (None, 4))
        pinhole, notes = middle(each[[min(frame, len(each) - 1) for frame in frames]])
    else:
        K, notes = numbers(path, content, "K", (9,)).reshape(3, 3).T, ()
        pinhole = check_intrinsics(path, K, (int(w), int(h)))
    scaled = resized(Camera(*pinhole, int(w), int(h)), *size)
    return Pinhole(*scaled[:4]), notes


def _poses(source: _Source, frames: list[int]) -> Poses:
    if not source.content.get("poses"):
        return Poses(None, str)
    stated = numbers(source.path, source.content, "poses", (None, 7))
    T = np.full((len(frames), 4, 4), np.nan)
    for row, frame in enumerate(frames):
        if frame < len(stated) and abs(np.linalg.norm(stated[frame, :4]) - 1) < 1e-2:
            T[row] = rigid.make(Rotation.from_quat(stated[frame, :4]).as_matrix(), stated[frame, 4:]) @ OPENGL
    return Poses(T, lambda i: f"{source.path}: pose {frames[i]}", "none, or no quaternion")


def _times(source: _Source, frames: list[int]) -> list[int]:
    """Timestamps [ns]."""
    path, content = source.path, source.content
    if content.get("frameTimestamps"):
        stated = numbers(path, content, "frameTimestamps", (None,))
        if len(stated) <= frames[-1] or (np.diff(stated[frames]) <= 0).any():
            raise DataError(f"{path}: frameTimestamps: expected one a frame, increasing, got {len(stated)}")
        return nanoseconds(path, stated[frames])
    fps = float(numbers(path, content, "fps", above=0))
    return nanoseconds(path, np.array(frames) / fps)
