"""What there is to see of a run, as plain data: paths, frames with their pictures, the surface, renders."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxpose.cli.source import FIELD, Source, images_on_disk, read_field, read_source
from jaxpose.cli.view.types import WIDTH, Picture, Poses, Render, Scene, Shot
from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import trajectories
from jaxpose.files.association import associate, nearest

if TYPE_CHECKING:
    from jaxpose.geometry.camera import Camera

_RENDERED_WIDTH = 80  # [px] of those that stand in for missing images
_PATH_STEPS = 4000  # pieces of the drawn path at most
_UPRIGHT = 0.9  # cosine: cameras that stand so upright on an axis of the world say that it points up


def read_scene(path: Path, frustums: int, on_update: OnUpdate = silent) -> Scene:
    """Read a run folder or a trajectory file, `frustums` of its frames with their pictures.

    What is not there is not shown, and a note says so. DataError or OSError for what is no trajectory, and
    for damaged files.
    """
    source = read_source(path)
    t = source.trajectory.t - source.trajectory.t[0]
    poses, notes = _poses(source)
    camera, images, more = _camera(source)
    render, rendered = _render(source, poses, camera)
    reference, moved = _reference(source)
    keyframes, surface = _keyframes(source), None
    if source.is_run:
        surface = next((path / name for name in ("mesh.ply", "points.ply") if (path / name).is_file()), None)
    steps = np.linspace(0, t[-1], min(_PATH_STEPS, 8 * len(t)))
    continuous = source.is_run and (path / FIELD).is_file()
    shots, shown = _shots(source, frustums, images, render, on_update)
    return Scene(
        name=str(source),
        camera=camera,
        t=t,
        path=(poses(steps) if continuous else source.trajectory.T)[:, :3, 3],
        reference=reference,
        shots=shots,
        keyframes=keyframes,
        surface=surface,
        up=up_direction(source.trajectory.T),
        poses=poses,
        render=render,
        notes=(*notes, *more, *rendered, *moved, *shown),
    )


def up_direction(T_world_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "3"]:
    """Where up is if cameras are held upright: the mean of their upward axes, or a world axis close to it."""
    up = -T_world_cam[:, :3, 1].mean(axis=0)
    length = np.linalg.norm(up)
    if length < 1e-3:
        return np.array([0.0, 0.0, 1.0])
    axis = np.zeros(3)
    axis[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    return axis if axis @ up > _UPRIGHT * length else up / length


def _poses(source: Source) -> tuple[Poses, tuple[str, ...]]:
    """The camera's poses at times since the first frame; those of the nearest frames where no field is."""
    t, T = source.trajectory[:2]
    if source.is_run and (source.path / FIELD).is_file():
        field = read_field(source)
        return lambda s: field(t[0] + s), ()
    note = f"no {FIELD}: between its frames the camera's motion is not known, it stands at the nearest"
    return lambda s: T[nearest(t[0] + s, t)], (note,)


def _camera(source: Source) -> tuple["Camera", tuple[Path, ...], tuple[str, ...]]:
    """The run's camera, and its images if they are on disk."""
    from jaxpose.files.camera_json import read_camera
    from jaxpose.geometry.camera import Camera

    file = source.path / "camera.json"
    if not (source.is_run and file.is_file()):
        made_up = Camera(140.0, 140.0, 79.5, 59.5, 160, 120)
        return made_up, (), ("no camera.json: the frustums' angle of view is made up, their images unknown",)
    camera, names, folder, *_ = read_camera(file)
    if names and len(names) != len(source.trajectory.t):
        raise DataError(f"{file}: expected {len(source.trajectory.t)} images, one a frame, got {len(names)}")
    images = tuple(images_on_disk(folder, names))
    if names and not images:
        return camera, (), (f"not all images are in {folder}: none is shown",)
    return camera, images, ()


def _reference(source: Source) -> tuple[Float[np.ndarray, "k 3"] | None, tuple[str, ...]]:
    """The centres of the true poses.

    Moved onto the estimate where the run could not start from ground truth.
    """
    file = source.path / "reference.txt"
    if not (source.is_run and file.is_file()):
        return None, ()
    estimate, ground_truth = source.trajectory, trajectories.read_tum(file)
    ground_truth = ground_truth._replace(t=trajectories.since(ground_truth, 0))
    if ground_truth.t[0] <= estimate.t[0] + 1e-6:
        return ground_truth.T[:, :3, 3], ()
    ours, theirs = associate(estimate.t, ground_truth.t, 1e-3)
    fit = trajectory_error.ate(ground_truth.T[theirs], estimate.T[ours], "se3").alignment
    note = (
        "the ground truth begins later than the run, in a world of its own: moved onto the estimate by SE(3)"
    )
    return trajectory_error.align(fit, ground_truth.T)[:, :3, 3], (note,)


def _keyframes(source: Source) -> Float[np.ndarray, "j 3"]:
    from jaxpose.experiments.slam.map_file import read_map

    file = source.path / "map.npz"
    if not (source.is_run and file.is_file()):
        return np.zeros((0, 3))
    rows = read_map(file).keyframes
    if len(rows) and not 0 <= rows.min() <= rows.max() < len(source.trajectory.t):
        raise DataError(f"{file}: expected keyframes below {len(source.trajectory.t)}, got {rows.max()}")
    return source.trajectory.T[rows, :3, 3]


def _render(source: Source, poses: Poses, camera: "Camera") -> tuple[Render | None, tuple[str, ...]]:
    """What the run's scene shows at a time, compiled when first asked for; notes where it keeps none."""
    from jaxpose.cli.view import rendering

    folder = source.path
    if not source.is_run:
        return None, ()
    if (folder / "map.npz").is_file():
        return rendering.of_map(folder / "map.npz", camera, poses), ()
    if (folder / "settings.json").is_file() and (folder / "checkpoint.npz").is_file():
        try:
            return rendering.of_radiance(folder, source.trajectory.t[0]), ()
        except (DataError, OSError, KeyError, TypeError, ValueError) as error:
            return None, (f"no renders: {' '.join(str(error).split())}",)
    return None, ("no renders: the run keeps neither map.npz nor checkpoint.npz",)


def _shots(
    source: Source, most: int, images: tuple[Path, ...], render: Render | None, on_update: OnUpdate
) -> tuple[tuple[Shot, ...], tuple[str, ...]]:
    """Some of the frames, evenly, the first and the last among them."""
    t, T = source.trajectory[:2]
    rows = np.unique(np.linspace(0, len(t) - 1, min(most, len(t))).round().astype(int)) if most else []
    shots = []
    for number, row in enumerate(rows):
        on_update(Update("images of the frustums", number, len(rows), "frames", quiet=bool(images)))
        s = float(t[row] - t[0])
        picture = _small(images[row]) if images else None if render is None else render(s, _RENDERED_WIDTH)
        shots.append(Shot(s, T[row], picture))
    rendered = not images and render is not None and most
    return tuple(shots), ("the images are on no disk: frustums show renders",) if rendered else ()


def _small(file: Path) -> Picture:
    """An image at the width of a picture."""
    from jaxpose.datasets.images import open_image

    def use(image):
        height = max(1, round(image.height * WIDTH / image.width))
        return np.asarray(image.convert("RGB").resize((WIDTH, height)))

    return open_image(file, use)
