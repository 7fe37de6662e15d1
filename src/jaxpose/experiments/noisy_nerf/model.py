"""What is trained in the noisy-pose experiment: scene, pose field, their rates, by preset and name."""

import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8
from scipy.interpolate import make_splrep

from jaxpose import fields, scenes
from jaxpose.datasets.types import Photographs
from jaxpose.experiments.noisy_nerf.options import ORBIT, Config, Problem
from jaxpose.experiments.noisy_nerf.registration import Registered
from jaxpose.experiments.training_loop import CHUNK
from jaxpose.fields import PoseField, PoseNetConfig
from jaxpose.scenes import NerfConfig, PlanesConfig, SceneField, nerf, with_occupancy
from jaxpose.structure import evenly_exposed
from jaxpose.training.photometric import Depths, Sampler, TrainConfig, Views, importance, trainer
from jaxpose.training.shutter import Shutter, shutter_of, with_shutter
from jaxpose.training.steps import Decay, State, Trainer, adam

_JOINT_SCENE = NerfConfig(
    layers=4, width=96, skip=2, colour_width=48, octaves=7, window=(0.15, 0.5), zero_bands=True
)
_SMOKE_SCENE = NerfConfig(layers=2, width=16, skip=None, colour_width=8, octaves=4, window=(0.1, 0.5))
_JOINT = TrainConfig(steps=5000, rays=1024, samples=32, chunk=64)
_FAST = TrainConfig(steps=4000, rays=1024, samples=24, chunk=1024)
PAPER = TrainConfig(steps=200_000, rays=4096, samples=128, chunk=32)
_SMOKE = TrainConfig(steps=CHUNK, rays=64, samples=8, chunk=32)
# In short trainings on poses far off: first a blurred scene forms, then the cameras move to where it is seen,
# then they turn. Free at once, they run after a scene that does not exist yet, and do not come back.
_SHIFT_FROM, _TURN_FROM = 0.03, 0.06  # shares of the training
# Poses by features stay until there is a scene: for so many rays, and at least this share of the training.
_FORMED_RAYS, _REGISTERED_FROM = 250_000, 0.05
_GRID_RATE, _DECODER_RATE = Decay(1e-2, 1e-3), Decay(2e-3, 2e-4)
# Parallax alone tells how cameras in one place have turned, and a blurred scene does not show it.
_UNKNOWN_WINDOW = (0.0, 0.05)
# Adam's first and last rate for translation and rotation, by how the training goes.
_NET_RATES = {
    "paper": ((1e-3, 1e-5), (2e-4, 1e-6)),
    "noisy": ((3e-4, 2e-5), (3e-4, 2e-5)),
    "unknown": ((6e-4, 4e-5), (2e-3, 1e-4)),
    # Cameras that look one way: colours hardly tell a turn that all share from a tilt of the plane that
    # they stand in. Features do, and the noise of steps as large as an orbit's would take it away.
    "forward": ((3e-6, 3e-7), (3e-6, 3e-7)),
}
_PER_FRAME_RATES = {  # also of splines; with preset paper BARF's
    "noisy": ((3e-3, 1e-4), (3e-3, 1e-4)),
    "unknown": ((2e-3, 1e-4), (6e-3, 3e-4)),
}
_BARF_REFINE = {"depth": 1e-3, "disparity": 3e-3}  # BARF's rate of test-time poses, Blender and LLFF


_INSTANTS = 4  # of an exposure
_SHUTTER_RATE = Decay(1e-2, 1e-3, 0.1)


class Model(NamedTuple):
    """A scene and a pose field (camera-to-world), and how to train them."""

    scene: SceneField
    field: PoseField
    rates: dict[str, Decay]  # of the scene, and of translation and rotation of the pose field
    train: TrainConfig
    depths: Depths
    views: Views
    trainer: Trainer
    shutter: Callable[[Any], Shutter] | None  # from the pose field's parameters
    refine_rate: float  # of the test-time pose refinement
    sampler: Sampler | None = None  # where rays are looked at; None: in equal parts
    between: Callable[[State], State] | None = None  # what is done to the state after every chunk of steps
    varied: bool = False  # whether photographs are exposed differently


class _Preset(NamedTuple):
    """What a preset trains, and how."""

    scene: SceneField
    rates: Any  # a prefix of the scene's parameters, of `Decay`s and zeros
    train: TrainConfig
    sampler: Sampler | None = None
    between: Callable[[State], State] | None = None


def build(config: Config, problem: Problem, registered: Registered | None = None) -> Model:
    """Scene, pose field and rates that the config names, for photographs and their registration, if any."""
    photographs = problem.train
    barf = photographs.spacing
    depths = Depths(photographs.near, photographs.far, barf)
    if registered is None:
        preset = _perceptron(config, problem)
    else:
        depths = depths._replace(near=registered.near, far=registered.far)
        preset = _planes(config, depths, registered)
    train = replace(preset.train, chunk=config.devices.chunk(preset.train.chunk))
    t = jnp.asarray(photographs.t, jnp.float32)
    rates = _rates(config, problem, registered, train)
    field = _corrected(config, problem, registered)
    pose_rates = _pose_rates(config, rates, train.steps)
    shutter = _shutter(config)
    if config.shutter == "estimate":
        field, pose_rates, shutter = _estimated_shutter(config, photographs, field, pose_rates)
    optimizer = adam({"scene": preset.rates, "pose": pose_rates}, train.steps)
    rgb, mask = _exposed_alike(photographs, registered)
    views = Views(t, jnp.asarray(rgb), None if mask is None else jnp.asarray(mask))
    of_scene = preset.rates if isinstance(preset.rates, dict) else {"scene": preset.rates}
    return Model(
        preset.scene,
        field,
        {name: rate for name, rate in of_scene.items() if rate} | rates,
        train,
        depths,
        views,
        trainer(preset.scene, field, photographs.camera, depths, optimizer, train, shutter, preset.sampler),
        shutter,
        _BARF_REFINE[barf],
        preset.sampler,
        preset.between,
        registered is not None and registered.varied,
    )


def _exposed_alike(
    photographs: Photographs, registered: Registered | None
) -> tuple[UInt8[np.ndarray, "n h w 3"], Bool[np.ndarray, "n h w"] | None]:
    """The photographs as if all had been exposed alike, and which pixels count."""
    if registered is None or not registered.varied:
        return photographs.rgb, photographs.mask
    rgb, known = evenly_exposed(photographs.rgb, registered.exposure)
    return rgb, known if photographs.mask is None else known & photographs.mask


def _perceptron(config: Config, problem: Problem) -> _Preset:
    """NeRF's network, which registers photographs by their colours alone."""
    paper = config.preset == "paper"
    if config.smoke:
        scene, train = nerf(_SMOKE_SCENE), _SMOKE
    else:
        scene, train = (nerf(), PAPER) if paper else (nerf(_joint_scene(config)), _JOINT)
        train = replace(train, steps=config.steps or train.steps, rays=config.rays or train.rays)
    rate = Decay(5e-4 if paper and problem.train.spacing == "depth" else 1e-3, 1e-4)
    return _Preset(scene, rate, train)


def _planes(config: Config, depths: Depths, registered: Registered) -> _Preset:
    """Planes and lines, which are sharp soon where poses are nearly right."""
    planes = PlanesConfig(registered.centre, registered.half)
    train = replace(_FAST, steps=config.steps or _FAST.steps, rays=config.rays or _FAST.rays)
    train = replace(train, chunk=train.rays)
    sampler = importance(depths, partial(scenes.occupancy, planes), train.samples)
    emptied = jax.jit(lambda scene: with_occupancy(planes, scene))
    between = lambda state: state._replace(scene=emptied(state.scene))
    rates = {"grids": _GRID_RATE, "decoder": _DECODER_RATE, "occupancy": 0.0, "progress": 0.0}
    return _Preset(scenes.planes(planes), rates, train, sampler, between)


def _corrected(config: Config, problem: Problem, registered: Registered | None) -> PoseField:
    """The poses to start from, and their correction."""
    t, T_start = problem.train.t, problem.T_start
    if registered is not None:
        t, T_start = t[registered.supported], registered.T_world_cam[registered.supported]
    start = fields.piecewise_geodesic(jnp.asarray(t, jnp.float32), jnp.asarray(T_start, jnp.float32))
    correct = fields.left_correction if config.side == "world" else fields.right_correction
    return correct(_correction(config, problem), start)


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
    return {
        "pose": config.pose,
        "preset": config.preset,
        "side": config.side,
        **train,
        "net": asdict(config.net) if config.pose == "posenet" else None,
        "spline_knots": config.spline_knots if "spline" in config.pose else None,
        "spline_smoothing": config.spline_smoothing if config.pose == "spline_reset" else None,
        "rates": {name: rate._asdict() for name, rate in model.rates.items()},
    }


def found_shutter(config: Config, model: Model, pose_params: Any) -> dict[str, Any]:
    """Line delay and exposure that a training has used, and where they are from.

    Args:
        config: Of the run.
        model: Its model.
        pose_params: The trained pose field's parameters.

    Returns:
        `line_delay_us`, `exposure_ms` and `shutter`; zeros where photographs are seen at once.
    """
    shutter = Shutter(0.0, 0.0) if model.shutter is None else model.shutter(pose_params)
    line_delay, exposure = float(shutter.line_delay), abs(float(shutter.exposure))
    return {"shutter": config.shutter, "line_delay_us": 1e6 * line_delay, "exposure_ms": 1e3 * exposure}


def _correction(config: Config, problem: Problem) -> PoseField:
    """The correction of the poses by itself."""
    photographs = problem.train
    span = (float(photographs.t[0]), float(photographs.t[-1]))
    if config.pose == "posenet":
        # tanh bounds the translation: half the cameras' extent, or, where nothing is known of them, the
        # nearest depth, which is the unit of LLFF's scenes.
        scale = photographs.near if config.noise == "unknown" else problem.extent / 2
        net = replace(config.net, layers=2, width=32) if config.smoke else config.net
        posenet = PoseNetConfig(span=span, translation_scale=scale, **asdict(net))
        return fields.posenet(posenet)
    if config.pose == "bspline":
        return fields.bspline(span, config.spline_knots)
    return fields.per_frame_poses(photographs.t)


def _shutter(config: Config) -> Callable[[Any], Shutter] | None:
    """The camera's, as it is known; None: a photograph is seen at once."""
    if config.shutter == "ignore" or not (config.line_delay_us or config.exposure_ms):
        return None
    instants = _INSTANTS if config.exposure_ms else 1
    return lambda params: Shutter(1e-6 * config.line_delay_us, 1e-3 * config.exposure_ms, instants)


def _estimated_shutter(
    config: Config, photographs: Photographs, field: PoseField, pose_rates: Any
) -> tuple[PoseField, Any, Callable[[Any], Shutter]]:
    """The field with a shutter among its parameters, their rates, and where it is among them.

    The units are those in which a readout and an exposure as long as the time between photographs are one.
    """
    between = float(np.median(np.diff(photographs.t)))
    units = between / photographs.camera.height, between
    from_nothing = 0.0, between / 4  # the gradient of an exposure is zero at zero
    given = 1e-6 * config.line_delay_us, 1e-3 * config.exposure_ms or from_nothing[1]
    start = Shutter(*(from_nothing if config.data == ORBIT else given), _INSTANTS)
    both = with_shutter(field, start, units)
    return (
        both,
        {"field": pose_rates, "shutter": _SHUTTER_RATE},
        partial(shutter_of, both, instants=_INSTANTS),
    )


def _rates(
    config: Config, problem: Problem, registered: Registered | None, train: TrainConfig
) -> dict[str, Decay]:
    """Rates of translation and rotation of the pose field."""
    paper = config.preset == "paper"
    start = "unknown" if config.noise == "unknown" else "noisy"
    if config.pose == "posenet":
        shift, turn = _NET_RATES["paper" if paper else start]
    elif paper:
        shift = turn = (3e-3 if problem.train.spacing == "disparity" else 1e-3, 1e-5)
    else:
        shift, turn = _PER_FRAME_RATES[start]
    if registered is not None:
        of_net = _NET_RATES["forward" if problem.train.spacing == "disparity" else "noisy"]
        shift, turn = of_net if config.pose == "posenet" else _PER_FRAME_RATES["noisy"]
        formed = min(max(_FORMED_RAYS / (train.rays * train.steps), _REGISTERED_FROM), 0.5)
        return {"translation": Decay(*shift, formed), "rotation": Decay(*turn, formed)}
    shift_from, turn_from = (0.0, 0.0) if paper else (_SHIFT_FROM, _TURN_FROM)
    return {"translation": Decay(*shift, shift_from), "rotation": Decay(*turn, turn_from)}


def _pose_rates(config: Config, rates: dict[str, Decay], steps: int) -> Any:
    """The rates as a prefix of the pose field's parameters."""
    if config.pose == "posenet":
        of_net = {"coupled": rates["rotation"]} if config.net.coupled else rates
        return of_net if config.net.window is None else of_net | {"progress": 0.0}
    # A row of parameters is a pose: three columns of translation, then those of rotation.
    shift, turn = rates["translation"].schedule(steps), rates["rotation"].schedule(steps)
    columns = np.array([[True] * 3 + [False] * (4 if config.pose == "bspline" else 3)])
    return lambda step: jnp.where(columns, shift(step), turn(step))


def _joint_scene(config: Config) -> NerfConfig:
    return replace(_JOINT_SCENE, window=_UNKNOWN_WINDOW) if config.noise == "unknown" else _JOINT_SCENE
