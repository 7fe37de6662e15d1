"""A photograph as a network: point of the image plane to colour, with BARF's coarse-to-fine encoding."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose import nn

Params = Any


class ImageField(NamedTuple):
    """An image as two pure functions, in the manner of `optax.adam`.

    `init(key)` returns a parameter pytree; `query(params, xy)` is the colour in [0, 1] at a point of the
    plane, x to the right and y down, the longer side of the image from -1 to 1.
    """

    init: Callable[[PRNGKeyArray], Params]
    query: Callable[[Params, Float[Array, "2"]], Float[Array, "3"]]


@dataclass(frozen=True)
class ImageConfig:
    """The defaults are BARF's network for planar alignment: 34 -> 256 (4 times) -> 3."""

    octaves: int = 8
    layers: int = 5  # linear layers, the output counted
    width: int = 256
    window: tuple[float, float] | None = (0.0, 0.4)  # coarse-to-fine, as fractions of the training; None: off


def image(config: ImageConfig = ImageConfig()) -> ImageField:  # noqa: B008 - frozen
    """A perceptron on encoded coordinates, BARF's for planar alignment (Lin et al. 2021, section 4.1).

    Weights and biases are drawn from U(+-1/sqrt(inputs)), those of the first layer, most of whose inputs the
    window shuts at first, from a range sqrt(inputs / 2) wider.

    Args:
        config: Size of the network, octaves of its encoding, coarse-to-fine window.

    Returns:
        The image. Its parameters are a dict with the network's weights under `mlp` and, with a `window`,
        `progress`, which `fields.set_progress` sets and no gradient reaches.

    Raises:
        ValueError: For sizes below 1, negative octaves, and a window that does not increase.
    """
    if config.octaves < 0 or config.layers < 1 or config.width < 1:
        raise ValueError(f"expected octaves >= 0, layers >= 1 and width >= 1, got {config}")
    if config.window is not None and config.window[0] >= config.window[1]:
        raise ValueError(f"window: expected (start, end) with start < end, got {config.window}")
    inputs = 2 * (1 + 2 * config.octaves)
    network = nn.mlp(inputs, 3, layers=config.layers, width=config.width, skip=None)

    def init(key):
        shape_key, draw_key = jax.random.split(key)
        layers, tree = jax.tree.flatten(network.init(shape_key), is_leaf=lambda x: "kernel" in x)
        keys = jax.random.split(draw_key, len(layers))
        drawn = [_uniform(k, layer) for k, layer in zip(keys, layers, strict=True)]
        params = {"mlp": jax.tree.unflatten(tree, drawn)}
        if config.window is None:
            return params
        params["mlp"]["layer_0"] = jax.tree.map(lambda x: x * math.sqrt(inputs / 2), params["mlp"]["layer_0"])
        return params | {"progress": jnp.zeros(())}

    def query(params, xy):
        weights = None
        if config.window is not None:
            progress = jax.lax.stop_gradient(params["progress"])
            weights = nn.window_weights(progress, config.octaves, config.window)
        features = nn.frequency_encoding(xy, config.octaves, weights=weights)
        return jax.nn.sigmoid(network.apply(params["mlp"], features))

    return ImageField(init, query)


def _uniform(key: PRNGKeyArray, layer: dict[str, Array]) -> dict[str, Array]:
    """A linear layer's parameters drawn anew."""
    bound = 1 / math.sqrt(layer["kernel"].shape[0])
    keys = dict(zip(layer, jax.random.split(key, len(layer)), strict=True))
    return {
        name: jax.random.uniform(keys[name], x.shape, x.dtype, -bound, bound) for name, x in layer.items()
    }
