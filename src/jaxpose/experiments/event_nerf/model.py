"""What is trained in the event experiment: scene, pose field and their rates, by preset."""

from dataclasses import asdict, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxpose import events, fields
from jaxpose.experiments.event_nerf.options import Config, Problem, on_turntable
from jaxpose.experiments.training_loop import CHUNK
from jaxpose.fields import PoseField, PoseNetConfig
from jaxpose.geometry import rigid
from jaxpose.scenes import NerfConfig, SceneField, nerf
from jaxpose.training import events as event_training
from jaxpose.training.events import EventData, EventTrainConfig
from jaxpose.training.steps import Decay, Trainer, adam

_FAST = EventTrainConfig(steps=3000, events=512, samples=32, chunk=32)
_PAPER = EventTrainConfig(steps=200_000, events=1024, samples=192, chunk=16)
_SMOKE = EventTrainConfig(steps=CHUNK, events=32, samples=8, chunk=32)
_SMOKE_SCENE = NerfConfig(layers=2, width=16, skip=None, colour_width=8, octaves=4, window=(0.1, 0.5))
_FAST_SCENE = NerfConfig(layers=4, width=96, skip=2, colour_width=48, octaves=7, zero_bands=True)


class Preset(NamedTuple):
    """A scene, and Adam's first and last rate and its start for the poses, by what is wrong with them."""

    scene: NerfConfig
    translation: Decay | None  # None: positions stay
    rotation: Decay


_PAPER_PRESET = Preset(NerfConfig(), Decay(2e-4, 2e-6), Decay(5e-5, 5e-7))
_FAST_PRESETS = {
    # Orientations are known: a turn that came as fast as a shift would be taken for one. The scene stays
    # blurred until the cameras are where it is seen.
    "positions": Preset(
        replace(_FAST_SCENE, window=(0.2, 0.7)), Decay(3e-3, 1e-4, 0.03), Decay(1e-6, 1e-7, 0.06)
    ),
    # All positions are known, and the turn that all cameras share is found: what is left is slower to come
    # than a scene that is blurred would have it.
    "axis": Preset(replace(_FAST_SCENE, window=(0.1, 0.5)), None, Decay(1e-6, 1e-7, 0.3)),
    # A short slide is a small angle: turns of its size must come as slowly as it, after the scene.
    "all": Preset(replace(_FAST_SCENE, window=(0.1, 0.5)), Decay(3e-4, 2e-5, 0.3), Decay(1e-6, 1e-7, 0.3)),
}


class Model(NamedTuple):
    """A scene and a pose field (camera-to-world), and how to train them."""

    scene: SceneField
    field: PoseField
    rates: dict[str, Decay]  # of the scene and, where it moves, of the parts of the pose field
    train: EventTrainConfig
    trainer: Trainer
    data: EventData


def build(config: Config, problem: Problem) -> Model:
    """Scene, pose field, rates and data that the config names, for these events."""
    recording, paper = problem.recording, config.preset == "paper"
    plan = _preset(config, problem)
    if config.smoke:
        scene, train = nerf(_SMOKE_SCENE), _SMOKE
    else:
        scene, train = nerf(plan.scene), _PAPER if paper else _FAST
        train = replace(train, steps=config.steps or train.steps, events=config.events or train.events)
    train = replace(train, chunk=config.devices.chunk(train.chunk))
    span = problem.span
    # EventNeRF's windows are up to a twentieth of a turn; a slide is short as it is.
    longest_s = (span[1] - span[0]) / (1 if problem.slides else 20)
    train = replace(
        train,
        loss=config.loss,
        threshold=problem.threshold,
        longest_s=longest_s,
        background=problem.background,
    )
    field, pose_rates = _field(config, problem, plan)
    scene_rate = Decay(5e-4, 5e-4) if paper else Decay(1e-3, 1e-4)
    window = {} if config.pose == "linear" or config.net.window is None else {"progress": 0.0}
    of_pose = {name: rate or 0.0 for name, rate in pose_rates.items()}
    optimizer = adam({"scene": scene_rate, "pose": of_pose | window}, train.steps)
    trainer = event_training.trainer(
        scene, field, recording.camera, problem.depths, span, optimizer, train
    )  # fmt: skip
    return Model(
        scene,
        field,
        {name: rate for name, rate in {"scene": scene_rate, **pose_rates}.items() if rate},
        train,
        trainer,
        _data(problem),
    )


def describe(config: Config, model: Model) -> dict[str, Any]:
    """The settings of a training, in words and numbers."""
    train = asdict(model.train)
    del train["chunk"]
    return {
        "pose": config.pose,
        "preset": config.preset,
        **train,
        "net": asdict(config.net) if config.pose == "posenet" else None,
        "rates": {name: rate._asdict() for name, rate in model.rates.items()},
    }


def _preset(config: Config, problem: Problem) -> Preset:
    if config.preset == "paper":
        return _PAPER_PRESET
    if problem.slides:
        return _FAST_PRESETS["all"]
    return _FAST_PRESETS["axis" if on_turntable(config, problem.recording) else "positions"]


def _field(config: Config, problem: Problem, plan: Preset) -> tuple[PoseField, dict[str, Decay | None]]:
    """The trajectory as a field, and the rates of its parameters."""
    turn = rigid.make(
        Rotation.from_euler("y", problem.turn_deg or 0.0, degrees=True).as_matrix(), np.zeros(3)
    )
    T_turned = problem.start.T @ turn
    initial = fields.piecewise_geodesic(*(jnp.asarray(x, jnp.float32) for x in (problem.start.t, T_turned)))
    if config.pose == "linear":
        return initial, {}
    net = replace(config.net, layers=2, width=32) if config.smoke else config.net
    posenet = PoseNetConfig(span=problem.span, translation_scale=problem.extent / 2, **asdict(net))
    rates: dict[str, Decay | None] = {"translation": plan.translation, "rotation": plan.rotation}
    if config.net.coupled:
        rates = {"coupled": rates["rotation"]}
    # On the camera's side a wrong axis is a constant, and a chord of the circle comes near and goes away.
    return fields.right_correction(fields.posenet(posenet), initial), rates


def _data(problem: Problem) -> EventData:
    """The events within the span, by pixel, on the device."""
    recording, span = problem.recording, problem.span
    width, height = recording.camera.width, recording.camera.height
    inside = (recording.events.t >= span[0]) & (recording.events.t <= span[1])
    streams = events.index_by_pixel(
        events.Events(*(column[inside] for column in recording.events)), height, width
    )
    streams = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32 if np.issubdtype(x.dtype, np.floating) else jnp.int32), streams
    )
    mask = events.mosaic_mask(recording.mosaic, height, width)
    return EventData(streams, jnp.asarray(mask.reshape(-1, 3)))
