"""A map rendered from poses of its camera."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxpose.datasets.types import Recording
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, unproject
from jaxpose.plots.slam import View
from jaxpose.scenes import GridConfig, SceneField
from jaxpose.slam import SlamResult
from jaxpose.slam.observation import Pixels, SampleConfig, render_pixels

VIEW_WIDTH = 160  # [px] of rendered pictures, about
_VIEWS = 4
_CHUNK = 4800  # rays rendered in one call


class Rendered(NamedTuple):
    """A frame and the map, at the same pixels."""

    photograph: UInt8[np.ndarray, "height width 3"]  # the whole frame
    frame_rgb: Float[np.ndarray, "h w 3"]  # in [0, 1]
    frame_depth: Float[np.ndarray, "h w"]  # m, 0: none
    rgb: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # m, 0: nothing there


Renderer = Callable[[int], Rendered]


# From parameters, T_world_cam and pixels (u, v): colour in [0, 1] and depth [m] (0: nothing there).
Viewer = Callable[
    [Any, Float[np.ndarray, "4 4"], Int[np.ndarray, "h w 2"]],
    tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]],
]


def views(recording: Recording, result: SlamResult, render: Renderer) -> list[View]:
    """A few frames, evenly over the recording, beside the map rendered from their estimated poses."""

    def view(i: int) -> View:
        seen = render(i)
        lost = ", lost" if result.frames.lost[i] else ""
        label = f"t = {recording.t[i]:.2f} s{lost}"
        return View(label, seen.photograph, seen.rgb, seen.frame_depth, seen.depth)

    return [view(i) for i in evenly(np.arange(len(recording.t)), _VIEWS)]


def renderer(recording: Recording, result: SlamResult) -> Renderer:
    """The frame with a given index, and the map as seen from its estimated pose."""
    look = viewer(result.scene, result.grid, recording.camera)
    pixels = every(recording.camera, VIEW_WIDTH)
    column, row = np.moveaxis(pixels, -1, 0)

    def at(i: int) -> Rendered:
        frame = recording.read(i)
        rgb, depth = look(result.scene_params, result.T_world_cam[i], pixels)
        photograph = np.asarray(frame.rgb)
        return Rendered(
            photograph, photograph[row, column] / 255, np.asarray(frame.depth)[row, column], rgb, depth
        )

    return at


def viewer(scene: SceneField, grid: GridConfig, camera: Camera) -> Viewer:
    """The map of a grid as seen from any pose of the camera; compiled once, whatever the pixels.

    A first pass over evenly spaced samples finds where the ray goes behind a surface, a second one looks
    closely.
    """
    fine = SampleConfig(band=grid.truncation / 2, width=grid.truncation / 24)
    reach = float(np.linalg.norm(np.subtract(grid.upper, grid.lower)))
    evenly = int(np.clip(reach / grid.truncation * 4, 64, 256))
    depths = jnp.linspace(0.02, reach, evenly)

    @jax.jit
    def render(params, T_world_cam: Float[Array, "4 4"], pixel: Float[Array, "n 2"]):
        query, far = partial(scene.query, params), jnp.float32(reach)
        direction = unproject(camera, pixel)

        def behind(direction):
            points = se3.apply(T_world_cam, depths[:, None] * direction[None])
            distance, _ = jax.vmap(query, in_axes=(0, None))(points, direction)
            enters = (distance[:-1] > 0) & (distance[1:] <= 0)
            i = jnp.argmax(enters)
            share = distance[i] / jnp.where(enters[i], distance[i] - distance[i + 1], 1)
            return jnp.where(enters[i], depths[i] + share * (depths[i + 1] - depths[i]), 0)

        surface = jax.vmap(behind)(direction)
        seen = render_pixels(
            query, T_world_cam, Pixels(direction, surface, jnp.zeros_like(direction)), far, fine
        )
        there = (surface > 0) & (seen.opacity > 0.5)
        return jnp.where(there[:, None], seen.rgb, 0.86), jnp.where(there, seen.depth, 0)

    def look(params, T_world_cam, pixels):
        pose, count = jnp.asarray(T_world_cam, jnp.float32), pixels[..., 0].size
        padded = np.arange(-(-count // _CHUNK) * _CHUNK) % count  # whole chunks: one shape is compiled
        chunks = pixels.reshape(-1, 2)[padded].reshape(-1, _CHUNK, 2)
        parts = [jax.device_get(render(params, pose, jnp.asarray(chunk, jnp.float32))) for chunk in chunks]
        rgb, depth = (np.concatenate(x)[:count] for x in zip(*parts, strict=True))
        return rgb.reshape(*pixels.shape[:2], 3), depth.reshape(pixels.shape[:2])

    return look


def every(camera: Camera, width: int) -> Int[np.ndarray, "h w 2"]:
    """Every few pixels (u, v) of an image, to make a picture of about this width."""
    step = max(1, round(camera.width / width))
    row, column = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    return np.stack([column, row], axis=-1)


def evenly(indices: Int[np.ndarray, " n"], most: int) -> list[int]:
    """Some of the indices, the first and the last among them."""
    places = np.linspace(0, len(indices) - 1, min(most, len(indices)))
    return [int(indices[round(place)]) for place in places]
