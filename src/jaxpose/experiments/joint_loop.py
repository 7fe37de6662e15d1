"""What trainings on photographs and on events share: the loop over chunks of steps, checkpoints, resuming."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose import command, io, io_checkpoint, metrics
from jaxpose.errors import DataError
from jaxpose.fields import PoseField
from jaxpose.nn import Activation
from jaxpose.train import State, Trainer

CHUNK = 100  # steps in one compiled call
COLUMNS = ("step", "loss", "rotation_deg", "translation", "seconds")
_SAVE_EVERY_S = 30.0


@dataclass(frozen=True)
class NetConfig:
    """PoseNet's variants of tables 3 and 12; the defaults are the paper's main network."""

    octaves: int = 5  # of the time encoding; 0: time alone
    layers: int = 8
    width: int = 256
    coupled: bool = False  # one network with 7 outputs
    activation: Activation = "relu"
    window: tuple[float, float] | None = None  # coarse-to-fine on the time encoding, shares of the training


class Trained(NamedTuple):
    """Where a training stands, and how it went there: rows of `COLUMNS`, NaN where it has not been."""

    state: State
    history: Float[np.ndarray, "c 5"]


def fresh(trainer: Trainer, steps: int, seed: int) -> Trained:
    """A training at its start."""
    return Trained(trainer.start(jax.random.key(seed)), np.full((steps // CHUNK, len(COLUMNS)), np.nan))


def train(
    trainer: Trainer,
    trained: Trained,
    data: Any,
    errors: Callable[[Any], tuple[float, float]],
    checkpoint: Path,
    on_row: Callable[[Float[np.ndarray, "5"]], None],
    *,
    between: Callable[[State], State] = lambda state: state,
) -> Trained:
    """Train to the end, from the checkpoint if there is one, and keep one as it goes.

    `errors` gives rotation [deg] and translation errors of the pose field's parameters, `between` changes the
    state after every chunk.
    DataError where the loss is no longer a number.
    """
    if checkpoint.exists():
        trained = io_checkpoint.load(checkpoint, trained)
    state, history = trained.state, trained.history.copy()
    done = int(state.step) // CHUNK
    before = history[done - 1, -1] if done else 0.0
    started = saved = time.perf_counter()
    for chunk in range(done, len(history)):
        state, losses = trainer.advance(state, data, CHUNK)
        state = between(state)
        step, loss = (chunk + 1) * CHUNK, float(losses.mean())
        if not np.isfinite(loss):
            raise DataError(f"step {step}: expected a finite loss, got {loss}")
        found = errors(state.pose)
        now = time.perf_counter()
        history[chunk] = (step, loss, *found, before + now - started)
        if now - saved > _SAVE_EVERY_S or chunk + 1 == len(history):
            io_checkpoint.save(checkpoint, Trained(state, history))
            saved = now
        on_row(history[chunk])
    return Trained(state, history)


def prepare(folder: Path, config: Any, settings: dict[str, Any], *, resume: bool) -> None:
    """Leave in the folder the config, and earlier results only if they are this run's and to be kept."""
    stored = folder / "settings.json"
    settings = json.loads(json.dumps(settings, default=_plain))
    if not command.resumes(folder, stored, settings, resume):
        for name in ("checkpoint.npz", "results.json"):
            (folder / name).unlink(missing_ok=True)
        io.write_json(stored, settings)
    io.write_json(folder / "config.json", config)


def pose_reader(field: PoseField, t: Float[np.ndarray, " n"]) -> Callable[[Any], Float[np.ndarray, "n 4 4"]]:
    """Poses at some times, from the parameters of the field."""
    times = jnp.asarray(t, jnp.float32)
    compiled = jax.jit(lambda params: jax.vmap(field.pose, (None, 0))(params, times))
    return lambda params: np.asarray(compiled(params), np.float64)


def mean_errors(
    estimate: Float[np.ndarray, "n 4 4"], truth: Float[np.ndarray, "n 4 4"]
) -> tuple[float, float]:
    """Mean rotation [deg] and translation error after alignment, as `metrics.pose_errors`."""
    found = metrics.pose_errors(estimate, truth)
    return found.rotation_deg, found.translation


def net_config(settings: dict[str, Any]) -> NetConfig:
    """PoseNet's variant from what `prepare` wrote."""
    window = settings.pop("window")
    return NetConfig(**settings, window=window and tuple(window))


def _plain(value: Any) -> Any:
    """A path as text, a nested config as a dict."""
    return str(value) if isinstance(value, Path) else vars(value)
