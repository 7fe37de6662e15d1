"""What is trained in the noisy-pose experiment: scene, pose field, their rates, by preset and name."""

import warnings
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_splrep

from jaxpose import fields
from jaxpose.experiments.noisy_nerf.options import Config, Problem
from jaxpose.experiments.training_loop import CHUNK
from jaxpose.fields import PoseField, PoseNetConfig
from jaxpose.scenes import NerfConfig, SceneField, nerf
from jaxpose.training.photometric import Depths, TrainConfig, Views, trainer
from jaxpose.training.steps import Rate, Trainer

_FAST_SCENE = NerfConfig(
    layers=4, width=96, skip=2, colour_width=48, octaves=7, window=(0.15, 0.5), quiet=True
)
_SMOKE_SCENE = NerfConfig(layers=2, width=16, skip=None, colour_width=8, octaves=4, window=(0.1, 0.5))
_FAST = TrainConfig(steps=5000, rays=1024, samples=32, chunk=64)
_PAPER = TrainConfig(steps=200_000, rays=4096, samples=128, chunk=32)
_SMOKE = TrainConfig(steps=CHUNK, rays=64, samples=8, chunk=32)
# In short trainings on poses far off: first a blurred scene forms, then the cameras move to where it is seen,
# then they turn. Free at once, they run after a scene that does not exist yet, and do not come back.
_SHIFT_FROM, _TURN_FROM = 0.03, 0.06  # shares of the training
# Parallax alone tells how cameras in one place have turned, and a blurred scene does not show it.
_UNKNOWN_WINDOW = (0.0, 0.05)
# Adam's first and last rate for translation and rotation, by how the training goes.
_NET_RATES = {
    "paper": ((1e-3, 1e-5), (2e-4, 1e-6)),
    "noisy": ((3e-4, 2e-5), (3e-4, 2e-5)),
    "unknown": ((6e-4, 4e-5), (2e-3, 1e-4)),
}
_PER_FRAME_RATES = {  # also of splines; with preset paper BARF's
    "noisy": ((3e-3, 1e-4), (3e-3, 1e-4)),
    "unknown": ((2e-3, 1e-4), (6e-3, 3e-4)),
}
_BARF_SETTLE = {"depth": 1e-3, "disparity": 3e-3}  # BARF's rate of test-time poses, Blender and LLFF


class Model(NamedTuple):
    """A scene and a pose field (camera-to-world), and how to train them."""

    scene: SceneField
    field: PoseField
    scene_rates: Rate
    pose_rates: Any
    train: TrainConfig
    depths: Depths
    views: Views
    trainer: Trainer
    settle_rate: float


def build(config: Config, problem: Problem) -> Model:
    """Scene, pose field and rates that the config names, for these photographs."""
    photographs, paper = problem.train, config.preset == "paper"
    barf = photographs.spacing
    if config.smoke:
        scene, train = nerf(_SMOKE_SCENE), _SMOKE
    else:
        scene, train = (nerf(), _PAPER) if paper else (nerf(_fast_scene(config)), _FAST)
        train = replace(train, steps=config.steps or train.steps, rays=config.rays or train.rays)
    if not paper:
        scene_rates = Rate(1e-3, 1e-4)
    else:
        scene_rates = Rate(5e-4, 1e-4) if barf == "depth" else Rate(1e-3, 1e-4)
    t = jnp.asarray(photographs.t, jnp.float32)
    correction, rates = _field(config, problem)
    start = fields.piecewise_geodesic(t, jnp.asarray(problem.T_start, jnp.float32))
    correct = fields.left_correction if config.side == "world" else fields.right_correction
    field = correct(correction, start)
    depths = Depths(photographs.near, photographs.far, photographs.spacing)
    return Model(
        scene,
        field,
        scene_rates,
        rates,
        train,
        depths,
        Views(t, jnp.asarray(photographs.rgb)),
        trainer(scene, field, photographs.camera, depths, scene_rates, rates, train),
        _BARF_SETTLE[barf],
    )


def splined(
    params: Float[Array, "n 6"], t: Float[np.ndarray, " n"], knots: int, smoothing: float
) -> Float[Array, "n 6"]:
    """Per-frame poses reset to scipy's cubic smoothing spline of each column, the paper's "B-spline".

    The spline has the fewest knots, and at most `knots` inside the span, with which its squared residuals sum
    up to `smoothing`; where that many do not reach it, they are all used.
    """
    degree = 3
    most = min(knots + 2 * (degree + 1), len(t) + degree + 1)  # counting those at the ends
    values = np.asarray(params, np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that the knots do not reach the smoothing
        columns = [
            make_splrep(t, column, k=degree, s=smoothing, nest=most)(t)  # pyright: ignore[reportArgumentType]
            for column in values.T
        ]
    return jnp.asarray(np.stack(columns, axis=-1), params.dtype)


def describe(config: Config, model: Model) -> dict[str, Any]:
    """The settings of a training, in words and numbers."""
    train = asdict(model.train)
    del train["chunk"]
    plain = lambda rates: jax.tree.map(
        lambda rate: [np.unique(part).tolist() for part in rate],
        rates,
        is_leaf=lambda x: isinstance(x, Rate),
    )
    return {
        "pose": config.pose,
        "preset": config.preset,
        "side": config.side,
        **train,
        "net": asdict(config.net) if config.pose == "posenet" else None,
        "spline_knots": config.spline_knots if "spline" in config.pose else None,
        "spline_smoothing": config.spline_smoothing if config.pose == "spline_reset" else None,
        "rates": {"first_last_start": {"scene": plain(model.scene_rates), "pose": plain(model.pose_rates)}},
    }


def _field(config: Config, problem: Problem) -> tuple[PoseField, Any]:
    """The correction of the poses by itself, and its rates."""
    photographs, paper = problem.train, config.preset == "paper"
    span = (float(photographs.t[0]), float(photographs.t[-1]))
    shift_from, turn_from = (0.0, 0.0) if paper else (_SHIFT_FROM, _TURN_FROM)
    start = "unknown" if config.noise == "unknown" else "noisy"
    if config.pose == "posenet":
        # tanh bounds the translation: half the cameras' extent, or, where nothing is known of them, the
        # nearest depth, which is the unit of LLFF's scenes.
        scale = photographs.near if config.noise == "unknown" else problem.extent / 2
        net = replace(config.net, layers=2, width=32) if config.smoke else config.net
        posenet = PoseNetConfig(span=span, translation_scale=scale, **asdict(net))
        shift, turn = _NET_RATES["paper" if paper else start]
        rates = {"translation": Rate(*shift, shift_from), "rotation": Rate(*turn, turn_from)}
        if config.net.coupled:
            rates = {"coupled": rates["rotation"]}
        rates = rates if config.net.window is None else rates | {"progress": Rate(1.0, 1.0)}
        return fields.posenet(posenet), rates
    if paper:
        shift = turn = (3e-3 if photographs.spacing == "disparity" else 1e-3, 1e-5)
    else:
        shift, turn = _PER_FRAME_RATES[start]
    if config.pose == "bspline":
        field, columns = fields.bspline(span, config.spline_knots), (3, 4)
    else:
        field, columns = fields.per_frame_poses(photographs.t), (3, 3)
    pairs = zip((*shift, shift_from), (*turn, turn_from), strict=True)
    return field, Rate(*(np.repeat(pair, columns)[None] for pair in pairs))


def _fast_scene(config: Config) -> NerfConfig:
    return replace(_FAST_SCENE, window=_UNKNOWN_WINDOW) if config.noise == "unknown" else _FAST_SCENE
