"""A run as a moving picture: what its scene shows along the trajectory, beside the path from above."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from jaxpose.cli.view.types import Scene
from jaxpose.errors import DataError
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files.atomic import atomic

_WIDTH = 240  # [px] of a render
_FRAMES_PER_S, _MOST = 6, 100
_MARGIN = 0.12  # of the panel, around the path
_ESTIMATE, _GROUND_TRUTH, _PAPER = (31, 95, 168), (150, 150, 150), (255, 255, 255)


def animate(scene: Scene, file: Path, on_update: OnUpdate = silent) -> None:
    """Write the scene as a GIF that plays the camera's motion, as fast as it was.

    Args:
        scene: what there is to see.
        file: to write.
        on_update: called with how far it is.

    Raises:
        DataError: for a run without a map or a radiance field to look at.
    """
    if scene.render is None:
        raise DataError(f"{scene.name}: --save {file.name} expected a run with a map or a radiance field")
    last = float(scene.t[-1])
    count = int(np.clip(round(_FRAMES_PER_S * last), 2, _MOST))
    times, pictures = np.linspace(0, last, count), []
    poses = scene.poses(times)
    for k, t in enumerate(times):
        on_update(Update("rendering", k, count, "frames"))
        render = Image.fromarray(scene.render(float(t), _WIDTH))
        picture = Image.new("RGB", (render.width + render.height, render.height), _PAPER)
        picture.paste(render, (0, 0))
        picture.paste(_from_above(scene, poses[k], poses[: k + 1, :3, 3], render.height), (render.width, 0))
        pictures.append(picture.quantize(128, dither=Image.Dither.NONE))
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic(file) as temporary:
        pictures[0].save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=pictures[1:],
            duration=round(1000 * last / (count - 1)),
            loop=0,
        )


def _from_above(
    scene: Scene, pose: Float[np.ndarray, "4 4"], travelled: Float[np.ndarray, "k 3"], size: int
) -> Image.Image:
    """The path seen along the vertical: ground truth, estimate so far, and the camera with what it sees."""
    up = scene.up / np.linalg.norm(scene.up)
    across = np.eye(3)[np.abs(up).argmin()]
    across = across - (across @ up) * up
    plane = np.stack([across / np.linalg.norm(across), np.cross(across / np.linalg.norm(across), up)], axis=1)
    everything = (
        np.concatenate([scene.path, scene.path if scene.reference is None else scene.reference]) @ plane
    )
    middle = (everything.max(axis=0) + everything.min(axis=0)) / 2
    scale = size * (1 - 2 * _MARGIN) / max(np.ptp(everything, axis=0).max(), 1e-9)
    place = lambda points: [tuple(p) for p in (points @ plane - middle) * scale + size / 2]
    picture = Image.new("RGB", (2 * size, 2 * size), _PAPER)  # drawn at twice the size, for smooth lines
    draw = ImageDraw.Draw(picture)
    twice = lambda points: [(2 * x, 2 * y) for x, y in place(points)]
    if scene.reference is not None and len(scene.reference) > 1:
        draw.line(twice(scene.reference), _GROUND_TRUTH, 6)
    if len(travelled) > 1:
        draw.line(twice(travelled), _ESTIMATE, 4)
    half = scene.camera.width / 2 / scene.camera.fx
    reach = 0.14 * size / scale
    sides = [pose[:3, 3] + reach * pose[:3, :3] @ np.array([x, 0, 1]) for x in (-half, half)]
    draw.polygon(twice(np.stack([pose[:3, 3], *sides])), outline=_ESTIMATE, width=4)
    return picture.resize((size, size), Image.Resampling.LANCZOS)
