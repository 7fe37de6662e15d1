"""Multi-resolution feature grids of signed distance and colour: a scene that trains in seconds on a CPU.

The features are the values themselves, summed over levels whose nodes are nested (one cell of a level holds
`RATIO`^3 of the next), so that no decoder needs pretrained weights, a coarse level fills in what few rays
have seen, and the levels can be merged into the finest one without changing a single value (`merge`).
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Real

from jaxpose._checks import check_finite, check_shapes
from jaxpose.scenes.types import Params, SceneField

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
            raise ValueError(
                f"GridConfig: expected voxel > 0 and levels >= 1, got {self.voxel}, {self.levels}"
            )


def grid(config: GridConfig) -> SceneField:
    """Signed distance [m], positive in front of surfaces, and colour on nested grids.

    Trilinear between nodes; outside the box the value of the nearest face holds. The direction does not
    matter, and the colour is not squashed.

    Args:
        config: The box and its resolution.

    Returns:
        The scene. Its parameters are a tuple of arrays (x, y, z, 4), the coarsest level first: signed
        distance, red, green, blue.

    >>> scene = grid(GridConfig(voxel=0.25, levels=1))
    >>> distance, rgb = scene.query(scene.init(jax.random.key(0)), jnp.zeros(3), jnp.ones(3))
    >>> print(f"{distance:.2f}", rgb)  # nothing is known yet: free space, grey
    0.12 [0.5 0.5 0.5]
    """
    lower = np.asarray(config.lower, np.float32)
    coarse_cells = _coarse_cells(config)

    def init(key):
        del key  # nothing is random: free space, grey
        shapes = [tuple(coarse_cells * RATIO**level + 1) + (_CHANNELS,) for level in range(config.levels)]
        return (jnp.broadcast_to(_free(config), shapes[0]), *(jnp.zeros(shape) for shape in shapes[1:]))

    def query(params, point, direction):
        del direction  # surfaces are taken as matt
        position = (point - lower.astype(point.dtype)) / config.voxel  # in cells of the finest level
        steps = [RATIO ** (config.levels - 1 - level) for level in range(config.levels)]
        # A merged scene has one level, the finest.
        first, *rest = (
            trilinear(level, position / step)
            for level, step in zip(params, steps[-len(params) :], strict=True)
        )
        value = sum(rest, first)
        return value[0], value[1:]

    return SceneField(init, query)


def bounding_grid(
    points: np.ndarray, *, voxel: float | None = None, levels: int = 2, nodes: int = 4_000_000
) -> GridConfig:
    """A grid around world points, wider on every side by a quarter of their extent and 0.2 m.

    Args:
        points: World points (n, 3) [m].
        voxel: Side of a voxel [m] of the finest level; None: what gives about `nodes` nodes.
        levels: How many nested levels.
        nodes: How many nodes the finest level has, where `voxel` does not say.

    Returns:
        The grid's settings.

    Raises:
        ValueError: For no points, points of another shape, and points that are not finite.

    >>> bounding_grid(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), voxel=0.1, levels=1).lower
    (-0.5, -0.5, -0.5)
    """
    check_shapes(points=(points, "n 3"))
    check_finite(points=points)
    if len(points) == 0:
        raise ValueError("points: expected at least one, got none")
    lower, upper = points.min(axis=0), points.max(axis=0)
    margin = 0.25 * (upper - lower) + 0.2
    lower, upper = lower - margin, upper + margin
    if voxel is None:
        voxel = float(np.clip((np.prod(upper - lower) / nodes) ** (1 / 3), 0.01, 0.2))
    cell = voxel * RATIO ** (levels - 1)
    # Whole cells, so that growing keeps every node; nodes are at multiples of the voxel, as those of blocks.
    lower, upper = np.floor(lower / cell) * cell, np.ceil(upper / cell) * cell
    return GridConfig(_triple(lower), _triple(upper), voxel, levels, 3 * voxel)


def grow(config: GridConfig, state: Any, points: np.ndarray) -> tuple[GridConfig, Any]:
    """The grid enlarged to hold more world points, its nodes where they were, the new space free.

    Args:
        config: The grid.
        state: Any pytree that holds the parameters under the attribute `params` and arrays shaped like them,
            (x, y, z, c), elsewhere: an optimiser's moments, say, which are zero in the new space.
        points: World points (n, 3) [m].

    Returns:
        The larger grid, and the state on it.
    """
    cell = config.voxel * RATIO ** (config.levels - 1)
    lower, upper = np.array(config.lower), np.array(config.upper)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.3 * (upper - lower)
    before = np.where(low < lower, np.ceil((lower - low + margin) / cell), 0).astype(int)
    after = np.where(high > upper, np.ceil((high - upper + margin) / cell), 0).astype(int)
    widths = {
        values.shape[:3]: [(int(b), int(a)) for b, a in zip(before * k, after * k, strict=True)] + [(0, 0)]
        for k, values in zip((RATIO**level for level in range(config.levels)), state.params, strict=True)
    }
    pad = lambda x: jnp.pad(x, widths[x.shape[:3]]) if x.ndim == 4 else x
    larger = jax.tree.map(pad, state)
    config = replace(config, lower=_triple(lower - before * cell), upper=_triple(upper + after * cell))
    old = pad(jnp.ones_like(state.params[0][..., :1], bool))
    coarse = jnp.where(old, larger.params[0], _free(config))
    return config, larger._replace(params=(coarse, *larger.params[1:]))


def node_shape(config: GridConfig) -> Int[np.ndarray, "3"]:
    """How many nodes the finest level has along x, y and z.

    Args:
        config: The grid.

    Returns:
        Three whole numbers.

    >>> node_shape(GridConfig(voxel=0.25, levels=1)).tolist()
    [9, 9, 9]
    """
    return _coarse_cells(config) * RATIO ** (config.levels - 1) + 1


def node_positions(config: GridConfig) -> Float[np.ndarray, "x y z 3"]:
    """World positions of the nodes of the finest level.

    Args:
        config: The grid.

    Returns:
        Positions [m], float32.
    """
    shape = node_shape(config)
    axes = [low + config.voxel * np.arange(n) for low, n in zip(config.lower, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)


def merge(params: Params) -> Params:
    """The same scene with all levels summed into the finest one: cheaper to query, and equal everywhere.

    Equal because the cells are nested: a trilinear function of a coarse cell is so in each cell within.

    Args:
        params: Parameters of a `grid`.

    Returns:
        Parameters of the same grid, of one level.
    """
    total = params[0]
    for level in params[1:]:
        for axis in range(3):
            total = _refine(total, axis)
        total = total + level
    return (total,)


def _coarse_cells(config: GridConfig) -> np.ndarray:
    sides = np.asarray(config.upper) - np.asarray(config.lower)
    return np.ceil(sides / (config.voxel * RATIO ** (config.levels - 1)) - 1e-4).astype(int)


def _free(config: GridConfig) -> Float[Array, "1 1 1 4"]:
    """What stands where nothing was seen: free space, grey."""
    return jnp.array([config.truncation, 0.5, 0.5, 0.5])[None, None, None]


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


def trilinear(values: Real[Array, "x y z c"], position: Float[Array, "3"]) -> Float[Array, " c"]:
    """Trilinear interpolation of nodes; outside, the value of the nearest face.

    Four rows of two nodes: on a CPU the fastest of the ways tried.

    Args:
        values: Values of the nodes.
        position: Where to interpolate, in cells from the first node.

    Returns:
        The values there.

    >>> trilinear(jnp.arange(8.0).reshape(2, 2, 2, 1), jnp.array([0.5, 0.0, 1.0])).tolist()
    [3.0]
    """
    nodes = values.shape[:3]
    channels = values.shape[3]
    cell = jnp.floor(jax.lax.stop_gradient(position))
    cell = jnp.clip(cell, 0, jnp.array(nodes, position.dtype) - 2)
    fraction = jnp.clip(position - cell, 0, 1)
    i, j, k = cell.astype(jnp.int32)
    flat = values.reshape(-1)

    def along_z(a, b):
        start = (((i + a) * nodes[1] + j + b) * nodes[2] + k) * channels
        row = jax.lax.dynamic_slice(flat, (start,), (2 * channels,)).astype(position.dtype)
        return _between(row[:channels], row[channels:], fraction[2])

    low = _between(along_z(0, 0), along_z(0, 1), fraction[1])
    high = _between(along_z(1, 0), along_z(1, 1), fraction[1])
    return _between(low, high, fraction[0])


def _between(a: Float[Array, " c"], b: Float[Array, " c"], fraction: Float[Array, ""]) -> Float[Array, " c"]:
    return a + (b - a) * fraction


def _triple(x: np.ndarray) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])
