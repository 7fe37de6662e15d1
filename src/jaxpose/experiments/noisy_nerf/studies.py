"""Runs side by side: the pose fields of table 11, and the ablations of tables 3, 10 and 12."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from jaxpose.experiments.noisy_nerf.options import Config, Pose, Study
from jaxpose.experiments.training_loop import NetConfig

# Label and variant of PoseNet in the order of table 3; c2f opens its bands as BARF opens the scene's.
_ENCODING = {
    "LE-C": NetConfig(octaves=0, coupled=True),
    "sin2-C": NetConfig(octaves=2, coupled=True),
    "sin5-C": NetConfig(octaves=5, coupled=True),
    "sin10-C": NetConfig(octaves=10, coupled=True),
    "sin2-D": NetConfig(octaves=2),
    "sin5-D": NetConfig(octaves=5),
    "sin10-D": NetConfig(octaves=10),
    "sigmoid-D": NetConfig(activation="sigmoid"),
    "sin10-c2f-D": NetConfig(octaves=10, window=(0.1, 0.5)),
}
_SIZE = {
    f"{layers}x{width}": NetConfig(layers=layers, width=width) for layers in (8, 4) for width in (256, 128)
}
_SPLINE = [(25, 1e-3), (25, 1e-2), (25, 1e-1), (25, 1.0), (75, 1e-3), (50, 1e-3)]  # knots and smoothing


def _fields(config: Config) -> dict[str, Config]:
    return {pose: replace(config, pose=pose) for pose in get_args(Pose)}


def _encoding(config: Config) -> dict[str, Config]:
    return {label: replace(config, pose="posenet", net=net) for label, net in _ENCODING.items()}


def _size(config: Config) -> dict[str, Config]:
    return {label: replace(config, pose="posenet", net=net) for label, net in _SIZE.items()}


def _spline(config: Config) -> dict[str, Config]:
    return {
        f"knots{knots}-s{smoothing:g}": replace(
            config, pose="spline_reset", spline_knots=knots, spline_smoothing=smoothing
        )
        for knots, smoothing in _SPLINE
    }


def _ablations(config: Config) -> dict[str, Config]:
    sizes = _size(config)
    del sizes["8x256"]  # it is sin5-D
    return _encoding(config) | sizes | _spline(config)


STUDIES: dict[Study, Callable[[Config], dict[str, Config]]] = {
    "fields": _fields,
    "encoding": _encoding,
    "size": _size,
    "spline": _spline,
    "ablations": _ablations,
}
