"""Poses written back as `transforms.json`, for Blender's readers, nerfstudio and instant-ngp."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.lens import ORDER, Lens, from_camera
from jaxpose.datasets.photos.common import OPENGL
from jaxpose.datasets.types import Photographs
from jaxpose.errors import DataError
from jaxpose.files.atomic import write_json
from jaxpose.files.untrusted import read_json


def write_transforms(
    path: Path | str,
    photographs: Photographs,
    *,
    source: Path | str | None = None,
    points: str | None = None,
    depths: Sequence[str] = (),
    depth_per_metre: float = 1000.0,
) -> None:
    """Write the poses of photographs, camera-to-world in OpenGL axes, with file names as their source has.

    Args:
        path: The json file, written whole or not at all.
        photographs: Their poses are finite.
        source: The json file they were read from (`blender.transforms_file`): all it says is kept, but for
            the poses and for frames that are not among the photographs, so the result can stand in its place.
            Without it the cameras of the files (`lenses`, else `camera`) are written anew, one for all or one
            for each, and the times of the images.
        points: A PLY file of the scene's points, relative to the json file.
        depths: A depth image of 16 bits for each photograph, relative to it too; none with `source`.
        depth_per_metre: Their counts.

    Raises:
        DataError: For poses with NaN or infinity, and for photographs that `source` does not list.
    """
    finite = np.isfinite(photographs.T_world_cam).all((1, 2))
    if not finite.all():
        name = photographs.files[finite.argmin()]
        raise DataError(f"{path}: expected finite poses, got NaN or infinity for {name}")
    poses = (np.asarray(photographs.T_world_cam, np.float64) @ OPENGL).tolist()
    if source is None:
        content, each = _header(photographs), _cameras(path, photographs)
        if all(keys == each[0] for keys in each):
            content, each = each[0] | content, [{}] * len(each)
        if depths:
            content["depth_unit_scale_factor"] = 1 / depth_per_metre
            each = [keys | {"depth_file_path": name} for keys, name in zip(each, depths, strict=True)]
        times = np.asarray(photographs.t, np.float64).tolist()
        frames = [
            {"file_path": name, "time": t, **keys}
            for name, t, keys in zip(photographs.files, times, each, strict=True)
        ]
    else:
        content = read_json(source, "JSON")
        by_name = {frame["file_path"]: frame for frame in content["frames"]}
        for name in photographs.files:
            if name not in by_name:
                raise DataError(f"{source}: expected a frame of {name}, got none")
        frames = [by_name[name] for name in photographs.files]
    if points is not None:
        content["ply_file_path"] = points
    content["frames"] = [
        {**frame, "transform_matrix": pose} for frame, pose in zip(frames, poses, strict=True)
    ]
    write_json(path, content)


def _cameras(path: Path | str, photographs: Photographs) -> list[dict[str, Any]]:
    """The keys of each image's camera."""
    lenses = photographs.lenses or (from_camera(photographs.camera),) * len(photographs.files)
    each = []
    for name, seen in zip(photographs.files, lenses, strict=True):
        keys = stated(seen)
        if keys is None:
            raise DataError(f"{path}: expected lenses that transforms.json has, got {seen.kind} of {name}")
        each.append(keys)
    return each


def _header(photographs: Photographs) -> dict[str, Any]:
    """The depth range where it is one of depths."""
    if photographs.spacing == "depth":
        return {"near": photographs.near, "far": photographs.far}
    return {}


def stated(seen: Lens) -> dict[str, Any] | None:
    """The keys of a camera; None for a lens that has none in these files."""
    fisheye, rational = seen.kind == "fisheye", seen.kind == "opencv" and any(seen.coefficients[5:])
    if seen.kind not in ("opencv", "radial4", "fisheye") or rational:
        return None
    centre = (seen.cx + 0.5, seen.cy + 0.5)  # counted from the outer corner of the first pixel
    keys: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": seen.width,
        "h": seen.height,
        "fl_x": seen.fx,
        "fl_y": seen.fy,
        "cx": centre[0],
        "cy": centre[1],
    }
    if seen.coefficients:
        names = ORDER[seen.kind][:5] if seen.kind == "opencv" else ORDER[seen.kind]
        return keys | dict(zip(names, seen.coefficients, strict=False))
    if not fisheye and centre == (seen.width / 2, seen.height / 2):  # as Blender's readers want it
        keys["camera_angle_x"] = 2 * math.atan(0.5 * seen.width / seen.fx)
        keys["camera_angle_y"] = 2 * math.atan(0.5 * seen.height / seen.fy)
    return keys
