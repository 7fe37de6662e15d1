"""A SLAM run on disk while it goes: its state, to go on from after a kill."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files import checkpoint as checkpoint_file
from jaxpose.scenes import GridConfig
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.map.backend import map_backend
from jaxpose.slam.pipeline import begin
from jaxpose.slam.types import SlamState, no_frames

_GRID = ("lower", "upper", "voxel", "levels", "truncation")


def save(path: Path | str, state: SlamState) -> None:
    """Write the state of a recording's run after one or more frames, whole or not at all."""
    assert state.grid is not None
    checkpoint_file.save(path, _as_arrays(state, {name: getattr(state.grid, name) for name in _GRID}))


def load(path: Path | str, recording: Recording, config: SlamConfig) -> SlamState:
    """Read what `save` wrote of a run of this recording and these settings.

    DataError naming the file if it is damaged or of another run.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            size = {name: file[f"['grid']['{name}']"] for name in _GRID}
            frames, keyframes = len(file["['state'].frames.t"]), len(file["['state'].thumbnails"])
            readings = len(file["['state'].imu.t"]) if "['state'].imu.t" in file else None
    except (zipfile.BadZipFile, ValueError, EOFError, KeyError) as error:
        raise DataError(f"{path}: expected a checkpoint, got {' '.join(str(error).split())}") from None
    grid = GridConfig(
        tuple(size["lower"].tolist()),
        tuple(size["upper"].tolist()),
        float(size["voxel"]),
        int(size["levels"]),
        float(size["truncation"]),
    )
    state = begin(recording, config)._replace(
        frames=no_frames(np.zeros(frames)), thumbnails=np.zeros((keyframes, 2, 12, 16)), grid=grid
    )
    if readings is not None and recording.imu is not None:
        state = state._replace(
            imu=type(recording.imu)(*(np.resize(x, (readings, *np.shape(x)[1:])) for x in recording.imu))
        )
    state = state._replace(map=map_backend(state).start())
    state = checkpoint_file.load(path, _as_arrays(state, size))["state"]
    if frames > len(recording.t) or (state.frames.t != recording.t[:frames]).any():
        raise DataError(
            f"{path}: expected a run over frames at the times of {recording.name}, got other times"
        )
    return state._replace(
        config=config,
        grid=grid,
        camera=recording.camera,
        max_depth=float(state.max_depth),
        duration_s=float(state.duration_s),
    )


def _as_arrays(state: SlamState, size: dict[str, Any]) -> dict[str, Any]:
    """What a checkpoint holds: the state but for what the recording and the settings give again."""
    numbers = {name: np.asarray(getattr(state, name)) for name in ("max_depth", "duration_s")}
    motion = state.motion._replace(gyro_bias_sigma=np.asarray(state.motion.gyro_bias_sigma))
    state = state._replace(**numbers, motion=motion, camera=None, config=None, grid=None, images=())
    return {"state": state, "grid": {name: np.asarray(value) for name, value in size.items()}}
