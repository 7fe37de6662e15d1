"""Colour finer than a map's cells: its surface, painted from the keyframes when the run is over.

Colour changes faster along a surface than its distance does, and a camera is tracked by the latter. So the
map that is tracked against keeps coarse colour, and only what is rendered, or saved, has this.
"""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxpose import se3
from jaxpose.camera import Camera
from jaxpose.scenes import GridConfig, SceneField
from jaxpose.scenes.grid import trilinear
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.observe import locate
from jaxpose.slam.planes import seen_by

_FINER = 2  # cells of paint along one of the map's
_COAT = 1.2  # cells of paint to either side of the surface
_SAME = 2.0  # cells of the map that a measured surface may be off the map's
_PAINTED = 0.25  # weight of painted nodes around a point from which on they give its colour


def paint(
    grid: GridConfig, distance: Float[np.ndarray, "x y z"], keyframes: Iterable[Keyframe], camera: Camera
) -> UInt8[np.ndarray, "u v w 4"]:
    """Red, green, blue and 255 (0: none) at nodes `_FINER` times as dense as the map's, near its surface.

    `distance` [m] is the map's signed distance. A node's colour is the mean over the keyframes that measured
    the surface there, weighted by how many pixels a piece of it fills.
    """
    nodes = _coat(grid, distance)
    points = np.asarray(grid.lower, np.float32) + np.float32(grid.voxel / _FINER) * nodes.astype(np.float32)
    near = _SAME * grid.voxel

    @jax.jit
    def add(total, points, image, T_world_cam):
        points_cam = se3.apply(se3.inverse(T_world_cam), points)
        at = locate(camera, points_cam)
        seen = seen_by(image, camera)(at)
        same = (seen.worth > 0) & (jnp.abs(seen.distance(points_cam)) < near)
        filled = jnp.maximum(seen.facing(points_cam), 0) / jnp.maximum(at.depth, 0.1) ** 3
        weight = jnp.where(same, filled, 0)[:, None]
        return total + weight * jnp.concatenate([seen.rgb, jnp.ones_like(weight)], axis=-1)

    total, on_device = jnp.zeros((len(nodes), 4)), jnp.asarray(points)
    for keyframe in keyframes:
        total = add(total, on_device, keyframe.image, jnp.asarray(keyframe.T_world_cam, jnp.float32))
    rgb, weight = np.split(np.asarray(total), [3], axis=-1)
    painted = weight[:, 0] > 0
    coat = np.zeros((*(_FINER * (np.array(distance.shape) - 1) + 1), 4), np.uint8)
    colour = np.round(255 * rgb[painted] / weight[painted])
    coat[tuple(nodes[painted].T)] = np.concatenate([colour, np.full((len(colour), 1), 255)], axis=1)
    return coat


def painted(scene: SceneField, grid: GridConfig) -> SceneField:
    """A map's scene with its paint: parameters (values, paint); the map's own colour where there is none."""

    def query(params, point, direction):
        *values, coat = params
        distance, rgb = scene.query(tuple(values), point, direction)
        position = (point - jnp.asarray(grid.lower, point.dtype)) * (_FINER / grid.voxel)
        colour, alpha = jnp.split(trilinear(coat, position) / 255, [3])
        return distance, jnp.where(alpha > _PAINTED, colour / jnp.maximum(alpha, _PAINTED), rgb)

    return SceneField(scene.init, query)


def _coat(grid: GridConfig, distance: Float[np.ndarray, "x y z"]) -> Int[np.ndarray, "m 3"]:
    """The nodes of paint whose trilinear distance is within the coat, slab by slab."""
    thick = _COAT * grid.voxel / _FINER
    found = []
    for x, slab in enumerate(zip(distance[:-1], distance[1:], strict=True)):
        for k in range(_FINER):
            share = k / _FINER
            between = _refined(_refined((1 - share) * slab[0] + share * slab[1], 0), 1)
            v, w = np.nonzero(np.abs(between) < thick)
            found.append(np.stack([np.full(len(v), _FINER * x + k), v, w], axis=-1))
    return np.concatenate(found)


def _refined(plane: Float[np.ndarray, "y z"], axis: int) -> Float[np.ndarray, "_ _"]:
    """Linear interpolation between the nodes along one axis."""
    at = np.arange(_FINER * (plane.shape[axis] - 1) + 1) / _FINER
    low = np.minimum(at.astype(int), plane.shape[axis] - 2)
    share = np.expand_dims((at - low).astype(plane.dtype), 1 - axis)
    return (1 - share) * np.take(plane, low, axis) + share * np.take(plane, low + 1, axis)
