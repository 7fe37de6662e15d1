"""PoseNet: a trajectory as a multi-layer perceptron of time (the paper's section 3.1, METHOD section 2)."""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxpose import nn
from jaxpose.fields.types import Params, PoseField
from jaxpose.geometry import se3

_OUTPUTS = {"translation": 3, "rotation": 4}


@dataclass(frozen=True)
class PoseNetConfig:
    """The defaults are the paper's main network: two MLPs, 5 octaves, 8 layers of 256, 803,079 parameters."""

    span: tuple[float, float] = (-1.0, 1.0)  # first and last time [s], mapped to -1 and 1
    octaves: int = 5  # of the time encoding; 0 = time alone (the "linear encoder")
    layers: int = 8  # of each network, the output layer among them
    width: int = 256  # of the hidden layers
    activation: nn.Activation = "relu"  # "softplus" as soon as a time derivative is used
    # Of the Xavier draw of hidden layers; the paper's is 1. Softplus, whose slope at 0 is 1/2, fits in a
    # quarter of the steps with 2, but what it does between the data is rougher.
    gain: float = 1.0
    coupled: bool = False  # one MLP with 7 outputs in place of two
    # "paper": translation within +-translation_scale, rotation below 180 degrees. "free": both unbounded.
    head: Literal["paper", "free"] = "paper"
    translation_scale: float = 1.0  # [m] per unit of output
    window: tuple[float, float] | None = None  # coarse-to-fine on the encoding, as fractions of the training


def posenet(config: PoseNetConfig = PoseNetConfig()) -> PoseField:  # noqa: B008 - frozen
    """PoseNet as a pose field; the identity (within 2e-4) at init.

    The parameters are a dict of one tree of weights per network, `translation` and `rotation` or `coupled`,
    so that optimisers can give each its own rate. With a `window` there is also `progress`, which
    `set_progress` sets and no gradient reaches. Raises ValueError for a configuration that means nothing.
    """
    _check(config)
    first, last = config.span
    encoded = 1 + 2 * config.octaves
    networks = {
        name: nn.mlp(
            encoded,
            outputs,
            layers=config.layers,
            width=config.width,
            activation=config.activation,
            gain=config.gain,
            small_output=True,
            precision="highest",
        )
        for name, outputs in ({"coupled": 7} if config.coupled else _OUTPUTS).items()
    }

    def init(key):
        keys = jax.random.split(key, len(networks))
        params = {name: networks[name].init(k) for name, k in zip(networks, keys, strict=True)}
        return params if config.window is None else params | {"progress": jnp.zeros(())}

    def pose(params, t):
        tau = (t - (first + last) / 2) * (2 / (last - first))
        weights = None
        if config.window is not None:
            progress = jax.lax.stop_gradient(params["progress"])
            weights = nn.window_weights(progress, config.octaves, config.window)
        features = nn.frequency_encoding(tau[None], config.octaves, weights=weights)
        outputs = {name: network.apply(params[name], features) for name, network in networks.items()}
        if config.coupled:
            outputs = {"translation": outputs["coupled"][:3], "rotation": outputs["coupled"][3:]}
        return _head(config, **outputs)

    return PoseField(init, pose)


def set_progress(params: Params, progress: Float[Array, ""]) -> Params:
    """The parameters of a PoseNet with a coarse-to-fine window, at `progress` in [0, 1] of the training."""
    return params | {"progress": progress}


def stop_rotation(params: Params) -> Params:
    """The same parameters with no gradient to a decoupled PoseNet's rotation network; others as they are.

    For losses on translation alone: differentiating `pose(t)[:3, 3]` takes the zeros that are the rotation's
    gradient all the way back through its network, which doubles the cost of an accelerometer loss.
    """
    if not (isinstance(params, dict) and "rotation" in params):
        return params
    return params | {"rotation": jax.lax.stop_gradient(params["rotation"])}


def _head(
    config: PoseNetConfig, translation: Float[Array, "3"], rotation: Float[Array, "4"]
) -> Float[Array, "4 4"]:
    # The two are never put into one array, so that whoever asks for one does not compute the other.
    if config.head == "paper":
        translation, rotation = jnp.tanh(translation), jnp.tanh(rotation)
        rotation = rotation * jnp.asarray([-1, 1, 1, 1], rotation.dtype)
    quaternion = rotation + jnp.asarray([1, 0, 0, 0], rotation.dtype)
    return se3.make(se3.quaternion_to_rotation(quaternion), config.translation_scale * translation)


def _check(config: PoseNetConfig) -> None:
    if config.span[0] >= config.span[1]:
        raise ValueError(f"span: expected (first, last) seconds with first < last, got {config.span}")
    if config.octaves < 0 or config.layers < 1 or config.width < 1:
        raise ValueError(f"expected octaves >= 0, layers >= 1 and width >= 1, got {config}")
    if config.window is not None and config.window[0] >= config.window[1]:
        raise ValueError(f"window: expected (start, end) with start < end, got {config.window}")
