"""Record3D's exports of a phone: `.r3d`, a zip of `metadata` (JSON) and `rgbd/N.jpg`, `N.depth`, `N.conf`;
"EXR + JPG", `metadata.json` with `rgb/N.jpg` and `depth/N.exr`; and its RGBD video (`record3d_video`).
"""

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
from jaxpose.datasets.rgbd import record3d_video
from jaxpose.datasets.rgbd.exr import read_exr
from jaxpose.datasets.rgbd.frames import Images, Poses, assembled, visible
from jaxpose.datasets.rgbd.phones import UNSURE, Y_UP, middle, sure
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.opening import open_file, read_bytes
from jaxpose.files.schema import numbers
from jaxpose.files.timestamps import nanoseconds
from jaxpose.files.untrusted import json_object, read_json, reading
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, resized

EXTRA = 'pip install -e ".[phone]"'
_METADATA = re.compile(r"(.*/)?metadata(\.json)?")
_ENTRY = re.compile(r"(?:rgbd|rgb|depth|conf)/(\d{1,18})\.(jpe?g|png|depth|exr|conf)", re.IGNORECASE)
_KINDS = {"jpg": "color", "jpeg": "color", "png": "color", "depth": "depth", "exr": "depth", "conf": "conf"}
_FOLDERS = ("rgbd", "rgb", "depth", "conf")
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
    if record3d_video.detect(path):
        return True
    if path.is_dir():
        raw = (path / "metadata").is_file() and (path / "rgbd").is_dir()
        exr = (path / "depth").glob("*.[eE][xX][rR]")
        return raw or ((path / "metadata.json").is_file() and any(exr))
    if path.suffix.lower() == ".zip" and zipfile.is_zipfile(path):
        with reading(path, "a zip"), open_file(path) as stream, zipfile.ZipFile(stream) as archive:
            names = archive.namelist()
        of_frames = any("rgbd/" in name or name.lower().endswith(".exr") for name in names)
        return of_frames and any(_METADATA.fullmatch(name) for name in names)
    return path.suffix.lower() == ".r3d" and path.is_file()


def load(path: Path | str) -> Recording:
    """Read an export of Record3D. Its depth needs a package of the extra `phone`: lzfse, OpenEXR or av.

    Nothing is unpacked to disk; a zip may hold its folder. Poses are ARKit's, quaternion xyzw and position,
    of a camera with OpenGL's axes that is turned as the images are; its world's y points up. Intrinsics are
    the median of those of each frame, where there are any, else K, column by column. Depth is in metres, 0
    where the confidence is 0; colour is resized to it. Times are `frameTimestamps`, else those of `fps`.

    Args:
        path: The `.r3d`, the folder of an unpacked one or of EXR + JPG, a zip of these, or the RGBD video.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    path = Path(path)
    if record3d_video.detect(path):
        return record3d_video.load(path)
    source = _open(path)
    entries: dict[str, dict[int, str]] = {"color": {}, "depth": {}, "conf": {}}
    for name in source.names:
        if match := _ENTRY.fullmatch(name):
            entries[_KINDS[match[2].lower()]][int(match[1])] = name
    colors, depths = entries["color"], entries["depth"]
    frames = sorted(colors.keys() & depths.keys())
    if not frames:
        raise DataError(
            f"{path}: expected rgbd/N.jpg with rgbd/N.depth, or rgb/N.jpg with depth/N.exr, "
            f"got {some(source.names) or 'nothing'}"
        )
    images = Images(
        _decode(source, colors[frames[0]]).size,
        lambda i, to: _color(source, colors[frames[i]], to),
        lambda i: _depth(source, depths[frames[i]], entries["conf"].get(frames[i])),
        lambda i: Path(depths[frames[i]]).name,
    )
    lost = [str(frame) for frame in sorted(colors.keys() ^ depths.keys())]
    notes = [f"{len(lost)} frames left out, without colour or depth: {some(lost)}"] if lost else []
    return assembled(
        source.path,
        images,
        lambda size, depth_size: _intrinsics(source, frames, size),
        t=_times(source, frames),
        names=[str(frame) for frame in frames],
        poses=_poses(source, frames),
        first_color=Path(colors[frames[0]]).name,
        notes=(*notes, *([UNSURE] if entries["conf"] else [])),
        gravity_world=Y_UP,
    )


def _open(path: Path) -> _Source:
    if path.is_dir():
        inner = [folder for name in _FOLDERS if (folder := path / name).is_dir()]
        names = [f"{folder.name}/{file.name}" for folder in inner for file in visible(folder)]
        stated = next(
            (path / f for f in ("metadata", "metadata.json") if (path / f).is_file()), path / "metadata"
        )
        read = lambda name: read_bytes(path / name)
        return _Source(path, names, read, read_json(stated, "the metadata of Record3D"))
    if not path.is_file():
        raise DataError(f"{path}: expected an archive of Record3D, got {found(path)}")
    with reading(path, "an archive of Record3D (a zip)"):
        archive = zipfile.ZipFile(path)
        names = archive.namelist()
    stated = next((name for name in names if _METADATA.fullmatch(name)), "metadata")
    top = stated[: stated.rindex("metadata")]

    def read(name: str) -> bytes:
        with reading(f"{path}: {name}", "an entry that can be read"):
            if archive.getinfo(top + name).file_size > _MOST_BYTES:
                raise ValueError(f"{archive.getinfo(top + name).file_size} bytes")
            return archive.read(top + name)

    content = json_object(read(stated.removeprefix(top)), f"{path}: metadata", "metadata of Record3D")
    return _Source(path, [name.removeprefix(top) for name in names], read, content)


def _decode(source: _Source, name: str) -> Image.Image:
    data = source.read(name)
    with reading(f"{source.path}: {name}", "an image"), Image.open(io.BytesIO(data)) as image:
        return image.convert("RGB")


def _color(source: _Source, name: str, to: tuple[int, int] | None) -> np.ndarray:
    image = _decode(source, name)
    return np.asarray(image if to is None else image.resize(to, Image.Resampling.BILINEAR))


def _depth(source: _Source, name: str, confidence: str | None) -> np.ndarray:
    if name.lower().endswith(".exr"):
        depth = read_exr(source.read(name), f"{source.path}: {name}")
    else:
        side = lambda key: int(numbers(source.path, source.content, key, whole=True, least=1))
        depth = _plane(source, name, np.dtype("<f4"), (side("dh"), side("dw")))
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    if confidence is None:
        return depth
    plane = _plane(source, confidence, np.dtype(np.uint8), depth.shape)
    return sure(depth, plane, f"{source.path}: {confidence}")


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
