"""Encodings and multi-layer perceptrons; the only module that knows the neural-network library."""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

Params = Any
Activation = Literal["relu", "softplus", "sigmoid"]
Precision = Literal["default", "high", "highest"]


def frequency_encoding(
    x: Float[Array, "*n d"], octaves: int, *, weights: Float[Array, " octaves"] | None = None
) -> Float[Array, "*n encoded"]:
    """`[x, sin(2^k pi x), cos(2^k pi x)]` for k = 0 .. octaves - 1.

    Bands of one coordinate are together (Mildenhall et al. 2020, eq. 4, with `x` itself in front).

    Args:
        x: (..., d).
        octaves: number of bands; 0 returns `x`.
        weights: (octaves,), what multiplies the bands and never `x` itself: see `window_weights`.

    Returns:
        Features (..., d (1 + 2 octaves)).

    >>> print(frequency_encoding(jnp.array([0.5]), 1).round(6) + 0.0)
    [0.5 1.  0. ]
    """
    if octaves == 0:
        return x
    # Powers of two and the reduction to one period are exact in floating point, so that the phase of a high
    # band is as accurate as that of the lowest. `round` has derivative zero, as it should.
    turns = jnp.multiply.outer(x, 2.0 ** jnp.arange(octaves, dtype=x.dtype) / 2)
    phase = 2 * math.pi * (turns - jnp.round(turns))
    bands = jnp.stack([jnp.sin(phase), jnp.cos(phase)], axis=-2)
    if weights is not None:
        bands = bands * jnp.broadcast_to(weights, bands.shape)
    return jnp.concatenate([x, bands.reshape(*x.shape[:-1], -1)], axis=-1)


def window_weights(
    progress: Float[Array, ""], octaves: int, window: tuple[float, float]
) -> Float[Array, " octaves"]:
    """Coarse-to-fine weight of every octave: bands open one by one within a window of the training.

    w_k = (1 - cos(pi clamp(alpha - k, 0, 1))) / 2, alpha = octaves (progress - a) / (b - a) (BARF, Lin et al.
    2021, eq. 14).

    Args:
        progress: share of the training, 0 to 1.
        octaves: number of bands.
        window: (a, b), where the first begins to open and where the last is open.

    Returns:
        Weights (octaves,) from 0 to 1.

    >>> print(window_weights(jnp.array(0.5), 4, (0.0, 1.0)))
    [1. 1. 0. 0.]
    """
    start, end = window
    alpha = octaves * (progress - start) / (end - start)
    opened = jnp.clip(alpha - jnp.arange(octaves, dtype=progress.dtype), 0, 1)
    return (1 - jnp.cos(math.pi * opened)) / 2


@jax.custom_jvp
def softplus(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """log(1 + exp(x)). Its derivatives are made of one sigmoid, which the general rule does not find.

    By that rule, that of `jax.nn.softplus`, the second derivative of the activation takes twice as long and
    is five times less exact.
    """
    return jnp.maximum(x, 0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


@softplus.defjvp
def _softplus_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    return softplus(x), jax.nn.sigmoid(x) * dx


class Network(NamedTuple):
    """A network as two pure functions; the parameters are a dict of plain arrays."""

    init: Callable[[PRNGKeyArray], Params]
    apply: Callable[[Params, Float[Array, "*n inputs"]], Float[Array, "*n outputs"]]


def mlp(
    inputs: int,
    outputs: int,
    *,
    layers: int = 8,
    width: int = 256,
    skip: int | None = 4,
    activation: Activation = "relu",
    gain: float = 1.0,
    small_output: bool = False,
    precision: Precision = "default",
) -> Network:
    """A perceptron, Xavier-uniform with zero bias.

    Args:
        inputs: length of what it takes, and
        outputs: of what it gives.
        layers: linear layers, the output counted.
        width: of the hidden layers.
        skip: the layer (from 0) at whose input the network's input is concatenated again; nothing where there
            is no such layer.
        activation: between layers.
        gain: what Xavier's draw is multiplied by.
        small_output: draws the last layer from U(0, 1e-7), so that the output starts at zero.
        precision: of the products: "highest" for what is differentiated in time.

    Returns:
        The network; its parameters have the default floating-point type at the time of `init`.

    >>> network = mlp(2, 3, layers=2, width=8)
    >>> network.apply(network.init(jax.random.key(0)), jnp.zeros((5, 2))).shape
    (5, 3)
    """
    module = _MLP(outputs, layers, width, skip, activation, gain, small_output, precision)

    def init(key):
        return module.init(key, jnp.zeros(inputs))["params"]

    def apply(params, x) -> Any:
        return module.apply({"params": params}, x)

    return Network(init, apply)


class _MLP(nn.Module):
    outputs: int
    layers: int
    width: int
    skip: int | None
    activation: Activation
    gain: float
    small_output: bool
    precision: Precision

    @nn.compact
    def __call__(self, x):
        activation = {"relu": jax.nn.relu, "softplus": softplus, "sigmoid": jax.nn.sigmoid}[self.activation]
        xavier = nn.initializers.variance_scaling(self.gain**2, "fan_avg", "uniform")
        hidden = x
        for layer in range(self.layers):
            last = layer == self.layers - 1
            if layer == self.skip:
                hidden = jnp.concatenate([hidden, x], axis=-1)
            hidden = nn.Dense(
                self.outputs if last else self.width,
                kernel_init=_small_uniform if last and self.small_output else xavier,
                precision=self.precision,
                param_dtype=jnp.zeros(()).dtype,
                name=f"layer_{layer}",
            )(hidden)
            if not last:
                hidden = activation(hidden)
        return hidden


def _small_uniform(key, shape, dtype):
    return jax.random.uniform(key, shape, dtype, maxval=1e-7)
