"""Poses written back as `transforms.json`, for Blender's readers, nerfstudio and instant-ngp."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.photos.common import OPENGL
from jaxpose.datasets.types import Photographs
from jaxpose.errors import DataError
from jaxpose.files.atomic import write_json
from jaxpose.geometry.camera import Camera


def write_transforms(path: Path | str, photographs: Photographs, *, source: Path | str | None = None) -> None:
    """Write the poses of photographs, camera-to-world in OpenGL axes, with file names as their source has.

    Args:
        path: The json file, written whole or not at all.
        photographs: Their poses are finite.
        source: The json file they were read from (`blender.transforms_file`): all it says is kept, but for
            the poses and for frames that are not among the photographs, so the result can stand in its place.
            Without it the camera is written anew: as opening angles, true at any size of the images, if it
            has no distortion and looks through their centre, else as nerfstudio writes it.

    Raises:
        DataError: For poses with NaN or infinity, and for photographs that `source` does not list.
    """
    finite = np.isfinite(photographs.T_world_cam).all((1, 2))
    if not finite.all():
        name = photographs.files[finite.argmin()]
        raise DataError(f"{path}: expected finite poses, got NaN or infinity for {name}")
    poses = (np.asarray(photographs.T_world_cam, np.float64) @ OPENGL).tolist()
    if source is None:
        content = _header(photographs)
        frames = [{"file_path": name} for name in photographs.files]
    else:
        content = json.loads(Path(source).read_text(encoding="utf-8-sig"))
        by_name = {frame["file_path"]: frame for frame in content["frames"]}
        for name in photographs.files:
            if name not in by_name:
                raise DataError(f"{source}: expected a frame of {name}, got none")
        frames = [by_name[name] for name in photographs.files]
    content["frames"] = [
        {**frame, "transform_matrix": pose} for frame, pose in zip(frames, poses, strict=True)
    ]
    write_json(path, content)


def _header(photographs: Photographs) -> dict[str, Any]:
    """The camera, and the depth range where it is one of depths."""
    header = _camera(photographs.camera)
    if photographs.spacing == "depth":
        header |= {"near": photographs.near, "far": photographs.far}
    return header


def _camera(camera: Camera) -> dict[str, Any]:
    centre = (camera.cx + 0.5, camera.cy + 0.5)  # counted from the outer corner of the first pixel
    if not camera.distortion and centre == (camera.width / 2, camera.height / 2):
        return {
            "camera_angle_x": 2 * math.atan(0.5 * camera.width / camera.fx),
            "camera_angle_y": 2 * math.atan(0.5 * camera.height / camera.fy),
        }
    return {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": centre[0],
        "cy": centre[1],
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False)),
    }
