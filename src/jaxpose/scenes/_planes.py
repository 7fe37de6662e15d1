"""A radiance field in planes and lines: sharp within minutes on a CPU, where cameras are known roughly.

Density and colour at a point are sums of products of a plane's value and a line's (Chen et al., "TensoRF",
ECCV 2022), each a pyramid whose fine levels open within the training. Space is the scene's core and, drawn
together, all that is around it (after Barron et al., "Mip-NeRF 360", CVPR 2022, axis by axis).
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose import nn
from jaxpose.scenes.types import SceneField

Params = Any

_AROUND = 1 / 3  # what is around the core takes, of the core's half, on each side
_AXES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # two of each plane, and that of its line
_START = 0.1  # spread of the coarsest level
_STEEP, _EMPTY, _DENSE = 3.0, 5.0, 20.0  # density = _DENSE softplus(_STEEP sum - _EMPTY) per half of the core
_CELLS = 48  # along a side, of the grid that says where the scene is empty


@dataclass(frozen=True)
class PlanesConfig:
    """Where the core is, and how fine it is seen."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the core [scene units]
    half: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of its sides [scene units]
    nodes: int = 96  # along a side of the finest planes, a power of two times that of the coarsest
    levels: int = 3
    density_rank: int = 8  # products of each plane that sum up to the density
    colour_rank: int = 16  # and those that colour is decoded from
    colour_width: int = 32
    window: tuple[float, float] = (0.1, 0.5)  # in which finer levels open, shares of the training

    def __post_init__(self):
        if min(self.half) <= 0:
            raise ValueError(f"PlanesConfig.half: expected more than 0, got {self.half}")
        if min(self.levels, self.density_rank, self.colour_rank, self.colour_width) < 1:
            raise ValueError(f"PlanesConfig: expected levels, ranks and width >= 1, got {self}")
        if self.nodes % 2 ** (self.levels - 1) or self.nodes >> (self.levels - 1) < 2:
            raise ValueError(
                f"PlanesConfig.nodes: expected a multiple of {2 ** (self.levels - 1)}, got {self.nodes}"
            )


def planes(config: PlanesConfig) -> SceneField:
    """A radiance field in planes and lines.

    Args:
        config: Its core, resolution and ranks.

    Returns:
        The scene; density per unit of length, colour in [0, 1]. Its parameters are a dict with `progress`,
        which `fields.set_progress` sets, and `occupancy`, which `with_occupancy` sets, without gradients.

    >>> scene = planes(PlanesConfig(nodes=8, levels=1))
    >>> params = scene.init(jax.random.key(0))
    >>> density, rgb = scene.query(params, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))
    >>> print(density.shape, rgb.shape)
    () (3,)
    """
    ranks = config.density_rank + config.colour_rank

    def init(key: PRNGKeyArray) -> Params:
        plane_key, line_key, hidden_key, colour_key = jax.random.split(key, 4)
        draw = lambda key, *shape: _START * jax.random.normal(key, shape)
        sizes = [config.nodes >> (config.levels - 1 - level) for level in range(config.levels)]
        grids = {f"plane_{k}": jnp.zeros((3, n, n, ranks)) for k, n in enumerate(sizes)}
        grids |= {f"line_{k}": jnp.zeros((3, n, ranks)) for k, n in enumerate(sizes)}
        grids["plane_0"] = draw(plane_key, *grids["plane_0"].shape)
        grids["line_0"] = draw(line_key, *grids["line_0"].shape) + 3 * _START
        inputs, width = 3 * config.colour_rank + 3, config.colour_width
        return {
            "grids": grids,
            "decoder": {
                "hidden": jax.random.normal(hidden_key, (inputs, width)) * (2 / inputs) ** 0.5,
                "hidden_bias": jnp.zeros(width),
                "rgb": jax.random.normal(colour_key, (width, 3)) * (1 / width) ** 0.5,
                "rgb_bias": jnp.zeros(3),
            },
            "occupancy": jnp.full((_CELLS,) * 3, jnp.inf),
            "progress": jnp.zeros(()),
        }

    def query(params, point, direction):
        plane, line = _combined(config, params)
        found = _at_node(plane, line, _node(config, point))  # (3, r)
        density = _density(config, found)
        along = direction / jnp.sqrt(jnp.sum(direction**2) + jnp.finfo(direction.dtype).tiny)
        features = jnp.concatenate([found[:, config.density_rank :].reshape(-1), along])
        decoder = params["decoder"]
        hidden = jax.nn.relu(features @ decoder["hidden"] + decoder["hidden_bias"])
        return density, jax.nn.sigmoid(hidden @ decoder["rgb"] + decoder["rgb_bias"])

    return SceneField(init, query)


def with_occupancy(config: PlanesConfig, params: Params) -> Params:
    """The parameters with the grid that says where the scene is empty as they now are.

    Args:
        config: Of the scene.
        params: Its parameters.

    Returns:
        The same with another `occupancy`: the largest density in and around each cell.
    """
    plane, line = _combined(config, params)
    along = (jnp.arange(_CELLS, dtype=plane.dtype) + 0.5) / _CELLS * (config.nodes - 1)
    cells = jnp.stack(jnp.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)
    density = lambda node: _density(config, _at_node(plane, line, node))
    found = jax.lax.map(density, cells, batch_size=4096).reshape((_CELLS,) * 3)
    widest = jax.lax.reduce_window(found, -jnp.inf, jax.lax.max, (3, 3, 3), (1, 1, 1), "SAME")
    return params | {"occupancy": widest}


def occupancy(config: PlanesConfig, params: Params, point: Float[Array, "3"]) -> Float[Array, ""]:
    """How dense the scene may be at a point: the largest density in and around its cell, at the last look.

    Args:
        config: Of the scene.
        params: Its parameters, as `with_occupancy` has left them; infinite before.
        point: In the world (3,).

    Returns:
        Density per unit of length.
    """
    cell = (_node(config, point) / (config.nodes - 1) * _CELLS).astype(jnp.int32)
    i, j, k = jnp.clip(cell, 0, _CELLS - 1)
    return params["occupancy"][i, j, k]


def _combined(config: PlanesConfig, params: Params) -> tuple[Float[Array, "3 n n r"], Float[Array, "3 n r"]]:
    """The pyramids' levels as far as they are open, added up at the finest."""
    grids, finer = params["grids"], config.levels - 1
    opened = nn.window_weights(jax.lax.stop_gradient(params["progress"]), finer, config.window)
    weights = jnp.concatenate([jnp.ones(1), opened])
    plane, line = grids["plane_0"], grids["line_0"]
    for level in range(1, config.levels):
        plane = _twice(_twice(plane, 1), 2) + weights[level] * grids[f"plane_{level}"]
        line = _twice(line, 1) + weights[level] * grids[f"line_{level}"]
    return plane, line


def _twice(values: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """Twice as many nodes along an axis between the same ends, interpolated linearly."""
    n = values.shape[axis]
    place = jnp.linspace(0, n - 1, 2 * n)
    low = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, n - 2)
    share = (place - low.astype(place.dtype)).reshape([-1 if k == axis else 1 for k in range(values.ndim)])
    return jnp.take(values, low, axis) * (1 - share) + jnp.take(values, low + 1, axis) * share


def _node(config: PlanesConfig, point: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Where a point of the world is among the nodes, 0 to `nodes` - 1."""
    x = (point - jnp.asarray(config.centre)) / jnp.asarray(config.half)
    beyond = jnp.maximum(jnp.abs(x) - 1, 0)
    drawn = jnp.clip(x, -1, 1) + jnp.sign(x) * _AROUND * beyond / (beyond + _AROUND)
    return (drawn / (1 + _AROUND) + 1) / 2 * (config.nodes - 1)


def _at_node(
    plane: Float[Array, "3 n n r"], line: Float[Array, "3 n r"], node: Float[Array, "3"]
) -> Float[Array, "3 r"]:
    """Each plane's values times its line's."""
    n, ranks = plane.shape[1], plane.shape[-1]
    low = jnp.clip(jnp.floor(jax.lax.stop_gradient(node)).astype(jnp.int32), 0, n - 2)
    share = node - low.astype(node.dtype)
    found = []
    for number, (i, j, k) in enumerate(_AXES):
        flat = plane[number].reshape(n * n, ranks)
        at = low[i] * n + low[j]
        take = lambda values, index: values.at[index].get(mode="promise_in_bounds")
        first = take(flat, at) * (1 - share[i]) + take(flat, at + n) * share[i]
        second = take(flat, at + 1) * (1 - share[i]) + take(flat, at + n + 1) * share[i]
        across = first * (1 - share[j]) + second * share[j]
        along = take(line[number], low[k]) * (1 - share[k]) + take(line[number], low[k] + 1) * share[k]
        found.append(across * along)
    return jnp.stack(found)


def _density(config: PlanesConfig, products: Float[Array, "3 r"]) -> Float[Array, ""]:
    total = jnp.sum(products[:, : config.density_rank])
    return _DENSE / (sum(config.half) / 3) * nn.softplus(_STEEP * total - _EMPTY)
