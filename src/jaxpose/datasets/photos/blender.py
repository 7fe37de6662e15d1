"""Blender's `transforms_{train,test}.json`, and the `transforms.json` of nerfstudio and instant-ngp."""

import json
import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import SUFFIXES, image_size, natural_order
from jaxpose.datasets.photos.common import OPENGL, check_poses, extent_depths, frame_numbers, read_images
from jaxpose.datasets.types import Photographs, take
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

_LENS = ("k1", "k2", "p1", "p2", "k3")
_INTRINSICS = ("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h", "k4", *_LENS)
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
_BLENDER = (2.0, 6.0)  # depths of the data set's objects, as BARF samples them
_HELD_OUT = 8  # every 8th image of a file that holds all of them, the first included


class _Source(NamedTuple):
    """One file: the frames that have an image, in order of time, and what holds for all of them."""

    file: Path
    intrinsics: dict[str, Any]
    near_far: tuple[float, float] | None
    names: list[str]
    images: list[Path]
    T_world_cam: Float[np.ndarray, "n 4 4"]
    t: Float[np.ndarray, " n"]
    stamped: bool
    notes: tuple[str, ...]


def transforms_file(path: Path | str) -> Path:
    """The file of training poses.

    Args:
        path: The file itself, or a folder with `transforms_train.json` or `transforms.json`.

    Returns:
        The file.

    Raises:
        DataError: Where there is none.
    """
    path = Path(path)
    files = (path, path / "transforms_train.json", path / "transforms.json")
    for file in files:
        if file.is_file():
            return file
    raise DataError(
        f"{path}: expected transforms_train.json or transforms.json, got "
        f"{'neither' if path.is_dir() else 'nothing'}"
    )


def load(path: Path | str, *, width: int | None = None) -> tuple[Photographs, Photographs]:
    """Read photographs with poses: for training, and held out.

    Held out is what `transforms_test.json` lists beside `transforms_train.json`, else every 8th image. A
    frame is a file path, with or without suffix, and a camera-to-world pose in OpenGL axes; a frame without
    its image is skipped and counted in a note. All frames share one camera: a focal length (`fl_x`) or an
    opening angle (`camera_angle_x`), optionally centre, size and OpenCV's distortion. Timestamps are the
    frames' `time` or `timestamp` [s] if each has its own, else frame numbers. The depth range is the file's
    `near` and `far` if it states them, 2 to 6 for Blender's cameras at about 4 from the object, else a guess
    from where the cameras look, as a note says.

    Args:
        path: The folder or its json file.
        width: Images are resized by area to it [px]; by default they are not.

    Returns:
        Photographs to train on, and those held out.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a width below 1.
    """
    file = transforms_file(path)
    source = _read(file)
    full = _camera(source)
    start = float(source.t[0]) if source.stamped else 0.0
    train, transparent = _photographs(source, full, width, start)
    near, far, spacing, note = _depths(source, transparent)
    train = train._replace(near=near, far=far, spacing=spacing, notes=(*train.notes, *note))
    test_file = file.with_name("transforms_test.json")
    if file.name == "transforms_train.json" and test_file.is_file():
        _enough(file, len(train.t), least=2)
        other = _read(test_file)
        if _camera(other) != full:
            raise DataError(f"{test_file}: expected the camera of {file.name}, {full}, got {_camera(other)}")
        test, _ = _photographs(other, full, width, start if other.stamped else 0.0)
        return train, test._replace(near=near, far=far, spacing=spacing)
    _enough(file, len(train.t), least=3)
    held_out = np.arange(len(train.t)) % _HELD_OUT == 0
    train = train._replace(notes=(*train.notes, f"held out: every {_HELD_OUT}th image, the first included"))
    return take(train, np.flatnonzero(~held_out)), take(train, np.flatnonzero(held_out))


def _enough(file: Path, count: int, least: int) -> None:
    if count < least:
        raise DataError(f"{file}: expected at least {least} images, got {count}")


def _read(file: Path) -> _Source:
    """The content of one file, checked; DataError if it has no frame with an image."""
    content = _parse(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(f"{file}: expected a list of frames, got {str(frames)[:60]}")
    if not all(isinstance(frame.get("file_path"), str) for frame in frames):
        raise DataError(f"{file}: expected a file_path in every frame, got one without")
    frames.sort(key=lambda frame: natural_order(frame["file_path"]))
    found = [(frame, image) for frame in frames if (image := _find(file, frame["file_path"]))]
    if not found:
        raise DataError(f"{file}: expected images beside it, got none of the {len(frames)} it lists")
    missing = len(frames) - len(found)
    frames = [frame for frame, _ in found]
    t, stamped, note = _times(file, frames)
    order = np.argsort(t)
    frames, images = [frames[i] for i in order], [found[i][1] for i in order]
    skipped = (f"{file.name}: {missing} frames without an image skipped",) if missing else ()
    return _Source(
        file=file,
        intrinsics=_intrinsics(file, content, frames),
        near_far=_stated_depths(file, content),
        names=[frame["file_path"] for frame in frames],
        images=images,
        T_world_cam=_poses(file, frames),
        t=t[order],
        stamped=stamped,
        notes=(*skipped, *note),
    )


def _parse(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8-sig", errors="replace"))
    except json.JSONDecodeError as error:
        raise DataError(f"{file}:{error.lineno}: expected JSON, got {error.msg}") from None
    if not isinstance(content, dict):
        raise DataError(f"{file}: expected a JSON object, got {str(content)[:60]}")
    return content


def _find(file: Path, name: str) -> Path | None:
    """The image of a frame, whose suffix Blender's files leave out."""
    path = file.parent / name
    return next((p for p in (path, *(Path(f"{path}{s}") for s in SUFFIXES)) if p.is_file()), None)


def _times(file: Path, frames: list[dict[str, Any]]) -> tuple[Float[np.ndarray, " n"], bool, tuple[str, ...]]:
    """Time of each frame, whether these are timestamps, and what to tell about them."""
    for key in ("time", "timestamp"):
        if any(key in frame for frame in frames):
            timestamps = [_number(file, frame, key) if key in frame else math.nan for frame in frames]
            if len(set(timestamps)) == len(timestamps) and np.isfinite(timestamps).all():
                return np.array(timestamps), True, ()
            t, note = frame_numbers([frame["file_path"] for frame in frames])
            return t, False, (f"{file.name}: {key} is not each frame's own, so not used", note)
    t, note = frame_numbers([frame["file_path"] for frame in frames])
    return t, False, (note,)


def _poses(file: Path, frames: list[dict[str, Any]]) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world in OpenCV axes; the world's stay as they are."""
    rows = np.empty((len(frames), 3, 4))
    for number, frame in enumerate(frames):
        try:
            matrix = np.array(frame.get("transform_matrix"), np.float64)
        except (TypeError, ValueError):
            matrix = np.empty(0)
        if matrix.shape not in ((3, 4), (4, 4)):
            raise DataError(
                f"{file}: {frame['file_path']}: expected a transform_matrix of 4 rows of 4 numbers, "
                f"got {str(frame.get('transform_matrix'))[:60]}"
            )
        rows[number] = matrix[:3]
    T_world_cam = rigid.make(rows[..., :3], rows[..., 3])
    return check_poses(T_world_cam, lambda i: f"{file}: {frames[i]['file_path']}") @ OPENGL


def _intrinsics(file: Path, content: dict[str, Any], frames: list[dict[str, Any]]) -> dict[str, float]:
    """What the file says of the camera, for all frames at once or in each of them."""
    model = content.get("camera_model", _MODELS[0])
    if model not in _MODELS or content.get("is_fisheye"):
        raise DataError(f"{file}: expected a camera_model of {', '.join(_MODELS)}, got {model} or a fisheye")
    common = {key: _number(file, content, key) for key in _INTRINSICS if key in content}
    each = [
        {**common, **{key: _number(file, frame, key) for key in _INTRINSICS if key in frame}}
        for frame in frames
    ]
    for frame, intrinsics in zip(frames, each, strict=True):
        if intrinsics != each[0]:
            raise DataError(
                f"{file}: {frame['file_path']}: expected the camera of {frames[0]['file_path']}, {each[0]}, "
                f"got {intrinsics}"
            )
    if each[0].get("k4"):
        raise DataError(f"{file}: expected a lens of {' '.join(_LENS)}, got k4 {each[0]['k4']}")
    return each[0]


def _camera(source: _Source) -> Camera:
    """The camera of the images as they are on disk; DataError without a focal length."""
    file, given = source.file, source.intrinsics
    width, height = image_size(source.images[0])
    width, height = int(given.get("w", width)), int(given.get("h", height))
    if "fl_x" in given:
        fx = given["fl_x"]
    elif "camera_angle_x" in given:
        fx = _focal(width, given["camera_angle_x"])
    else:
        raise DataError(f"{file}: expected a focal length, fl_x or camera_angle_x, got neither")
    if "fl_y" in given:
        fy = given["fl_y"]
    elif "camera_angle_y" in given and "fl_x" not in given:
        fy = _focal(height, given["camera_angle_y"])
    else:
        fy = fx
    if not (0 < fx < 1e3 * width and 0 < fy < 1e3 * width):
        raise DataError(f"{file}: expected a focal length above 0 px, got {fx:g} and {fy:g}")
    lens = tuple(given.get(key, 0.0) for key in _LENS)
    return Camera(
        fx=fx,
        fy=fy,
        cx=given.get("cx", 0.5 * width) - 0.5,  # these files count from the outer corner of the first pixel
        cy=given.get("cy", 0.5 * height) - 0.5,
        width=width,
        height=height,
        distortion=lens if any(lens) else (),
    )


def _focal(size: int, angle: float) -> float:
    """The focal length [px] that sees `size` pixels within an angle [rad]; 0 for what is no such angle."""
    return 0.5 * size / math.tan(0.5 * angle) if 0 < angle < math.pi else 0.0


def _number(file: Path, entries: dict[str, Any], key: str) -> float:
    value = entries[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(f"{file}: expected a number for {key}, got {str(value)[:60]}")
    return float(value)


def _photographs(source: _Source, full: Camera, width: int | None, start: float) -> tuple[Photographs, bool]:
    """All but the depth range, which is Blender's here, and whether any image is transparent."""
    given = source.intrinsics
    stated = f"as {source.file.name} states" if "w" in given or "h" in given else "the size of the first"
    rgb, transparent, camera = read_images(source.images, full, stated=stated, width=width)
    photographs = Photographs(
        name=source.file.resolve().parent.name,
        camera=camera,
        t=source.t - start,
        rgb=rgb,
        T_world_cam=source.T_world_cam,
        near=_BLENDER[0],
        far=_BLENDER[1],
        spacing="depth",
        files=tuple(source.names),
        notes=source.notes,
    )
    return photographs, transparent


def _stated_depths(file: Path, content: dict[str, Any]) -> tuple[float, float] | None:
    if "near" not in content or "far" not in content:
        return None
    near, far = _number(file, content, "near"), _number(file, content, "far")
    if not 0 < near < far:
        raise DataError(f"{file}: expected near above 0 and far beyond it, got {near:g} and {far:g}")
    return near, far


def _depths(
    source: _Source, transparent: bool
) -> tuple[float, float, Literal["depth", "disparity"], tuple[str, ...]]:
    """Near, far and the spacing between them, and a note where they are a guess."""
    if source.near_far:
        return *source.near_far, "depth", ()
    depth = _focus_depths(source.T_world_cam)
    if depth is None:
        (near, far), spacing, why = extent_depths(source.T_world_cam), "disparity", "the cameras' extent"
    elif "fl_x" not in source.intrinsics and _BLENDER[0] < depth.min() and depth.max() < _BLENDER[1]:
        return *_BLENDER, "depth", ()
    elif transparent:
        near, far, spacing = 0.5 * float(depth.min()), 1.5 * float(depth.max()), "depth"
        why = "the distance to the point that the cameras look at, an object on nothing"
    else:
        near, far, spacing = 0.25 * float(depth.min()), 8 * float(depth.max()), "disparity"
        why = "the distance to the point that the cameras look at"
    return near, far, spacing, (f"near {near:.3g} and far {far:.3g} are guessed from {why}",)


def _focus_depths(T_world_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"] | None:
    """Depth, in each view, of the point nearest to all optical axes; None unless all look at one."""
    axes, centres = T_world_cam[:, :3, 2], T_world_cam[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.mean(0)
    if np.linalg.eigvalsh(total)[0] < 1e-3:  # all but parallel
        return None
    focus = np.linalg.solve(total, np.einsum("nij,nj->i", across, centres) / len(centres))
    depth = np.einsum("ni,ni->n", focus - centres, axes)
    return depth if (depth > 0).all() else None
