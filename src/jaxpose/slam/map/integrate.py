"""Mapping in closed form: at every node of the map the weighted mean of all distances measured there.

That is what the L2 loss of the method `gradient` tends to when every frame is seen equally often (Curless and
Levoy 1996). It has no step size, forgets nothing and costs one pass over the blocks in view; the figures of
both methods are in experiments/. A distance is that to the plane which touches the surface at the pixel, so
that views from different sides agree about it.

The scene's distance is cut off close behind surfaces, as thin things have two sides. Beside it the map has a
wide-band one that reaches farther to both sides, and keeps where anything was measured: by that one a frame
is registered from farther off (`sample_map`).
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, pixel_grid, pixel_slopes, unproject_numpy
from jaxpose.scenes.types import Params
from jaxpose.scenes.voxel_blocks import (
    CELLS,
    CHANNELS,
    MEMORY,
    NODES,
    SAMPLED,
    BlockConfig,
    Blocks,
    decoded_channel,
    encoded_channel,
    sample_blocks,
    touched_blocks,
    with_blocks,
)
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.observation import Image, Located, depth_sigma, locate

_REACH = CELLS  # voxels to either side of a surface of which the wide-band distance knows
_TOGETHER = 64  # blocks: a megabyte and a half of each eight numbers a node
_WEIGHED_BY = 0, 1, 1, 1, 2  # which weight each sampled channel has
_NEAREST = 3**0.5  # voxels: nodes of the cells that hold a surface
_CUT = 0.98  # of a distance's reach: what is nearer to its end was cut off
_RADIUS = 4  # [px] of the window that slopes are measured in
_SAME_SURFACE = 3.0  # sigmas of depth that the middle between two pixels may be off the pixel there
_GAP = 3  # [px] from an empty pixel to measured ones on both sides, at most
_STIPPLED = 1.5  # times as many pixels with depth: an image that has so many more by what lies between is one
GRAZING = 0.1  # cosine of incidence below which a plane says nothing


class MapSample(NamedTuple):
    """What a map says about a point: signed distance [m] to the surface, colour there, 1 where it knows."""

    distance: Float[Array, ""]
    rgb: Float[Array, "3"]
    valid: Float[Array, ""]


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
        return self.offset - self.incidence_cosine(point_cam)

    def incidence_cosine(self, point_cam: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """How far [m] the points are from the camera along the planes' normals."""
        (a, b, c), (x, y, z) = (jnp.moveaxis(axes, -1, 0) for axes in (self.normal, point_cam))
        return -(a * x + b * y + c * z)


class _Reach(NamedTuple):
    """How far [m] behind a surface distances count: the scene's, any next to it, and the wide-band ones."""

    band: float
    nearest: float
    wide: float


MapSampler = Callable[[Float[Array, "3"]], MapSample]
MapQuery = Callable[[Params, Any, Float[Array, "3"]], MapSample]  # from scene parameters and fusion state


def make_integrate(config: BlockConfig, camera: Camera):
    """The compiled step `update(state, image, T_world_cam)` of closed-form mapping.

    The state's parameters are `Blocks`, which hold the weights too; it has no other state.
    """
    reach = _Reach(config.truncation, _NEAREST * config.voxel, _REACH * config.voxel)
    nodes = np.array(list(np.ndindex(NODES, NODES, NODES)))
    corners = CELLS * np.array(list(np.ndindex(2, 2, 2)))
    in_view = in_view_test(camera)

    @partial(jax.jit, donate_argnums=0)
    def update(state: MapState, image: Image, T_world_cam: Float[Array, "4 4"]) -> MapState:
        blocks: Blocks = state.params
        seen_at, T_cam_world = seen_by(image, camera), se3.inverse(T_world_cam)
        position = lambda coords, within: config.voxel * (CELLS * coords + within).astype(jnp.float32)
        corner = position(blocks.coords[:, None], jnp.asarray(corners)[None])
        capacity = blocks.coords.shape[0]
        row = jnp.arange(capacity)
        in_sight = in_view(se3.apply(T_cam_world, corner), jnp.max(image.depth) + reach.wide)
        in_sight &= (row > 0) & (row < blocks.count)
        # Those in sight, and then rows that there are not, which are read as the last and written nowhere.
        order = jnp.sort(jnp.where(in_sight, row, capacity))
        order = jnp.pad(order, (0, _TOGETHER), constant_values=capacity)

        def integrate_some(n, values):
            rows = jax.lax.dynamic_slice(order, (_TOGETHER * n,), (_TOGETHER,))
            points_cam = se3.apply(
                T_cam_world, position(blocks.coords[rows][:, None], jnp.asarray(nodes)[None])
            )
            before = [decoded_channel(config, k, values[rows][..., k]) for k in range(CHANNELS)]
            after = _integrated(before, points_cam, seen_at(locate(camera, points_cam)), reach)
            stored = [encoded_channel(config, k, channel) for k, channel in enumerate(after)]
            return values.at[rows].set(jnp.stack(stored, axis=-1), mode="drop")

        # Some blocks after the others, in place: what is in between stays small, whatever the map's size.
        flat = blocks.values.reshape(capacity, len(nodes), CHANNELS)
        flat = jax.lax.fori_loop(0, -(-jnp.sum(in_sight) // _TOGETHER), integrate_some, flat)
        return MapState(blocks._replace(values=flat.reshape(blocks.values.shape)), ())

    return update


def _integrated(
    before: list[Float[Array, "*n"]],
    points_cam: Float[Array, "*n 3"],
    seen: SurfaceObservation,
    reach: _Reach,
) -> list[Float[Array, "*n"]]:
    """Channels of nodes at points in camera axes with what an image says of them added."""
    distance, depth = seen.distance(points_cam), points_cam[..., 2]
    # How far behind a surface a node is goes by the optical axis, as little is known there at a grazing
    # angle; but the nodes next to it are needed on both sides.
    along = distance * depth / jnp.maximum(seen.incidence_cosine(points_cam), GRAZING * depth)
    along = jnp.where(jnp.abs(distance) < reach.nearest, distance, along)
    counts = along > -reach.band, jnp.abs(along) < reach.band, along > -reach.wide
    red, green, blue = jnp.moveaxis(seen.rgb, -1, 0)
    found = jnp.minimum(distance, reach.band), red, green, blue, jnp.minimum(distance, reach.wide)
    gain = [jnp.where(some, seen.weight, 0) for some in counts]
    total = [old + new for old, new in zip(before[SAMPLED:], gain, strict=True)]
    share = [new / jnp.where(both > 0, both, 1) for new, both in zip(gain, total, strict=True)]
    mean = [before[k] + share[_WEIGHED_BY[k]] * (found[k] - before[k]) for k in range(SAMPLED)]
    return mean + [jnp.minimum(weight, MEMORY) for weight in total]


def grown_map(
    config: BlockConfig, state: MapState, points: Float[np.ndarray, "n 3"], budget: float = np.inf
) -> MapState:
    """The map with blocks wherever measured points [m] will change it; PoolFull beyond `budget` [bytes]."""
    touched = touched_blocks(config, points, _REACH * config.voxel)
    return state._replace(params=with_blocks(config, state.params, touched, budget=budget))


def sample_map(config: BlockConfig, params: Params, fusion_state: Any, point: Float[Array, "3"]) -> MapSample:
    """A point in a map: by the scene's distance and, away from surfaces, by the wide-band one.

    Near a surface the scene's own is the truer one: the wide one mixes what is on both sides of thin things.
    Farther off, nodes of the cell that it comes from are cut off.
    """
    del fusion_state
    value = sample_blocks(config, params, point)
    distance, rgb, wide, valid = value[0], value[1:4], value[4], value[5]
    measured = (valid > 1 - 1e-3) & (jnp.abs(wide) < _CUT * _REACH * config.voxel)
    whole = jnp.abs(distance) < config.truncation - _NEAREST * config.voxel
    whole &= jnp.abs(wide) < config.truncation - config.voxel
    return MapSample(jnp.where(whole, distance, wide), rgb, measured.astype(distance.dtype))


def in_view_test(camera: Camera) -> Callable[[Float[Array, "m 8 3"], Float[Array, ""]], Bool[Array, " m"]]:
    """A test of whether a box, by its corners in camera axes, may be in view and nearer than a depth."""
    column, row = np.meshgrid(np.arange(-1, camera.width + 1), np.arange(-1, camera.height + 1))
    rays = unproject_numpy(camera, np.stack([column, row], axis=-1))
    (left, top), (right, bottom) = rays[..., :2].min(axis=(0, 1)), rays[..., :2].max(axis=(0, 1))

    def in_view(corners, farthest):
        x, y, z = jnp.moveaxis(corners, -1, 0)
        outside = [z < 0, z > farthest, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return ~jnp.any(jnp.stack([side.all(axis=-1) for side in outside]), axis=0)

    return in_view


def seen_by(image: Image, camera: Camera) -> Callable[[Located], SurfaceObservation]:
    """What an image says at located points, ready to be asked: one row is read for each."""
    depth = without_stipple(image.depth)
    planes = tangent_planes(depth, camera)
    cosine = _cosine(planes[..., :3], jnp.asarray(_rays(camera)))
    near = (depth_sigma(jnp.ones(())) / depth_sigma(depth)) ** 2
    weight = jnp.where(depth > 0, near * jnp.maximum(cosine, GRAZING), 0)
    rgb = image.rgb.astype(planes.dtype) / 255 * image.exposure[None, None]
    rows = jnp.concatenate([planes, weight[..., None], rgb], axis=-1)

    def at(located: Located) -> SurfaceObservation:
        # Read once, whatever is made of it: XLA would read each number anew where it is used.
        row = jax.lax.optimization_barrier(rows[located.row, located.column])
        return SurfaceObservation(
            row[..., :3], row[..., 3], jnp.where(located.inside, row[..., 4], 0), row[..., 5:]
        )

    return at


def without_stipple(depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Depth [m] also between pixels that measured it, where most pixels did not.

    A coarser camera's points, carried over to the pixels of colour, leave a regular pattern of empty ones,
    and nodes of a map that see one would learn nothing. Inverse depth is linear between two pixels on both
    sides that are of one surface. An image that gains less than half its depth by it stays as it is; one
    that has no room for so much is not looked at.
    """
    return jax.lax.cond(jnp.mean(depth > 0) * _STIPPLED < 1, _filled, lambda depth: depth, depth)


def _filled(depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    inverse = _inverse(depth)
    total, count = jnp.zeros_like(depth), jnp.zeros_like(depth)
    for row, column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        (after, far), (before, near) = (_first_seen(inverse, way * row, way * column) for way in (1, -1))
        least = jnp.maximum(jnp.maximum(after, before), 1e-3)
        same = (after > 0) & (before > 0)
        same &= jnp.abs(after - before) < 2 * _SAME_SURFACE * depth_sigma(1 / least) * least**2
        line = (near * after + far * before) / jnp.maximum(near + far, 1)
        total, count = total + jnp.where(same, line, 0), count + jnp.where(same, 1.0, 0)
    between = jnp.where(total > 0, count / jnp.where(total > 0, total, 1), 0)
    filled = jnp.where(depth > 0, depth, between)
    return jnp.where(jnp.mean(filled > 0) > _STIPPLED * jnp.mean(depth > 0), filled, depth)


def _inverse(depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Inverse depth, 0 where there is none."""
    return jnp.where(depth > 0, 1 / jnp.where(depth > 0, depth, 1), 0)


def _first_seen(inverse: Float[Array, "h w"], row: int, column: int):
    """The first value that is not 0 in a direction, up to _GAP steps on, and after how many; 0: none."""
    found, steps = jnp.zeros_like(inverse), jnp.zeros_like(inverse)
    for k in range(_GAP, 0, -1):
        there = _shifted(_shifted(inverse, k * row, 0), k * column, 1)
        found, steps = jnp.where(there > 0, there, found), jnp.where(there > 0, float(k), steps)
    return found, steps


def tangent_planes(depth: Float[Array, "h w"], camera: Camera) -> Float[Array, "h w 4"]:
    """Planes n . x + d = 0 in camera axes [m] through the measured points, as (n, d), n towards the camera.

    A plane's inverse depth is linear in x and y at z = 1. Its slopes are least-squares ones over pairs of
    pixels opposite each other; a pair counts where the middle between the two is the depth of the pixel
    there, so that no slope is taken across an edge. Where there is no such pair, or the surface is seen at a
    grazing angle, the plane is the one across the optical axis, n = (0, 0, -1).
    """
    rays = _rays(camera)
    direction, slopes = jnp.asarray(rays), jnp.asarray(pixel_slopes(camera, rays))
    seen, inverse = depth > 0, _inverse(depth)
    near = _SAME_SURFACE * depth_sigma(depth) * inverse**2
    by_x, known_x = _slope(inverse, near, axis=1)
    by_y, known_y = _slope(inverse, near, axis=0)
    x, y = (by_x * slopes[..., 0, k] + by_y * slopes[..., 1, k] for k in range(2))
    along = -jnp.stack([x, y, inverse - x * direction[..., 0] - y * direction[..., 1]], axis=-1)
    normal = along / jnp.maximum(jnp.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    point = depth[..., None] * direction
    plane = (known_x & known_y & seen & (_cosine(normal, direction) > GRAZING))[..., None]
    normal = jnp.where(plane, normal, jnp.array([0.0, 0.0, -1.0], depth.dtype))
    return jnp.concatenate([normal, -jnp.sum(normal * point, axis=-1, keepdims=True)], axis=-1)


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """The rays of all pixels in camera axes (z = 1); a compiler takes seconds to undo their distortion."""
    return unproject_numpy(camera, pixel_grid(camera)).astype(np.float32)


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
