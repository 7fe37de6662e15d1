"""PoseNet: a trajectory as a multi-layer perceptron of time (Ma et al. 2024, section 3.1)."""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose import nn
from jaxpose.fields.types import Factor, Params, PoseField, Span, described, float_type, since
from jaxpose.geometry import se3

_OUTPUTS = {"translation": 3, "rotation": 4}
_SPAN, _SCALE = (-1.0, 1.0), 1.0  # of a field that is not fitted


@dataclass(frozen=True)
class PoseNetConfig:
    """The defaults are the paper's main network: two MLPs, 5 octaves, 8 layers of 256, 803,079 parameters."""

    # First and last time [s], mapped to -1 and 1. None: those of the poses for `fields.fit`, else -1 and 1 s.
    span: tuple[float, float] | None = None
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
    # [m] per unit of output. None: what the poses ask for in `fields.fit`, else 1 m.
    translation_scale: float | None = None
    window: tuple[float, float] | None = None  # coarse-to-fine on the encoding, as fractions of the training


def posenet(config: PoseNetConfig = PoseNetConfig()) -> PoseField:  # noqa: B008 - frozen
    """PoseNet as a pose field; the identity (within 2e-4) at init.

    Args:
        config: size, head and span of the network.

    Returns:
        A field whose parameters are a dict of one tree of weights per network, `translation` and `rotation`
        or `coupled`, so that optimisers can give each its own rate. With a `window` there is also
        `progress`, which `set_progress` sets and no gradient reaches.

    Raises:
        ValueError: a configuration that means nothing.

    >>> field = posenet(PoseNetConfig(span=(0.0, 2.0), layers=2, width=8))
    >>> sorted(field.init(jax.random.key(0)))
    ['rotation', 'translation']
    """
    _check(config)
    span = _SPAN if config.span is None else (float(config.span[0]), float(config.span[1]))
    scale = _SCALE if config.translation_scale is None else float(config.translation_scale)
    return described(PoseNet(replace(config, span=span, translation_scale=scale)))


@dataclass(frozen=True)
class PoseNet:
    """The description of `posenet`: its configuration, with nothing left open."""

    config: PoseNetConfig

    @property
    def span(self) -> Span:
        assert self.config.span is not None
        return self.config.span

    @property
    def translation_scale(self) -> float:
        assert self.config.translation_scale is not None
        return self.config.translation_scale

    def init(self, key) -> Params:
        networks = self._networks()
        keys = jax.random.split(key, len(networks))
        params = {name: networks[name].init(k) for name, k in zip(networks, keys, strict=True)}
        return params if self.config.window is None else params | {"progress": jnp.zeros(())}

    def pose(self, params, t):
        config, (first, last) = self.config, self.span
        tau = since((first + last) / 2, t, self.span, float_type(params)) * (2 / (last - first))
        weights = None
        if config.window is not None:
            progress = jax.lax.stop_gradient(params["progress"])
            weights = nn.window_weights(progress, config.octaves, config.window)
        features = nn.frequency_encoding(tau[None], config.octaves, weights=weights)
        outputs = {name: net.apply(params[name], features) for name, net in self._networks().items()}
        if config.coupled:
            outputs = {"translation": outputs["coupled"][:3], "rotation": outputs["coupled"][3:]}
        return _head(config.head, self.translation_scale, **outputs)

    def factors(self, params) -> tuple[Factor, ...]:
        config, weights = self.config, np.ones(self.config.octaves)
        if config.window is not None:
            weights = np.asarray(nn.window_weights(params["progress"], config.octaves, config.window))
        layers = {
            f"{network}.{layer.removeprefix('layer_')}.{name}": np.asarray(value)
            for network in self._networks()
            for layer, arrays in params[network].items()
            for name, value in arrays.items()
        }
        factor = {
            "kind": "posenet",
            "span": np.array(self.span),
            "weights": weights,
            "activation": config.activation,
            "head": config.head,
            "translation_scale": np.float64(self.translation_scale),
        }
        return (factor | layers,)

    def shifted(self, seconds: float) -> "PoseNet":
        return PoseNet(replace(self.config, span=(self.span[0] + seconds, self.span[1] + seconds)))

    def _networks(self) -> dict[str, nn.Network]:
        config = self.config
        return {
            name: nn.mlp(
                1 + 2 * config.octaves,
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


def from_factor(factor: Factor) -> tuple[PoseField, Params]:
    """The field and the parameters that `PoseNet.factors` wrote.

    How the network was initialised (`gain`) and when its bands were to open are not in the file: a `window`
    that was not wholly open comes back as one over all of the training, as far open as it was.
    """
    dtype = jnp.zeros(()).dtype
    params: dict = {}
    for entry, value in factor.items():
        if entry.endswith((".kernel", ".bias")):
            network, layer, name = entry.split(".")
            arrays = params.setdefault(network, {}).setdefault(f"layer_{layer}", {})
            arrays[name] = jnp.asarray(value, dtype)
    network = next(iter(params.values()))
    octaves, is_open = len(factor["weights"]), bool(np.all(factor["weights"] == 1))
    config = PoseNetConfig(
        span=(float(factor["span"][0]), float(factor["span"][1])),
        octaves=octaves,
        layers=len(network),
        width=len(network["layer_0"]["bias"]) if len(network) > 1 else PoseNetConfig.width,
        activation=str(factor["activation"]),  # pyright: ignore[reportArgumentType]
        coupled="coupled" in params,
        head=str(factor["head"]),  # pyright: ignore[reportArgumentType]
        translation_scale=float(factor["translation_scale"]),
        window=None if is_open else (0.0, 1.0),
    )
    if not is_open:
        opened = np.arccos(np.clip(1 - 2 * factor["weights"], -1, 1)) / np.pi
        params["progress"] = jnp.asarray(np.sum(opened) / octaves, dtype)
    return posenet(config), params


def set_progress(params: Params, progress: Float[Array, ""]) -> Params:
    """The parameters of a field or scene with a coarse-to-fine window, at a point of the training.

    Args:
        params: a dict, that of a PoseNet or a scene with a `window`.
        progress: 0 (start of the training) to 1 (end).

    Returns:
        The parameters with `progress` replaced.
    """
    return params | {"progress": progress}


def stop_rotation_gradient(params: Params) -> Params:
    """The same parameters with no gradient to a decoupled PoseNet's rotation network; others as they are.

    For losses on translation alone: differentiating `pose(t)[:3, 3]` takes the zeros that are the rotation's
    gradient all the way back through its network, which doubles the cost of an accelerometer loss.

    Args:
        params: those of any field.

    Returns:
        Parameters of the same values.
    """
    if not (isinstance(params, dict) and "rotation" in params):
        return params
    return params | {"rotation": jax.lax.stop_gradient(params["rotation"])}


def _head(
    head: str, translation_scale: float, translation: Float[Array, "3"], rotation: Float[Array, "4"]
) -> Float[Array, "4 4"]:
    # The two are never put into one array, so that whoever asks for one does not compute the other.
    if head == "paper":
        translation, rotation = jnp.tanh(translation), jnp.tanh(rotation)
        rotation = rotation * jnp.asarray([-1, 1, 1, 1], rotation.dtype)
    quaternion = rotation + jnp.asarray([1, 0, 0, 0], rotation.dtype)
    return se3.make(se3.quaternion_to_rotation(quaternion), translation_scale * translation)


def _check(config: PoseNetConfig) -> None:
    if config.span is not None and not config.span[0] < config.span[1]:
        raise ValueError(f"span: expected (first, last) seconds with first < last, got {config.span}")
    if config.octaves < 0 or config.layers < 1 or config.width < 1:
        raise ValueError(f"expected octaves >= 0, layers >= 1 and width >= 1, got {config}")
    if config.window is not None and config.window[0] >= config.window[1]:
        raise ValueError(f"window: expected (start, end) with start < end, got {config.window}")
    if config.translation_scale is not None and not config.translation_scale > 0:
        raise ValueError(f"translation_scale: expected more than 0 m, got {config.translation_scale}")
