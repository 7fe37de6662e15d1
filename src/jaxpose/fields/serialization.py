"""A continuous trajectory as one file, `field.npz`, that `jaxpose.fields.numpy_evaluator` reads without JAX.

The pose at time t is a product of factors, factor 0 . factor 1 . ..., camera-to-world. The file holds

    version     1, that of this description
    span        (2,) the first and last time [s] that the trajectory was made for
    count       how many factors there are; each entry of factor K is named "K." and then
    kind        "posenet", "bspline", "table" or "stamped"

    posenet     span [s], mapped to -1 and 1; weights, one for each octave of the time encoding; activation;
                head ("paper": the seven outputs pass through tanh, and the quaternion's first is turned
                over; "free"); translation_scale; NETWORK.LAYER.kernel and .bias, where NETWORK is translation
                and rotation, or coupled. Where a kernel has more rows than features come in, the encoding is
                appended to them.
    bspline     span [s]; control_points (n, 7): position and quaternion wxyz less (1, 0, 0, 0), the first one
                knot interval before the span
    table       times (n,) [s]; poses (n, 4, 4): that of the nearest timestamp, the earlier of two equally
    near stamped     times (n,) [s]; poses (n, 4, 4): constant twist between timestamps, at rest before and
    after

Other compositions (`fields/composition.py`) are products too: a constant pose is a `piecewise_geodesic` with
one timestamp.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxpose import nn
from jaxpose.fields._posenet import PoseNetConfig
from jaxpose.fields.types import Params
from jaxpose.files.atomic import atomic
from jaxpose.geometry import se3
from jaxpose.geometry.rigid import Similarity

VERSION = 1
Factor = Mapping[str, Any]  # the entries of the file that are named for it


def write_field(
    path: Path | str,
    span: tuple[float, float],
    factors: Sequence[Factor],
    *,
    alignment: Similarity | None = None,
) -> None:
    """Write the product of `factors`, moved by an `alignment` as `metrics.align` moves poses."""
    if alignment is not None:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = alignment.rotation, alignment.translation
        factors = [constant_factor(T), *(_scaled(factor, alignment.scale) for factor in factors)]
    entries = {f"{k}.{name}": value for k, factor in enumerate(factors) for name, value in factor.items()}
    with atomic(path) as temporary:
        np.savez(
            temporary,
            allow_pickle=False,
            version=VERSION,
            span=np.asarray(span, np.float64),
            count=len(factors),
            **entries,
        )


def posenet_factor(config: PoseNetConfig, params: Params) -> Factor:
    """The PoseNet of `fields.posenet(config)` with these parameters."""
    weights = np.ones(config.octaves)
    if config.window is not None:
        weights = np.asarray(nn.window_weights(params["progress"], config.octaves, config.window))
    layers = {
        f"{network}.{layer.removeprefix('layer_')}.{name}": np.asarray(value)
        for network in ("translation", "rotation", "coupled")
        if network in params
        for layer, arrays in params[network].items()
        for name, value in arrays.items()
    }
    return {
        "kind": "posenet",
        "span": np.asarray(config.span, np.float64),
        "weights": weights,
        "activation": config.activation,
        "head": config.head,
        "translation_scale": np.float64(config.translation_scale),
        **layers,
    }


def bspline_factor(span: tuple[float, float], params: Float[Array, "n 7"]) -> Factor:
    """The spline of `fields.bspline(span, n - 3)` with these parameters."""
    return {
        "kind": "bspline",
        "span": np.asarray(span, np.float64),
        "control_points": np.asarray(params),
    }


def per_frame_factor(times: Float[np.ndarray, " n"], params: Float[Array, "n 6"]) -> Factor:
    """The table of `fields.table(times)` with these parameters."""
    return {"kind": "table", "times": np.asarray(times, np.float64), "poses": np.asarray(se3.exp(params))}


def piecewise_geodesic_factor(times: Float[Array, " n"], poses: Float[Array, "n 4 4"]) -> Factor:
    """The motion of `fields.stamped(times, poses)`."""
    return {"kind": "stamped", "times": np.asarray(times), "poses": np.asarray(poses)}


def constant_factor(T: Float[Array | np.ndarray, "4 4"]) -> Factor:
    """A pose that does not move, such as a camera's in the body."""
    return {"kind": "stamped", "times": np.zeros(1), "poses": np.asarray(T)[None]}


def _scaled(factor: Factor, scale: float) -> Factor:
    """The factor with lengths times `scale`; so scaled, a product of factors is scaled as a whole."""
    scaled = dict(factor)
    if "translation_scale" in factor:
        scaled["translation_scale"] = scale * factor["translation_scale"]
    if "control_points" in factor:
        scaled["control_points"] = factor["control_points"] * np.array([scale] * 3 + [1.0] * 4)
    if "poses" in factor:
        scaled["poses"] = np.array(factor["poses"], np.float64)
        scaled["poses"][:, :3, 3] *= scale
    return scaled
