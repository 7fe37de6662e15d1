"""Voxel blocks over a box, and the places of their nodes."""

import jax.numpy as jnp
import numpy as np

from jaxpose.scenes.voxel_blocks import (
    CELLS,
    CHANNELS,
    decoded_channel,
    empty_blocks,
    of_distance_and_colour,
    with_blocks,
)


def over_box(config, lower, upper):
    """Free blocks that hold a box [m], in a pool that is small and full."""
    corners = np.floor(np.array([lower, upper]) / (CELLS * config.voxel)).astype(int)
    ranges = [np.arange(low, high + 1) for low, high in corners.T]
    coords = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)
    return with_blocks(config, empty_blocks(config, capacity=len(coords) + 1, side=4, bricks=64), coords)


def decoded(config, stored):
    """All channels of nodes (..., 8) as they were before they were stored."""
    return np.stack([decoded_channel(config, k, stored[..., k]) for k in range(CHANNELS)], axis=-1)


def node_positions(config, blocks):
    """Places (n, 9, 9, 9, 3) [m] of the nodes of the blocks in use, float64."""
    within = np.stack(np.meshgrid(*[np.arange(CELLS + 1)] * 3, indexing="ij"), axis=-1)
    coords = np.asarray(blocks.coords)[1 : int(blocks.count)]
    return config.voxel * (CELLS * coords[:, None, None, None] + within).astype(np.float64)


def filled(config, lower, upper, values_at):
    """Blocks over a box whose first four channels are `values_at(points)`."""
    blocks = over_box(config, lower, upper)
    values = np.array(blocks.values)
    values[1 : int(blocks.count)] = of_distance_and_colour(config, values_at(node_positions(config, blocks)))
    return blocks._replace(values=jnp.asarray(values))
