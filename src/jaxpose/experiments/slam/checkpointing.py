"""What a SLAM run leaves in its folder while it goes: a checkpoint and a preview."""

import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.types import Recording
from jaxpose.files import atomic
from jaxpose.plots.preview import preview
from jaxpose.plots.slam import View
from jaxpose.scenes.voxel_blocks import BlockConfig, bounds
from jaxpose.slam import Progress, checkpoint
from jaxpose.slam.map.backend import map_backend, scene_params
from jaxpose.slam.map.raycast import every, viewer
from jaxpose.slam.types import SlamState

SAVE_EVERY_S = 30.0
_PREVIEW_EVERY_S = 5.0
_SHARE = 0.02  # of the time that previews may take
_WIDTH = 80  # [px] of the map in a preview


def checkpoint_callback(
    folder: Path, recording: Recording, settings: dict[str, Any]
) -> Callable[[Progress], None]:
    """A callback that writes the settings once, and checkpoint and preview every few seconds."""
    saved = time.perf_counter()
    next_preview = 0.0

    def keep(progress: Progress) -> None:
        nonlocal saved, next_preview
        if not (folder / "settings.json").exists() or progress.index == 0:
            atomic.write_json(folder / "settings.json", settings)
        if time.perf_counter() - saved > SAVE_EVERY_S:
            checkpoint.save(folder / "checkpoint.npz", progress.state)
            saved = time.perf_counter()
        now, last = time.perf_counter(), progress.index == progress.count - 1
        if now > next_preview or last:
            _preview(folder / "preview.png", recording, progress.state)
            cost = time.perf_counter() - now
            next_preview = time.perf_counter() + max(_PREVIEW_EVERY_S, cost / _SHARE)

    return keep


def _preview(path: Path, recording: Recording, state: SlamState) -> None:
    """The path so far, and the last frame beside the map."""
    frames, i = state.frames, state.frames.count - 1
    assert state.grid is not None and state.map is not None
    T_world_cam = frames.T_world_body[: i + 1] @ state.T_body_cam
    frame, params = recording.read(i), scene_params(state.map)
    if isinstance(state.grid, BlockConfig):
        box = bounds(state.grid, params)
    else:
        box = np.array([state.grid.lower, state.grid.upper])
    pixels = every(recording.camera, _WIDTH)
    column, row = np.moveaxis(pixels, -1, 0)
    scene = map_backend(state).scene
    rgb, depth = _viewer(scene, state.grid.truncation, recording.camera)(params, box, T_world_cam[i], pixels)
    view = View(f"t = {recording.t[i]:.1f} s", frame.rgb, rgb, frame.depth[row, column], depth)
    preview(path, T_world_cam, frames.lost, view)


_viewer = lru_cache(maxsize=1)(viewer)
