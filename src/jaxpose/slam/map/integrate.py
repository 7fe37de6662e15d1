"""Mapping in closed form: at every node of the grid the weighted mean of all distances measured there.

That is what the L2 loss of the method `gradient` tends to when every frame is seen equally often (Curless and
Levoy 1996). It has no step size, forgets nothing and costs one pass over the nodes in view; the figures of
both methods are in experiments/. A distance is that to the plane which touches the surface at the pixel, so
that views from different sides agree about it.

The scene's distance is cut off close behind surfaces, as thin things have two sides. Beside it the map has a
second one that reaches farther to both sides, and keeps where anything was measured: by that one a
camera is aligned from farther off (`sample_map`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, unproject_numpy
from jaxpose.scenes import GridConfig, SceneField, node_shape
from jaxpose.scenes.types import Params
from jaxpose.scenes.voxel_grid import trilinear
from jaxpose.slam.map.normals import GRAZING, SurfaceObservation, seen_by
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.observation import Image, locate

_MEMORY = 100.0  # frames, at a depth of one metre: older ones are slowly forgotten
_REACH = 8  # voxels to either side of a surface of which the wide distance knows
_BESIDE = 3**0.5  # voxels: nodes of the cells that hold a surface
_TILE = 8  # nodes along each side of what is updated, or skipped, in one go
_CUT = 0.98  # of a distance's reach: what is nearer to its end was cut off


class MapSample(NamedTuple):
    """What a map says about a point: signed distance [m] to the surface, colour there, 1 where it knows."""

    distance: Float[Array, ""]
    rgb: Float[Array, "3"]
    valid: Float[Array, ""]


class _Reach(NamedTuple):
    """How far [m] behind a surface distances count: the scene's, any beside it, and the wide ones."""

    band: float
    beside: float
    wide: float


MapSampler = Callable[[Float[Array, "3"]], MapSample]
MapQuery = Callable[[Params, Any, Float[Array, "3"]], MapSample]  # from scene parameters and fusion state


def make_integrate(config: GridConfig, camera: Camera, band: float):
    """`init(params)` and the compiled step `update(state, image, T_world_cam)` of closed-form mapping.

    `band` [m] is how far behind a surface a distance of the scene still counts as measured. The memory
    (x, y, z, 5) holds the weights of distance, colour and wide distance, then the wide distance [m] and 1
    where it is known.
    """
    reach = _Reach(band, _BESIDE * config.voxel, _REACH * config.voxel)
    lower, shape = np.asarray(config.lower, np.float32), node_shape(config)
    tile = np.minimum(_TILE, shape)
    starts = np.moveaxis(np.mgrid[tuple(map(slice, np.zeros(3, int), shape, tile))], 0, -1).reshape(-1, 3)
    corners = starts[:, None] + tile * np.array(list(np.ndindex(2, 2, 2)))
    corners = jnp.asarray(lower + config.voxel * corners, jnp.float32)
    in_view = _cone(camera)

    @partial(jax.jit, donate_argnums=0)
    def update(state: MapState, image: Image, T_world_cam: Float[Array, "4 4"]) -> MapState:
        seen_at, T_cam_world = seen_by(image, camera), se3.inverse(T_world_cam)
        in_sight = in_view(se3.apply(T_cam_world, corners), jnp.max(image.depth) + reach.wide)
        order = jnp.asarray(starts)[jnp.argsort(~in_sight)]  # those in sight come first

        def fuse_tile(n, maps):
            # The last tile along an axis is moved back into the grid: its first nodes are another's.
            first = jnp.minimum(order[n], jnp.asarray(shape - tile))
            index = [start + jnp.arange(size) for start, size in zip(first, tile, strict=True)]
            index = jnp.stack(jnp.meshgrid(*index, indexing="ij"), axis=-1)
            own = jnp.all(index >= order[n].reshape(1, 1, 1, 3), axis=-1)
            points = jnp.asarray(lower).reshape(1, 1, 1, 3) + config.voxel * index.astype(jnp.float32)
            values, fusion_state = (jax.lax.dynamic_slice(m, (*first, 0), (*tile, m.shape[3])) for m in maps)
            points_cam = se3.apply(T_cam_world, points)
            seen = seen_at(locate(camera, points_cam))
            seen = seen._replace(weight=jnp.where(own, seen.weight, 0))
            parts = _integrated(values, fusion_state, points_cam, seen, reach)
            return tuple(
                jax.lax.dynamic_update_slice(m, part, (*first, 0))
                for m, part in zip(maps, parts, strict=True)
            )

        # One tile after the other, in place: what is in between stays small, whatever the map's size.
        maps = jax.lax.fori_loop(0, jnp.sum(in_sight), fuse_tile, (state.params[0], state.fusion_state))
        return MapState(maps[:1], maps[1])

    return lambda params: MapState(params, jnp.zeros((*params[0].shape[:3], 5))), update


def _integrated(
    values: Float[Array, "*n 4"],
    fusion_state: Float[Array, "*n 5"],
    points_cam: Float[Array, "*n 3"],
    seen: SurfaceObservation,
    reach: _Reach,
) -> tuple[Float[Array, "*n 4"], Float[Array, "*n 5"]]:
    """Nodes at points in camera axes with what an image says of them added."""
    distance, depth = seen.distance(points_cam), points_cam[..., 2]
    # How far behind a surface a node is goes by the optical axis, as little is known there at a grazing
    # angle; but the nodes next to it are needed on both sides.
    along = distance * depth / jnp.maximum(seen.incidence_cosine(points_cam), GRAZING * depth)
    along = jnp.where(jnp.abs(distance) < reach.beside, distance, along)
    gain = jnp.stack([
        jnp.where(along > -reach.band, seen.weight, 0),
        jnp.where(jnp.abs(along) < reach.band, seen.weight, 0),
        jnp.where(along > -reach.wide, seen.weight, 0),
    ], axis=-1)  # fmt: skip
    weight, wide, valid = fusion_state[..., :3], fusion_state[..., 3], fusion_state[..., 4]
    total = weight + gain
    share = gain / jnp.where(total > 0, total, 1)
    found = jnp.concatenate([jnp.minimum(distance, reach.band)[..., None], seen.rgb], axis=-1)
    values = values + share[..., jnp.array([0, 1, 1, 1])] * (found - values)
    wide = wide + share[..., 2] * (jnp.minimum(distance, reach.wide) - wide)
    valid = jnp.where(gain[..., 2] > 0, 1, valid)
    fusion_state = jnp.concatenate([jnp.minimum(total, _MEMORY), wide[..., None], valid[..., None]], axis=-1)
    return values, fusion_state


def _cone(camera: Camera) -> Callable[[Float[Array, "m 8 3"], Float[Array, ""]], Bool[Array, " m"]]:
    """A test of whether a box, by its corners in camera axes, may be in view and nearer than a depth."""
    column, row = np.meshgrid(np.arange(-1, camera.width + 1), np.arange(-1, camera.height + 1))
    rays = unproject_numpy(camera, np.stack([column, row], axis=-1))
    (left, top), (right, bottom) = rays[..., :2].min(axis=(0, 1)), rays[..., :2].max(axis=(0, 1))

    def in_view(corners, farthest):
        x, y, z = jnp.moveaxis(corners, -1, 0)
        outside = [z < 0, z > farthest, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return ~jnp.any(jnp.stack([side.all(axis=-1) for side in outside]), axis=0)

    return in_view


def sample_map(
    scene: SceneField,
    config: GridConfig,
    wide: bool,
    params: Params,
    fusion_state: Any,
    point: Float[Array, "3"],
) -> MapSample:
    """A point in a map: by the scene's distance and, away from surfaces, by the wide one of a fused map.

    Near a surface the scene's own is the truer one: the wide one mixes what is on both sides of thin things.
    Farther off, nodes of the cell that it comes from are cut off.
    """
    distance, rgb = scene.query(params, point, jnp.zeros(3, point.dtype))
    if not wide:
        return MapSample(distance, rgb, (jnp.abs(distance) < _CUT * config.truncation).astype(distance.dtype))
    *_, far, valid = trilinear(fusion_state, (point - jnp.asarray(config.lower, point.dtype)) / config.voxel)
    measured = (valid > 1 - 1e-3) & (jnp.abs(far) < _CUT * _REACH * config.voxel)
    whole = jnp.abs(distance) < config.truncation - _BESIDE * config.voxel
    whole &= jnp.abs(far) < config.truncation - config.voxel
    return MapSample(jnp.where(whole, distance, far), rgb, measured.astype(distance.dtype))
