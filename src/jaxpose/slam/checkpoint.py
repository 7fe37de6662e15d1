"""A SLAM run on disk while it goes: its state, to go on from after a kill."""

import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxpose.errors import DataError
from jaxpose.files import checkpoint as checkpoint_file
from jaxpose.scenes import GridConfig
from jaxpose.slam.pipeline import begin
from jaxpose.slam.system import System
from jaxpose.slam.types import SlamState


class _Box(NamedTuple):
    """A grid's size as arrays."""

    lower: np.ndarray
    upper: np.ndarray
    voxel: np.ndarray
    levels: np.ndarray
    truncation: np.ndarray


def save(path: Path | str, state: SlamState) -> None:
    """Write a run's state, whole or not at all."""
    size = state.grid
    box = _Box(*(np.asarray(getattr(size, name)) for name in _Box._fields))
    checkpoint_file.save(path, _as_arrays(state, box))


def load(path: Path | str, system: System) -> SlamState:
    """Read what `save` wrote of a run of this recording and these settings.

    DataError naming the file if it is damaged or of another run.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            box = _Box(*(file[f".grid.{name}"] for name in _Box._fields))
    except (zipfile.BadZipFile, ValueError, EOFError, KeyError) as error:
        raise DataError(f"{path}: expected a checkpoint, got {' '.join(str(error).split())}") from None
    size = GridConfig(
        tuple(box.lower.tolist()),
        tuple(box.upper.tolist()),
        float(box.voxel),
        int(box.levels),
        float(box.truncation),
    )
    state = checkpoint_file.load(path, _as_arrays(begin(system, size), box))
    return state._replace(
        done=int(state.done), far=float(state.far), gyro_bias_sigma=float(state.gyro_bias_sigma), grid=size
    )


def _as_arrays(state: SlamState, box: _Box) -> Any:
    numbers = {name: np.asarray(getattr(state, name)) for name in ("done", "far", "gyro_bias_sigma")}
    return state._replace(**numbers, grid=box)
