"""What the scene of a run shows at a time: the map of a SLAM run, the radiance field of a NeRF."""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose.cli.view.types import Picture, Poses, Render
from jaxpose.errors import DataError
from jaxpose.experiments.event_nerf import pipeline as event_nerf
from jaxpose.experiments.noisy_nerf import pipeline as noisy_nerf
from jaxpose.experiments.slam.map_file import read_map
from jaxpose.files.untrusted import read_json
from jaxpose.geometry.camera import Camera, scale
from jaxpose.scenes.voxel_blocks import bounds, voxel_blocks
from jaxpose.slam.map.raycast import every, viewer
from jaxpose.slam.map.texture import textured
from jaxpose.training import photometric
from jaxpose.training.photometric import TrainConfig


def of_map(file: Path, camera: Camera, poses: Poses) -> Render:
    """The map of a SLAM run from where `poses` is at a time, light grey where it has no surface."""
    saved = read_map(file)
    look = viewer(textured(voxel_blocks(saved.config), saved.config), saved.config.truncation, camera)
    params, box = (saved.blocks, jax.tree.map(jnp.asarray, saved.texture)), bounds(saved.config, saved.blocks)

    def render(t: float, width: int) -> Picture:
        return _picture(look(params, box, poses(np.array([t]))[0], every(camera, width))[0])

    return render


def of_radiance(folder: Path, first: float) -> Render:
    """The radiance field of a NeRF run from where its pose field is `t` after `first` [s]."""
    experiment = read_json(folder / "results.json", "the results of a run").get("experiment")
    if experiment == "event_nerf":
        loaded = event_nerf.load_run(folder)
        problem = loaded.problem
        camera, depths, background = problem.recording.camera, problem.depths, problem.background
        sampler = None
    elif experiment == "noisy_nerf":
        loaded = noisy_nerf.load_run(folder)
        camera, depths, background = loaded.problem.train.camera, loaded.model.depths, None
        sampler = loaded.model.sampler
    else:
        raise DataError(f"{folder}: expected a run of noisy_nerf or event_nerf, got {experiment}")
    model, state = loaded.model, loaded.state
    config = TrainConfig(steps=1, rays=1, samples=model.train.samples, chunk=64)
    pose = jax.jit(partial(model.field.pose, state.pose))

    @cache
    def image(width: int) -> Callable:
        small = scale(camera, min(1.0, width / camera.width))
        look = photometric.viewer(model.scene, small, depths, config, sampler=sampler, background=background)
        return look.image

    def render(t: float, width: int) -> Picture:
        return _picture(image(width)(state.scene, pose(jnp.float32(first + t)))[0])

    return render


def _picture(rgb: Float[np.ndarray | jax.Array, "h w 3"]) -> Picture:
    return np.round(255 * np.clip(np.asarray(rgb), 0, 1)).astype(np.uint8)
