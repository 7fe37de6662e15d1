"""Pixels of an RGB-D frame as rays, where along them to sample the scene, what a sensor's depth is worth."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from jaxpose import render
from jaxpose.datasets.types import Frame
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, project, unproject
from jaxpose.render import Query, Ray, Rendered
from jaxpose.slam.config import SampleConfig

_BLANK = 3.0  # [grey levels] spread of an image that is black or saturated


class Image(NamedTuple):
    """One RGB-D image on the device; depth along the optical axis [m], 0 where there is none.

    Colours times `exposure` are as bright as the map's.
    """

    rgb: UInt8[Array, "h w 3"]
    depth: Float[Array, "h w"]
    exposure: Float[Array, "3"] | np.ndarray = np.ones(3, np.float32)


def to_device(frame: Frame) -> Image:
    """A frame where it is computed with."""
    return Image(jnp.asarray(frame.rgb), jnp.asarray(frame.depth, jnp.float32))


def is_blank(frame: Frame) -> bool:
    """Whether an image's colour says nothing: black, or saturated."""
    return bool(frame.rgb[::4, ::4].std() < _BLANK)


class Pixels(NamedTuple):
    """Pixels of an image: rays in camera axes (z = 1), measured depth [m] (0: none), colour (1: white)."""

    direction_cam: Float[Array, "n 3"]
    depth: Float[Array, " n"]
    rgb: Float[Array, "n 3"]


class Located(NamedTuple):
    """Points as an image has them: their depth [m] and nearest pixel, (0, 0) where it is not inside."""

    depth: Float[Array, "*n"]
    row: Int[Array, "*n"]
    column: Int[Array, "*n"]
    inside: Bool[Array, "*n"]


def sample_pixels(key: PRNGKeyArray, image: Image, camera: Camera, count: int, *, edge: int) -> Pixels:
    """Pixels drawn evenly, with replacement, at least `edge` pixels away from the image's border."""
    height, width = image.depth.shape
    column_key, row_key = jax.random.split(key)
    column = jax.random.randint(column_key, (count,), edge, width - edge)
    row = jax.random.randint(row_key, (count,), edge, height - edge)
    return read_pixels(image, camera, row, column)


def read_pixels(image: Image, camera: Camera, row: Int[Array, " n"], column: Int[Array, " n"]) -> Pixels:
    """The named pixels of an image."""
    pixel = jnp.stack([column, row], axis=-1).astype(jnp.float32)
    rgb = image.rgb[row, column].astype(jnp.float32) / 255
    return Pixels(unproject(camera, pixel), image.depth[row, column], rgb * image.exposure[None])


def sample_depths(depth: Float[Array, ""], far: Float[Array, ""], config: SampleConfig) -> Float[Array, " s"]:
    """Increasing depths [m] along one ray; evenly up to `far` where no depth was measured."""
    count = config.front + config.surface + config.behind
    evenly = jnp.linspace(0.0, 1.0, count, dtype=depth.dtype)
    start, end = jnp.maximum(depth - config.band, 0.02), depth + config.band
    front = 0.02 + (start - 0.02) * jnp.linspace(0, 1, config.front, endpoint=False, dtype=depth.dtype)
    surface = start + (end - start) * jnp.linspace(0, 1, config.surface, dtype=depth.dtype)
    behind = end + 3 * config.band * jnp.linspace(0, 1, config.behind + 1, dtype=depth.dtype)[1:]
    return jnp.where(depth > 0, jnp.concatenate([front, surface, behind]), 0.02 + (far - 0.02) * evenly)


def depth_sigma(depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Standard deviation [m] of a structured-light camera's depth (Nguyen et al. 2012, axial noise)."""
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


def render_pixels(
    query: Query,
    T_world_cam: Float[Array, "4 4"],
    pixels: Pixels,
    far: Float[Array, ""],
    config: SampleConfig,
) -> Rendered:
    """What the scene shows at pixels from a camera pose, sampled around the depth measured there."""
    direction = jnp.einsum("ij,nj->ni", T_world_cam[:3, :3], pixels.direction_cam, precision="highest")
    ray = Ray(jnp.broadcast_to(T_world_cam[:3, 3], direction.shape), direction)
    depths = jax.vmap(partial(sample_depths, config=config), in_axes=(0, None))(pixels.depth, far)
    weights = render.surface_weights(config.width)
    return jax.vmap(lambda r, d: render.render_ray(query, r, d, weights=weights))(ray, depths)


def locate(camera: Camera, point_cam: Float[Array, "*n 3"]) -> Located:
    """Where an image has points in camera axes [m]."""
    pixel = jnp.round(project(camera, point_cam))
    column, row = pixel[..., 0], pixel[..., 1]
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    column, row = (jnp.where(inside, x, 0).astype(jnp.int32) for x in (column, row))
    return Located(point_cam[..., 2], row, column, inside)


def back_project(pixels: Pixels, T_world_cam: Float[Array, "4 4"]) -> Float[Array, "n 3"]:
    """World points [m] of pixels with depth; those without are at the camera's centre."""
    return se3.apply(T_world_cam, pixels.direction_cam * pixels.depth[:, None])
