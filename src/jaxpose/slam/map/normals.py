"""What every pixel of an RGB-D image says of the surface there: the plane that touches it, and its colour."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxpose.geometry.camera import Camera, pixel_grid, pixel_slopes, unproject
from jaxpose.slam.observation import Image, Located, depth_sigma

_RADIUS = 4  # [px] of the window that slopes are measured in
_SAME_SURFACE = 3.0  # sigmas of depth that the middle between two pixels may be off the pixel there
GRAZING = 0.1  # cosine of incidence below which a plane says nothing


class SurfaceObservation(NamedTuple):
    """What pixels say: the plane n . x + d = 0 [m] in camera axes, its worth (0: no depth), its colour.

    Worth is the inverse variance of the depth against that at a metre, times the cosine of incidence.
    """

    normal: Float[Array, "*n 3"]
    offset: Float[Array, "*n"]
    weight: Float[Array, "*n"]
    rgb: Float[Array, "*n 3"]  # as bright as the map's

    def distance(self, point_cam: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """Signed distance [m] of points in camera axes to the planes, positive in front of them."""
        return jnp.sum(self.normal * point_cam, axis=-1) + self.offset

    def incidence_cosine(self, point_cam: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """How far [m] the points are from the camera along the planes' normals."""
        return -jnp.sum(self.normal * point_cam, axis=-1)


def seen_by(image: Image, camera: Camera) -> Callable[[Located], SurfaceObservation]:
    """What an image says at located points, ready to be asked: one row is read for each."""
    planes = tangent_planes(image.depth, camera)
    cosine = _cosine(planes[..., :3], _directions(camera))
    near = (depth_sigma(jnp.ones(())) / depth_sigma(image.depth)) ** 2
    weight = jnp.where(image.depth > 0, near * jnp.maximum(cosine, GRAZING), 0)
    rgb = image.rgb.astype(planes.dtype) / 255 * image.exposure[None, None]
    rows = jnp.concatenate([planes, weight[..., None], rgb], axis=-1)

    def at(located: Located) -> SurfaceObservation:
        row = rows[located.row, located.column]
        return SurfaceObservation(
            row[..., :3], row[..., 3], jnp.where(located.inside, row[..., 4], 0), row[..., 5:]
        )

    return at


def tangent_planes(depth: Float[Array, "h w"], camera: Camera) -> Float[Array, "h w 4"]:
    """Planes n . x + d = 0 in camera axes [m] through the measured points, as (n, d), n towards the camera.

    A plane's inverse depth is linear in x and y at z = 1. Its slopes are least-squares ones over pairs of
    pixels opposite each other; a pair counts where the middle between the two is the depth of the pixel
    there, so that no slope is taken across an edge. Where there is no such pair, or the surface is seen at a
    grazing angle, the plane is the one across the optical axis, n = (0, 0, -1).
    """
    direction = _directions(camera)
    seen = depth > 0
    inverse = jnp.where(seen, 1 / jnp.where(seen, depth, 1), 0)
    near = _SAME_SURFACE * depth_sigma(depth) * inverse**2
    by_x, known_x = _slope(inverse, near, axis=1)
    by_y, known_y = _slope(inverse, near, axis=0)
    slopes = pixel_slopes(camera, direction)
    x, y = (by_x * slopes[..., 0, k] + by_y * slopes[..., 1, k] for k in range(2))
    along = -jnp.stack([x, y, inverse - x * direction[..., 0] - y * direction[..., 1]], axis=-1)
    normal = along / jnp.maximum(jnp.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    point = depth[..., None] * direction
    plane = (known_x & known_y & seen & (_cosine(normal, direction) > GRAZING))[..., None]
    normal = jnp.where(plane, normal, jnp.array([0.0, 0.0, -1.0], depth.dtype))
    return jnp.concatenate([normal, -jnp.sum(normal * point, axis=-1, keepdims=True)], axis=-1)


def _directions(camera: Camera) -> Float[Array, "h w 3"]:
    """The rays of all pixels in camera axes (z = 1)."""
    return unproject(camera, jnp.asarray(pixel_grid(camera), jnp.float32))


def _cosine(normal: Float[Array, "h w 3"], direction: Float[Array, "h w 3"]) -> Float[Array, "h w"]:
    """Of the angle of incidence."""
    return -jnp.sum(normal * direction, axis=-1) / jnp.linalg.norm(direction, axis=-1)


def _slope(inverse: Float[Array, "h w"], near: Float[Array, "h w"], axis: int):
    """Change of inverse depth from pixel to pixel along an axis, and whether it is known."""
    change, weight = jnp.zeros_like(inverse), jnp.zeros_like(inverse)
    for k in range(1, _RADIUS + 1):
        after, before = _shifted(inverse, k, axis), _shifted(inverse, -k, axis)
        same = (after > 0) & (before > 0) & (jnp.abs((after + before) / 2 - inverse) < near)
        change = change + jnp.where(same, k * (after - before), 0)
        weight = weight + jnp.where(same, 2.0 * k**2, 0)
    over = range(-_RADIUS, _RADIUS + 1)
    change = sum(_shifted(change, k, 1 - axis) for k in over)
    weight = sum(_shifted(weight, k, 1 - axis) for k in over)
    return change / jnp.maximum(weight, 1), weight > 0


def _shifted(image: Float[Array, "h w"], k: int, axis: int) -> Float[Array, "h w"]:
    """The image k pixels on, zero outside."""
    width = [(0, 0), (0, 0)]
    width[axis] = (max(-k, 0), max(k, 0))
    start = max(k, 0)
    return jax.lax.slice_in_dim(jnp.pad(image, width), start, start + image.shape[axis], axis=axis)
