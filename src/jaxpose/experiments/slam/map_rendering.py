"""A map rendered from poses of its camera."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxpose.datasets.types import Recording
from jaxpose.plots.slam import View
from jaxpose.scenes.voxel_blocks import bounds
from jaxpose.slam import SlamResult
from jaxpose.slam.map.raycast import every, viewer

VIEW_WIDTH = 160  # [px] of rendered pictures, about
_VIEWS = 4


class Rendered(NamedTuple):
    """A frame and the map, at the same pixels."""

    photograph: UInt8[np.ndarray, "height width 3"]  # the whole frame
    frame_rgb: Float[np.ndarray, "h w 3"]  # in [0, 1]
    frame_depth: Float[np.ndarray, "h w"]  # m, 0: none
    rgb: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # m, 0: nothing there


Renderer = Callable[[int], Rendered]


def views(recording: Recording, result: SlamResult, render: Renderer) -> list[View]:
    """A few frames, evenly over the recording, beside the map rendered from their estimated poses."""

    def view(i: int) -> View:
        seen = render(i)
        lost = ", lost" if result.frames.lost[i] else ""
        label = f"t = {recording.t[i]:.2f} s{lost}"
        return View(label, seen.photograph, seen.rgb, seen.frame_depth, seen.depth)

    return [view(i) for i in evenly(np.arange(len(recording.t)), _VIEWS)]


def renderer(recording: Recording, result: SlamResult) -> Renderer:
    """The frame with a given index, and the map as seen from its estimated pose."""
    look = viewer(result.scene, result.map_config.truncation, recording.camera)
    blocks, _ = result.scene_params
    box, pixels = bounds(result.map_config, blocks), every(recording.camera, VIEW_WIDTH)
    column, row = np.moveaxis(pixels, -1, 0)

    @lru_cache(maxsize=32)
    def at(i: int) -> Rendered:
        frame = recording.read(i)
        rgb, depth = look(result.scene_params, box, result.T_world_cam[i], pixels)
        photograph = np.asarray(frame.rgb)
        return Rendered(
            photograph, photograph[row, column] / 255, np.asarray(frame.depth)[row, column], rgb, depth
        )

    return at


def evenly(indices: Int[np.ndarray, " n"], most: int) -> list[int]:
    """Some of the indices, the first and the last among them."""
    places = np.linspace(0, len(indices) - 1, min(most, len(indices)))
    return [int(indices[round(place)]) for place in places]
