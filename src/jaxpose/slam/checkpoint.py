"""A SLAM run on disk while it goes: its state, to go on from after a kill."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files import checkpoint as checkpoint_file
from jaxpose.files.schema import check_version, numbers, rigid_transforms
from jaxpose.files.untrusted import read_npz, reading
from jaxpose.imu import Imu
from jaxpose.scenes import GridConfig
from jaxpose.scenes.voxel_blocks import BlockConfig, packed, unpacked
from jaxpose.slam.beginning import begin
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.loops.types import no_loops
from jaxpose.slam.map.backend import map_backend
from jaxpose.slam.tracking.features import detect
from jaxpose.slam.types import SlamState, TrackingStatus, no_frames

_NUMBERS = "max_depth", "duration_s", "settled", "imu_offset_s", "passes"  # stored as arrays
_VERSION = 2  # of how a map is stored
_FASTEST = 1e6  # [m/s, rad/s, m]


def save(path: Path | str, state: SlamState) -> None:
    """Write the state of a recording's run after one or more frames, whole or not at all."""
    assert state.grid is not None
    checkpoint_file.save(path, _as_arrays(state, asdict(state.grid)))


def load(path: Path | str, recording: Recording, config: SlamConfig) -> SlamState:
    """Read what `save` wrote of a run of this recording and these settings.

    DataError naming the file if it is damaged or of another run.
    """
    kind = BlockConfig if config.map.method == "fused" else GridConfig
    file = read_npz(path, "a checkpoint")
    check_version(path, {"version": file.get("['version']", "none")}, _VERSION, "a checkpoint")
    with reading(path, "a checkpoint"):
        size = {name: file[f"['grid']['{name}']"].tolist() for name in asdict(kind())}
        count = {name: len(file[f"['state'].{name}"]) for name in ("frames.t", "thumbnails")}
        readings = len(file["['state'].imu.t"]) if "['state'].imu.t" in file else None
        blocks = len(file["['state'].map.params[0]"])
        loops = len(file["['state'].loops.a"])
        coarser, pending = (len(file[f"['state'].{name}"]) for name in ("coarser_at", "pending"))
        size: dict[str, Any] = {k: tuple(x) if isinstance(x, list) else x for k, x in size.items()}
        grid = kind(**size)
    state = begin(recording, config)._replace(
        frames=no_frames(np.zeros(count["frames.t"])),
        thumbnails=np.zeros((count["thumbnails"], 2, 12, 16)),
        keyframe_depths=np.zeros((count["thumbnails"], 12, 16)),
        imu=None if readings is None else Imu(*(np.zeros((readings, *shape)) for shape in ((), (3,), (3,)))),
        loops=no_loops(loops),
        coarser_at=np.zeros(coarser, int),
        pending=np.zeros(pending, int),
        grid=grid,
    )
    state = state._replace(map=map_backend(state).start())
    state = checkpoint_file.restore(path, file, _as_arrays(state, asdict(grid), blocks))["state"]
    if count["frames.t"] > len(recording.t) or (state.frames.t != recording.t[: count["frames.t"]]).any():
        raise DataError(
            f"{path}: expected a run over frames at the times of {recording.name}, got other times"
        )
    _check(path, state)
    if isinstance(grid, BlockConfig):
        state = state._replace(map=state.map._replace(params=unpacked(grid, *state.map.params)))
    if config.uses_features:
        keyframes, last = np.flatnonzero(state.frames.keyframe).tolist(), state.frames.count - 1
        seen = {i: detect(recording.read(i), recording.camera) for i in {*keyframes, last}}
        state = state._replace(features=seen[last], keyframe_features=tuple(seen[i] for i in keyframes))
    return state._replace(
        config=config,
        grid=grid,
        camera=recording.camera,
        max_depth=float(state.max_depth),
        settled=int(state.settled),
        duration_s=float(state.duration_s),
        imu_offset_s=float(state.imu_offset_s),
        passes=int(state.passes),
    )


def _check(path: Path | str, state: SlamState) -> None:
    """DataError for a state that a run cannot have: poses that are none, NaN in what it goes on with."""
    frames, motion = state.frames, state.motion
    rigid_transforms(path, "frames.T_world_body", frames.T_world_body)
    numbers(path, frames._asdict(), "status", (None,), whole=True, least=0, most=max(TrackingStatus))
    rigid_transforms(path, "loops.T_a_b", state.loops.T_a_b)
    for name in ("a", "b"):
        numbers(path, state.loops._asdict(), name, (None,), whole=True, least=0, most=frames.count - 1)
    for name in ("twist", "velocity_body", "gyro_bias", "accelerometer_bias_world"):
        numbers(path, motion._asdict(), name, (None,), least=-_FASTEST, most=_FASTEST)
    numbers(path, state._asdict(), "max_depth", above=0, most=_FASTEST)
    numbers(path, state._asdict(), "imu_offset_s", least=-_FASTEST, most=_FASTEST)
    numbers(path, state._asdict(), "passes", whole=True, least=0, most=1)
    rigid_transforms(path, "T_body_cam", state.T_body_cam[None])
    for name in ("coarser_at", "pending"):
        numbers(path, state._asdict(), name, (None,), whole=True, least=0, most=frames.count - 1)
    numbers(path, state._asdict(), "settled", whole=True, least=0, most=frames.count - 1)
    for leaf in jax.tree.leaves((state.params, state.exposure, state.thumbnails, state.map)):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and not np.isfinite(leaf).all():
            raise DataError(f"{path}: expected a map and a network of finite numbers, got NaN or infinity")


def _as_arrays(state: SlamState, size: dict[str, Any], blocks: int | None = None) -> dict[str, Any]:
    """What a checkpoint holds: the state but for what the recording and the settings give again.

    Of a map of blocks it holds the rows in use; `blocks` makes a place for as many, to read them into.
    """
    assert state.map is not None
    numbers = {name: np.asarray(getattr(state, name)) for name in _NUMBERS}
    motion = state.motion._replace(gyro_bias_sigma=np.asarray(state.motion.gyro_bias_sigma))
    state = state._replace(**numbers, motion=motion, camera=None, config=None, grid=None)
    # The recording gives these again, and the file of an earlier run its map.
    state = state._replace(features=None, keyframe_features=(), images=(), readings=(), earlier=None)
    if state.map is not None and hasattr(state.map.params, "table"):
        rows = packed(state.map.params)
        if blocks is not None:
            rows = tuple(np.zeros((blocks, *x.shape[1:]), x.dtype) for x in rows)
        state = state._replace(map=state.map._replace(params=rows))
    grid = {name: np.asarray(value) for name, value in size.items()}
    return {"version": np.asarray(_VERSION), "state": state, "grid": grid}
