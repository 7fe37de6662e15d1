"""Multi-resolution feature grids of signed distance and colour: a scene that trains in seconds on a CPU.

The features are the values themselves, summed over levels whose nodes are nested (one cell of a level holds
`RATIO`^3 of the next), so that no decoder needs pretrained weights, a coarse level fills in what few rays have
seen, and the levels can be merged into the finest one without changing a single value (`merge`).
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.scenes.base import Params, SceneField

RATIO = 4
_CHANNELS = 4  # signed distance [m], red, green, blue


@dataclass(frozen=True)
class GridConfig:
    """A box of the world [m] and how finely it is resolved."""

    lower: tuple[float, float, float] = (-1.0, -1.0, -1.0)
    upper: tuple[float, float, float] = (1.0, 1.0, 1.0)
    voxel: float = 0.04  # [m] of the finest level
    levels: int = 2
    truncation: float = 0.12  # [m] signed distance where nothing was seen: free space

    def __post_init__(self):
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"GridConfig: expected lower < upper, got {self.lower} and {self.upper}")
        if self.voxel <= 0 or self.levels < 1:
            raise ValueError(f"GridConfig: expected voxel > 0 and levels >= 1, got {self.voxel}, {self.levels}")


def grid(config: GridConfig) -> SceneField:
    """Signed distance [m] (positive in front of surfaces) and colour on nested grids; trilinear between nodes.

    Parameters are a tuple of arrays (x, y, z, 4), coarsest first; the colour is not squashed. Outside the box the
    value of the nearest face holds.
    """
    lower = np.asarray(config.lower, np.float32)
    sides = np.asarray(config.upper, np.float32) - lower
    coarse_cells = np.ceil(sides / (config.voxel * RATIO ** (config.levels - 1)) - 1e-4).astype(int)

    def init(key):
        del key  # nothing is random: free space, grey
        shapes = [tuple(coarse_cells * RATIO**level + 1) + (_CHANNELS,) for level in range(config.levels)]
        start = jnp.array([config.truncation, 0.5, 0.5, 0.5])
        return (jnp.broadcast_to(start, shapes[0]), *(jnp.zeros(shape) for shape in shapes[1:]))

    def query(params, point, direction):
        del direction  # surfaces are taken as matt
        position = (point - lower.astype(point.dtype)) / config.voxel  # in cells of the finest level
        steps = [RATIO ** (config.levels - 1 - level) for level in range(config.levels)]
        # A merged scene has one level, the finest.
        value = sum(
            _trilinear(level, position / step) for level, step in zip(params, steps[-len(params) :], strict=True)
        )
        return value[0], value[1:]

    return SceneField(init, query)


def box(points: np.ndarray, *, voxel: float | None = None, levels: int = 2, nodes: int = 400_000) -> GridConfig:
    """A grid around world points (n, 3) [m], a quarter of its size wider on every side, of about `nodes` nodes.

    With `voxel` [m] given, the number of nodes follows instead.
    """
    lower, upper = points.min(axis=0), points.max(axis=0)
    margin = 0.25 * (upper - lower) + 0.2
    lower, upper = lower - margin, upper + margin
    if voxel is None:
        voxel = float(np.clip((np.prod(upper - lower) / nodes) ** (1 / 3), 0.01, 0.2))
    cell = voxel * RATIO ** (levels - 1)
    upper = lower + np.ceil((upper - lower) / cell) * cell  # whole cells, so that growing keeps every node
    return GridConfig(_triple(lower), _triple(upper), voxel, levels, 3 * voxel)


def grow(config: GridConfig, params: Params, points: np.ndarray, *, fill: bool = True):
    """The grid enlarged to hold more world points (n, 3) [m]: `(config, params)`, nodes where they were.

    New space is free. With `fill=False` it is zero, as moments of an optimiser want it.
    """
    cell = config.voxel * RATIO ** (config.levels - 1)
    lower, upper = np.array(config.lower), np.array(config.upper)
    margin = 0.1 * (upper - lower)
    before = np.ceil(np.maximum(lower - points.min(axis=0) + margin, 0) / cell).astype(int)
    before = np.where(points.min(axis=0) < lower, before, 0)
    after = np.ceil(np.maximum(points.max(axis=0) - upper + margin, 0) / cell).astype(int)
    after = np.where(points.max(axis=0) > upper, after, 0)
    start = (config.truncation, 0.5, 0.5, 0.5)
    levels = []
    for level, values in enumerate(params):
        nodes = [(int(b), int(a)) for b, a in zip(before * RATIO**level, after * RATIO**level, strict=True)]
        channels = [
            jnp.pad(values[..., c], nodes, constant_values=start[c] if fill and level == 0 else 0.0)
            for c in range(_CHANNELS)
        ]
        levels.append(jnp.stack(channels, axis=-1))
    config = replace(config, lower=_triple(lower - before * cell), upper=_triple(upper + after * cell))
    return config, tuple(levels)


def merge(params: Params) -> Params:
    """The same scene with all levels summed into the finest one: cheaper to query, and equal everywhere.

    Equal because the cells are nested: a trilinear function of a coarse cell is trilinear in each cell within.
    """
    total = params[0]
    for level in params[1:]:
        for axis in range(3):
            total = _refine(total, axis)
        total = total + level
    return (total,)


def _refine(values: Float[Array, "x y z c"], axis: int) -> Float[Array, "_ _ _ c"]:
    """Linear interpolation between the nodes along one axis, `RATIO` new cells for each old one."""
    first = jax.lax.slice_in_dim(values, 0, -1, axis=axis)
    step = (jax.lax.slice_in_dim(values, 1, None, axis=axis) - first) / RATIO
    between = jnp.stack([first + step * k for k in range(RATIO)], axis=axis + 1)
    shape = list(values.shape)
    shape[axis] = (shape[axis] - 1) * RATIO
    return jnp.concatenate(
        [between.reshape(shape), jax.lax.slice_in_dim(values, -1, None, axis=axis)], axis=axis
    )


def _trilinear(values: Float[Array, "x y z c"], position: Float[Array, "3"]) -> Float[Array, "c"]:
    """Value at a position in cells. Four rows of two nodes are read: on a CPU the fastest of the ways tried."""
    nodes = values.shape[:3]
    channels = values.shape[3]
    cell = jnp.floor(jax.lax.stop_gradient(position))
    cell = jnp.clip(cell, 0, jnp.array(nodes, position.dtype) - 2)
    fraction = jnp.clip(position - cell, 0, 1)
    i, j, k = cell.astype(jnp.int32)
    flat = values.reshape(-1)
    total = jnp.zeros(channels, values.dtype)
    for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
        start = (((i + a) * nodes[1] + j + b) * nodes[2] + k) * channels
        row = jax.lax.dynamic_slice(flat, (start,), (2 * channels,))
        weight = (fraction[0] if a else 1 - fraction[0]) * (fraction[1] if b else 1 - fraction[1])
        total = total + weight * (row[:channels] + (row[channels:] - row[:channels]) * fraction[2])
    return total


def _triple(x: np.ndarray) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])
