"""NeRF's perceptron with BARF's coarse-to-fine encoding: the scene of Ma et al. 2024, section 4.1."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxpose import nn
from jaxpose.nn_columns import dense, frequency_encoding, product, spread
from jaxpose.scenes.types import SceneField

_RELU_GAIN = math.sqrt(2)


@dataclass(frozen=True)
class NerfConfig:
    """The defaults are BARF's network for Blender and LLFF: 530,052 parameters."""

    layers: int = 8  # of features
    width: int = 256
    skip: int | None = 4  # the layer (from 0) that sees the encoded point again; nothing where there is none
    colour_width: int = 128
    octaves: int = 10  # of the point's encoding
    direction_octaves: int = 4
    # Coarse-to-fine on both encodings, as fractions of the training; None: all bands from the start.
    window: tuple[float, float] | None = (0.1, 0.5)
    # Whether the weights of the encodings' bands start at zero. A band that opens then changes nothing at
    # first; in a short training, which has no time to adapt, it would else be noise that poses run after.
    zero_bands: bool = False

    def __post_init__(self):
        if (
            min(self.layers, self.width, self.colour_width) < 1
            or min(self.octaves, self.direction_octaves) < 0
        ):
            raise ValueError(f"NerfConfig: expected sizes >= 1 and octaves >= 0, got {self}")
        if self.skip is not None and not 0 < self.skip < self.layers - 1:
            # The last layer's inputs are also the density's, which BARF's skip does not reach.
            raise ValueError(f"skip: expected a layer from 1 to {self.layers - 2} or None, got {self.skip}")
        if self.window is not None and self.window[0] >= self.window[1]:
            raise ValueError(f"window: expected (start, end) with start < end, got {self.window}")


def nerf(config: NerfConfig = NerfConfig()) -> SceneField:  # noqa: B008 - frozen
    """A radiance field: NeRF's perceptron (Mildenhall et al. 2020) with BARF's encoding (Lin et al. 2021).

    Density is per unit of length (softplus), colour in [0, 1] (sigmoid). The direction's length does not
    matter; points are not normalised: the lowest band of their encoding has a period of 2 units. Weights
    start Xavier-uniform with BARF's gains.

    Args:
        config: Sizes of the network, octaves of the encodings, coarse-to-fine window.

    Returns:
        The scene. Its parameters are a dict of layers `{"kernel", "bias"}`; with a `window` there is also
        `progress`, which `fields.set_progress` sets and no gradient reaches.

    >>> scene = nerf(NerfConfig(layers=2, width=16, skip=None, colour_width=8))
    >>> params = scene.init(jax.random.key(0))
    >>> density, rgb = scene.query(params, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))
    >>> print(density.shape, rgb.shape)
    () (3,)
    """
    sizes = _sizes(config)

    def init(key):
        keys = dict(zip(sizes, jax.random.split(key, len(sizes)), strict=True))
        params: dict = {name: _draw(keys[name], *size) for name, size in sizes.items()}
        if config.zero_bands:
            for name, bands in _bands(config).items():
                params[name]["kernel"] = params[name]["kernel"].at[bands].set(0)
        return params if config.window is None else params | {"progress": jnp.zeros(())}

    def query(params, point, direction):
        length = jnp.sqrt(jnp.maximum(jnp.sum(direction**2), jnp.finfo(direction.dtype).tiny))
        encoded = _encode(config, params, point, config.octaves)
        seen_along = _encode(config, params, direction / length, config.direction_octaves)
        hidden = encoded
        for number in range(config.layers - 1):
            hidden = _layer(config, params, number, hidden, encoded)
        density = nn.softplus(dense(params["density"], hidden)[0])
        hidden = _layer(config, params, config.layers - 1, hidden, encoded)
        # The direction's share is the same for all samples of a ray, and vmap computes it once a ray.
        kernel = params["colour_0"]["kernel"]
        along = product(kernel[config.width :], seen_along) + params["colour_0"]["bias"]
        hidden = product(kernel[: config.width], hidden)
        hidden = jax.nn.relu(hidden + spread(along, hidden))
        return density, jax.nn.sigmoid(dense(params["colour_1"], hidden))

    return SceneField(init, query)


def _encode(config, params, x, octaves):
    weights = None
    if config.window is not None:
        progress = jax.lax.stop_gradient(params["progress"])
        weights = nn.window_weights(progress, octaves, config.window)
    return frequency_encoding(x, octaves, weights=weights)


def _layer(config, params, number, hidden, encoded):
    layer = params[f"layer_{number}"]
    if number != config.skip:
        return jax.nn.relu(dense(layer, hidden))
    # Two products in place of one of both inputs joined, which would first have to be copied together.
    kernel = layer["kernel"]
    joined = product(kernel[: config.width], hidden) + product(kernel[config.width :], encoded)
    return jax.nn.relu(joined + spread(layer["bias"], joined))


def _sizes(config: NerfConfig) -> dict[str, tuple[int, int, float]]:
    """Inputs, outputs and gain of every layer."""
    encoded, seen_along = (3 * (1 + 2 * octaves) for octaves in (config.octaves, config.direction_octaves))
    width = config.width
    sizes = {"layer_0": (encoded, width, _RELU_GAIN)}
    for number in range(1, config.layers):
        sizes[f"layer_{number}"] = (width + encoded * (number == config.skip), width, _RELU_GAIN)
    return sizes | {
        "density": (encoded if config.layers == 1 else width, 1, 1.0),
        "colour_0": (width + seen_along, config.colour_width, _RELU_GAIN),
        "colour_1": (config.colour_width, 3, 1.0),
    }


def _bands(config: NerfConfig) -> dict[str, slice]:
    """Rows of kernels that see bands of an encoding, by layer."""
    bands, along = 6 * config.octaves, 6 * config.direction_octaves
    rows = {"layer_0": slice(3, 3 + bands), "colour_0": slice(config.width + 3, config.width + 3 + along)}
    if config.skip is not None:
        rows[f"layer_{config.skip}"] = slice(config.width + 3, config.width + 3 + bands)
    return rows


def _draw(key, inputs: int, outputs: int, gain: float):
    bound = gain * math.sqrt(6 / (inputs + outputs))
    kernel = jax.random.uniform(key, (inputs, outputs), jnp.zeros(()).dtype, -bound, bound)
    return {"kernel": kernel, "bias": jnp.zeros(outputs)}
