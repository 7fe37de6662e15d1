"""What a SLAM run leaves in its folder while it goes: a checkpoint and a preview."""

import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.types import Recording
from jaxpose.experiments.slam.map_rendering import Viewer, every, viewer
from jaxpose.files import atomic
from jaxpose.plots.preview import preview
from jaxpose.plots.slam import View
from jaxpose.scenes import GridConfig, grid
from jaxpose.slam import Progress, checkpoint
from jaxpose.slam.map.backend import scene_params
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
    viewers = lru_cache(maxsize=1)(lambda size: viewer(grid(size), size, recording.camera))

    def keep(progress: Progress) -> None:
        nonlocal saved, next_preview
        if not (folder / "settings.json").exists() or progress.index == 0:
            atomic.write_json(folder / "settings.json", settings)
        if time.perf_counter() - saved > SAVE_EVERY_S:
            checkpoint.save(folder / "checkpoint.npz", progress.state)
            saved = time.perf_counter()
        now, last = time.perf_counter(), progress.index == progress.count - 1
        if now > next_preview or last:
            _preview(folder / "preview.png", recording, progress.state, viewers)
            cost = time.perf_counter() - now
            next_preview = time.perf_counter() + max(_PREVIEW_EVERY_S, cost / _SHARE)

    return keep


def _preview(
    path: Path, recording: Recording, state: SlamState, viewers: Callable[[GridConfig], Viewer]
) -> None:
    frames, i = state.frames, state.frames.count - 1
    assert state.grid is not None and state.map is not None
    T_world_cam = frames.T_world_body[: i + 1] @ recording.T_body_cam
    frame = recording.read(i)
    pixels = every(recording.camera, _WIDTH)
    column, row = np.moveaxis(pixels, -1, 0)
    rgb, depth = viewers(state.grid)(scene_params(state.map), T_world_cam[i], pixels)
    view = View(f"t = {recording.t[i]:.1f} s", frame.rgb, rgb, frame.depth[row, column], depth)
    preview(path, T_world_cam, frames.lost[: i + 1], view)
