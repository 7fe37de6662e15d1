"""What the scene of a run shows at a time: the map of a SLAM run, the radiance field of a NeRF."""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose import nerf, scenes
from jaxpose.camera import Camera, scale
from jaxpose.commands.view_scene import Picture, Poses, Render
from jaxpose.experiments import slam_map
from jaxpose.experiments.noisy_nerf import load_run


def of_map(file: Path, camera: Camera, poses: Poses) -> Render:
    """The map of a SLAM run from where `poses` is at a time, light grey where it has no surface."""
    saved = slam_map.read_map(file)
    look = slam_map.viewer(scenes.grid(saved.grid), saved.grid, camera)
    params = (jnp.asarray(saved.values),)

    def render(t: float, width: int) -> Picture:
        return _picture(look(params, poses(np.array([t]))[0], slam_map.every(camera, width))[0])

    return render


def of_radiance(folder: Path, first: float) -> Render:
    """The radiance field of a `noisy_nerf` run from where its pose field is `t` after `first` [s]."""
    problem, setup, state = load_run(folder)
    camera = problem.train.camera
    pose = jax.jit(partial(setup.field.pose, state.pose))

    @cache
    def image(width: int) -> Callable:
        small = scale(camera, min(1.0, width / camera.width))
        return nerf.viewer(setup.scene, small, setup.depths, setup.train).image

    def render(t: float, width: int) -> Picture:
        return _picture(image(width)(state.scene, pose(jnp.float32(first + t)))[0])

    return render


def _picture(rgb: Float[np.ndarray | jax.Array, "h w 3"]) -> Picture:
    return np.round(255 * np.clip(np.asarray(rgb), 0, 1)).astype(np.uint8)
