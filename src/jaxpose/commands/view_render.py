"""What the scene of a run shows at a time: the map of a SLAM run, the radiance field of a NeRF."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxpose import nerf, scenes
from jaxpose.camera import Camera, scale
from jaxpose.experiments import slam_map
from jaxpose.experiments.noisy_nerf import load_run

Render = Callable[[float], UInt8[np.ndarray, "h w 3"]]


def of_map(
    file: Path, camera: Camera, poses: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 4 4"]]
) -> Render:
    """The map of a SLAM run from where `poses` is at a time, light grey where it has no surface."""
    saved = slam_map.read_map(file)
    viewer = slam_map.viewer(scenes.grid(saved.grid), saved.grid, camera)
    params = (jnp.asarray(saved.values),)
    return lambda t: _picture(viewer.look(params, poses(np.array([t]))[0])[0])


def of_radiance(folder: Path, first: float, width: int) -> Render:
    """The radiance field of a `noisy_nerf` run from where its pose field is `t` after `first` [s]."""
    problem, setup, state = load_run(folder)
    camera = scale(problem.train.camera, min(1.0, width / problem.train.camera.width))
    viewer = nerf.viewer(setup.scene, camera, setup.depths, setup.train)
    pose = jax.jit(partial(setup.field.pose, state.pose))
    return lambda t: _picture(viewer.image(state.scene, pose(jnp.float32(first + t)))[0])


def _picture(rgb) -> UInt8[np.ndarray, "h w 3"]:
    return np.round(255 * np.clip(np.asarray(rgb), 0, 1)).astype(np.uint8)
