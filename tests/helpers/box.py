"""A room in closed form, for alignment and search: three pairs of walls, coloured by place."""

import jax.numpy as jnp
import numpy as np

from jaxpose.slam.map.integrate import MapSample
from jaxpose.slam.observation import Pixels

LOWER, UPPER = np.float32([-2, -1.5, -1]), np.float32([2, 1.5, 3])


def inside_of_a_box(point):
    """What a map that knows everything says of a point."""
    lower, upper = LOWER.astype(point.dtype), UPPER.astype(point.dtype)
    walls = jnp.concatenate([point - lower, upper - point])
    distance = walls[jnp.argmin(walls)]  # of `jnp.min`, whatever equals it shares the derivative: none may
    return MapSample(distance, 0.5 + 0.4 * jnp.sin(3 * point), jnp.ones_like(distance))


def box_pixels(T_world_cam, count):
    """Exact depth and colour of the box at random pixels."""
    rng = np.random.default_rng(0)
    ray = np.concatenate([rng.uniform(-0.6, 0.6, (count, 2)), np.ones((count, 1))], axis=1)
    direction, origin = ray @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    depth = np.min(np.where(direction > 0, UPPER - origin, LOWER - origin) / direction, axis=1)
    points = origin + depth[:, None] * direction
    return Pixels(*(jnp.asarray(x, jnp.float32) for x in (ray, depth, 0.5 + 0.4 * np.sin(3 * points))))
