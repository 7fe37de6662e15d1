"""Checks of photographs with poses: the camera, and whether the cameras look where others look."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.cli.check.findings import Checked, Fact, Finding, join, unusable
from jaxpose.cli.check.poses import check_poses
from jaxpose.cli.check.recording import check_camera
from jaxpose.datasets.lens import as_camera
from jaxpose.datasets.photos import blender, colmap, registry
from jaxpose.datasets.photos.common import OPENGL
from jaxpose.datasets.types import Photographs
from jaxpose.errors import DataError
from jaxpose.files.colmap import read_colmap
from jaxpose.geometry import rigid

_NAMES = {"llff": "LLFF (poses_bounds.npy)", "colmap": "COLMAP", "plain": "without poses"}
_WIDTH = 8  # pixels: the images are decoded to see that they can be, and not kept
_PARALLEL = 1e-2  # least share of the directions across the axes; less has no point in common
_MEET = 0.3  # distance of an axis from the common point, over the distance to it


def find_photographs(path: Path) -> registry.Format | None:
    """The layout of the photographs that a folder or json file has; None if it has none."""
    try:
        return registry.find_format(path)
    except DataError:
        return None


def check_photographs(path: Path, layout: registry.Format) -> tuple[str, Checked]:
    """The layout in words, count, camera, extent and notes of photographs; where the cameras look."""
    name = _NAMES.get(layout, "")
    if layout == "transforms":
        file = blender.transforms_file(path)
        maker = "Blender" if file.name == "transforms_train.json" else "nerfstudio, instant-ngp"
        name = f"{maker} ({file.name})"
    return f"photographs, {name}", _checked(path, layout)


def _checked(path: Path, layout: registry.Format) -> Checked:
    try:
        held = registry.load_photographs(path, layout, width=_WIDTH)
    except (DataError, OSError) as error:
        return _model_alone(path, error) if layout == "colmap" else unusable(error)
    train = held[0]
    T = np.concatenate([part.T_world_cam for part in held])
    text = f"{len(held[0].t)}, and {len(held[1].t)} held out"
    fact = Fact("photographs", text, {"count": len(T), "held_out": len(held[1].t)})
    depths = f"from {train.near:.3g} to {train.far:.3g}, equal steps in {train.spacing}"
    reach = Fact("scene depths", depths, {"near": train.near, "far": train.far})
    parts = [Checked((fact, reach)), *_cameras(train)]
    if np.isfinite(T).all():
        parts += [check_poses(None, T), _look(T)]
    return join([*parts, Checked(notes=train.notes)])


def _model_alone(path: Path, error: Exception) -> Checked:
    """A sparse model whose images cannot be used: its poses are a trajectory still."""
    try:
        model = read_colmap(colmap.find_model(path))
    except (DataError, OSError) as unread:
        return unusable(unread)
    counts = {"images": len(model.names), "cameras": len(model.cameras), "points": len(model.points)}
    fact = Fact("model", ", ".join(f"{count} {name}" for name, count in counts.items()), counts)
    finding = Finding("warning", "images", str(error), "images to train on")
    return join(
        [Checked((fact,), (finding,)), check_poses(None, model.T_world_cam), _look(model.T_world_cam)]
    )


def _cameras(photographs: Photographs) -> list[Checked]:
    """The cameras of the images as they are on disk, as far as they are pinholes with OpenCV's distortion."""
    cameras = {as_camera(lens) for lens in photographs.lenses}
    return [check_camera(camera) for camera in list(cameras)[:1] if camera is not None]


def _look(T: Float[np.ndarray, "n 4 4"]) -> Checked:
    """Where the optical axes come closest to each other, under the usual conventions.

    Photographs of one object or place, seen from around or from one side: it lies in front of the cameras.
    """
    test, expected = "viewing directions", "cameras that look at a common place"
    front, apart = _common_point(T)
    if apart > _MEET:
        # The loader turned the axes of what it took for camera-to-world: first back to the file's.
        turned_front, turned_apart = _common_point(rigid.inverse(T @ OPENGL) @ OPENGL)
        if turned_apart < _MEET and turned_apart < apart / 3:
            axes = "" if turned_front > 0.5 else ", in OpenCV axes"
            found = f"optical axes that do not meet, but do with world-to-camera poses{axes}"
            return Checked((), (Finding("warning", test, found, expected, "invert the poses"),))
        return Checked(notes=("the optical axes meet nowhere: the poses' convention is not tested",))
    if front < 0.5:
        found = f"one that lies behind {1 - front:.0%} of them: they look outward, or their axes are flipped"
        fix = "if they do not look outward, turn the camera axes (OpenCV for OpenGL: y and z change sign)"
        return Checked((), (Finding("warning", test, found, expected, fix),))
    found = f"the point where the optical axes meet lies in front of {front:.0%} of the cameras"
    return Checked((), (Finding("ok", test, found),))


def _common_point(T: Float[np.ndarray, "n 4 4"]) -> tuple[float, float]:
    """Share of the cameras that have the point nearest to all axes in front, and how far axes miss it.

    As a share of the distance to it; infinity for axes that are all but parallel.
    """
    axes, centres = T[:, :3, 2], T[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.mean(0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL:
        return 0.0, np.inf
    point = np.linalg.solve(total, np.einsum("nij,nj->i", across, centres) / len(T))
    to = point - centres
    missed = np.linalg.norm(np.einsum("nij,nj->ni", across, to), axis=1)
    apart = float(np.median(missed) / max(float(np.median(np.linalg.norm(to, axis=1))), 1e-12))
    return float((np.einsum("ni,ni->n", to, axes) > 0).mean()), apart
