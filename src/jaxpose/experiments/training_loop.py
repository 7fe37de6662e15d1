"""What trainings on photographs and on events share: the loop, checkpoints, the run folder, results."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments import devices
from jaxpose.experiments.checks import own_folder
from jaxpose.experiments.devices import Job
from jaxpose.experiments.outcome import Outcome, cost
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.experiments.ranges import check_ranges
from jaxpose.fields import PoseField, set_progress
from jaxpose.files import atomic
from jaxpose.files import checkpoint as checkpoint_file
from jaxpose.files.untrusted import read_json, reading
from jaxpose.nn import Activation
from jaxpose.training.steps import State, Trainer

CHUNK = 100  # steps in one compiled call
COLUMNS = ("step", "loss", "rotation_deg", "translation", "seconds")
_SAVE_EVERY_S = 30.0
_KEPT = "checkpoint.npz", "registration.npz", "sigmas.csv", "results.json"  # of a run that is resumed


@dataclass(frozen=True)
class NetConfig:
    """PoseNet's variants of tables 3 and 12; the defaults are the paper's main network."""

    octaves: int = 5  # of the time encoding; 0: time alone
    layers: int = 8  # of each network, the output layer among them
    width: int = 256  # of the hidden layers
    coupled: bool = False  # one network with 7 outputs
    activation: Activation = "relu"  # of the hidden layers
    window: tuple[float, float] | None = None  # coarse-to-fine on the time encoding, shares of the training


class Trained(NamedTuple):
    """Where a training stands, and how it went there: rows of `COLUMNS`, NaN where it has not been."""

    state: State
    history: Float[np.ndarray, "c 5"]


@runtime_checkable
class _Train(Protocol):
    @property
    def steps(self) -> int: ...


@runtime_checkable
class Model(Protocol):
    """What the models of both experiments have beside their own."""

    @property
    def trainer(self) -> Trainer: ...

    @property
    def train(self) -> _Train: ...


def initial_state(model: Model, seed: int) -> Trained:
    """A training at its start."""
    history = np.full((model.train.steps // CHUNK, len(COLUMNS)), np.nan)
    return Trained(model.trainer.start(jax.random.key(seed)), history)


def train(
    model: Model,
    trained: Trained,
    data: Any,
    errors: Callable[[Any], tuple[float, float]],
    checkpoint: Path,
    on_update: OnUpdate,
    *,
    job: Job,
    precision: devices.Precision,
    label: str,
    describe: Callable[[float, float, float], Mapping[str, str]],
    between: Callable[[State], State] | None = None,
) -> Trained:
    """Train to the end, from the checkpoint if there is one, and keep one as it goes.

    Args:
        model: what is trained, and its trainer.
        trained: where it starts.
        data: what the trainer takes.
        errors: rotation [deg] and translation error of the pose field's parameters.
        checkpoint: the file of it, which process 0 reads and writes.
        on_update: called after every chunk of steps.
        job: the devices that rays are spread over.
        precision: of the products of the scene's networks.
        label: of this run among others; empty: it is the only one.
        describe: loss, rotation and translation error in words.
        between: changes the state after every chunk.

    Returns:
        Where the training ended, on one device.

    Raises:
        DataError: where the loss is no longer a number, where a step does not fit the device, and where
            another process is lost.
    """
    phase = " ".join(("training", label)).strip()
    on_update(Update(f"compiling the {phase}"))
    if job.writes and checkpoint.exists():
        trained = _checked(checkpoint, checkpoint_file.load(checkpoint, trained))
    started = time.perf_counter()
    with devices.guarded(job):
        state = devices.on_all(job, devices.from_first(job, trained.state))
        data, history = devices.on_all(job, data), trained.history.copy()
        with devices.spread_over(job, precision):
            advance = model.trainer.advance.lower(state, data, CHUNK).compile()
        devices.check_memory(advance)
        done = int(state.step) // CHUNK
        before = history[done - 1, -1] if done else 0.0
        saved = time.perf_counter()
        for chunk in range(done, len(history)):
            state, losses = advance(state, data)
            if between is not None:
                state = devices.on_all(job, between(devices.on_one(state)))
            step, loss = (chunk + 1) * CHUNK, float(devices.on_one(losses).mean())
            if not np.isfinite(loss):
                raise DataError(f"step {step}: expected a finite loss, got {loss}")
            found = errors(devices.on_one(state.pose))
            now = time.perf_counter()
            history[chunk] = (step, loss, *found, before + now - started)
            if job.writes and (now - saved > _SAVE_EVERY_S or chunk + 1 == len(history)):
                checkpoint_file.save(checkpoint, Trained(devices.on_one(state), history))
                saved = now
            on_update(Update(phase, step, model.train.steps, state=describe(loss, *found)))
        return Trained(devices.on_one(state), history)


def set_up_run_folder(folder: Path, config: Any, settings: dict[str, Any]) -> None:
    """Leave in the folder the config, and earlier results only if they are this run's and to be kept.

    Args:
        folder: the run folder.
        config: of the run.
        settings: what its results depend on.

    Raises:
        DataError: for the folder of another run, or of none.
    """
    stored = folder / "settings.json"
    settings = json.loads(json.dumps(settings, default=_plain))
    if not own_folder(folder, stored, settings, config.resume, *_KEPT):
        atomic.write_json(stored, settings)
    atomic.write_json(folder / "config.json", config)


def pose_reader(field: PoseField, t: Float[np.ndarray, " n"]) -> Callable[[Any], Float[np.ndarray, "n 4 4"]]:
    """Poses at some times, from the parameters of the field."""
    times = jnp.asarray(t, jnp.float32)
    compiled = jax.jit(lambda params: jax.vmap(field.pose, (None, 0))(params, times))
    return lambda params: np.asarray(compiled(params), np.float64)


def mean_errors(
    estimate: Float[np.ndarray, "n 4 4"], ground_truth: Float[np.ndarray, "n 4 4"]
) -> tuple[float, float]:
    """Mean rotation [deg] and translation error after alignment; NaN where no pose is known."""
    if not np.isfinite(ground_truth).any():
        return np.nan, np.nan
    found = trajectory_error.pose_errors(estimate, ground_truth)
    return found.rotation_deg, found.translation


def results_of(
    experiment: str, config: Any, trained: Trained, started: float, **found: Any
) -> dict[str, Any]:
    """What `results.json` of a run holds: what was `found`, and how it was trained and measured."""
    steps, *_, seconds = trained.history[-1]
    return {
        "experiment": experiment,
        "seed": config.seed,
        "smoke": config.smoke,
        **found,
        "train_s": seconds,
        "seconds_per_step": seconds / steps,
        "history_columns": COLUMNS,
        "history": trained.history,
        **cost(started),
    }


def write_study(
    folder: Path, experiment: str, config: Any, runs: dict[str, dict[str, Any]], table: str, started: float
) -> Outcome:
    """Leave in the folder what runs side by side have found."""
    whole = {
        "experiment": experiment,
        "study": config.study,
        "seed": config.seed,
        "smoke": config.smoke,
        "runs": runs,
        **cost(started),
    }
    atomic.write_json(folder / "config.json", config)
    atomic.write_text(folder / "table.md", table + "\n")
    atomic.write_json(folder / "results.json", whole)
    return Outcome(folder, whole)


P = TypeVar("P")
M = TypeVar("M", bound=Model)


@dataclass(frozen=True)
class Loaded(Generic[P, M]):
    """A finished run: `model.field.pose(state.pose, t)` is the camera's pose at any time [s], and
    `model.scene.query(state.scene, point, direction)` the density and colour of the scene."""

    problem: P
    model: M
    state: State


def load_run(
    folder: Path | str,
    config_type: type[Any],
    load: Callable[[Any], P],
    build: Callable[[Any, P], M],
) -> Loaded[P, M]:
    """The scene and the trajectory that a run has left in its folder; its data are read again.

    Args:
        folder: the run folder.
        config_type: the config of its experiment.
        load: reads the data that a config names.
        build: the model for them.

    Returns:
        Data, model and its trained state.

    Raises:
        DataError, OSError: for a folder that holds no run.
    """
    stored = Path(folder) / "settings.json"
    settings = read_json(stored, "the settings of a run")
    with reading(stored, "the settings of a run"):
        net, window = settings["net"], settings["net"]["window"]
        net = NetConfig(**net | {"window": window and tuple(window)})
        config = config_type(**settings | {"data": Path(settings["data"]), "net": net})
        check_ranges(config)
    problem = load(config)
    model = build(config, problem)
    checkpoint = Path(folder) / "checkpoint.npz"
    state = _checked(checkpoint, checkpoint_file.load(checkpoint, initial_state(model, config.seed))).state
    scene = set_progress(state.scene, jnp.ones(()))
    return Loaded(problem, model, state._replace(scene=scene))


def _checked(path: Path, trained: Trained) -> Trained:
    """The same; DataError for a training that cannot have stood there."""
    step, last = int(trained.state.step), CHUNK * len(trained.history)
    if not 0 <= step <= last or step % CHUNK:
        raise DataError(f"{path}: expected a step up to {last}, got {step}")
    for leaf in jax.tree.leaves((trained.state.pose, trained.state.scene)):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and not np.isfinite(leaf).all():
            raise DataError(f"{path}: expected finite parameters, got NaN or infinity")
    return trained


def _plain(value: Any) -> Any:
    """A path as text, a nested config as a dict."""
    return str(value) if isinstance(value, Path) else vars(value)
