"""The map made anew from all keyframes, at the poses that they have by now."""

import jax.numpy as jnp
import numpy as np

from jaxpose.datasets.types import Frame
from jaxpose.geometry import rigid
from jaxpose.scenes.voxel_blocks import BlockConfig, Blocks, empty_blocks
from jaxpose.slam.keyframes import FrameReader
from jaxpose.slam.map.backend import allocation_points, map_backend
from jaxpose.slam.map.integrate import grown_map
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.observation import to_device
from jaxpose.slam.rolling_shutter import at_first_row
from jaxpose.slam.types import SlamState

_TOGETHER = 16  # keyframes that room is made for at once


def rebuilt_map(state: SlamState, read: FrameReader) -> MapState:
    """The map that integrating all keyframes at their poses makes, in a pool as large as the old one.

    Args:
        state: a run that maps by integration.
        read: keyframes.

    Returns:
        The map; nothing is compiled for it, unless it needs more room than before.
    """
    assert isinstance(state.grid, BlockConfig) and state.map is not None
    old: Blocks = state.map.params
    room = {"capacity": old.values.shape[0], "side": old.table.shape[0]}
    made = MapState(empty_blocks(state.grid, **room), ())
    update, T_world_cam = map_backend(state).update, state.frames.T_world_body @ state.T_body_cam
    keyframes = np.flatnonzero(state.frames.keyframe).tolist()
    for some in (keyframes[k : k + _TOGETHER] for k in range(0, len(keyframes), _TOGETHER)):
        frames = [_global_shutter(state, read(i), i) for i in some]
        measured = [
            allocation_points(f, state.camera, T_world_cam[i]) for f, i in zip(frames, some, strict=True)
        ]
        made = grown_map(state.grid, made, np.concatenate(measured))
        for frame, i in zip(frames, some, strict=True):
            image = to_device(frame)._replace(exposure=jnp.asarray(state.frames.exposure[i], jnp.float32))
            made = update(made, image, jnp.asarray(T_world_cam[i], jnp.float32))
    return made


def _global_shutter(state: SlamState, frame: Frame, i: int) -> Frame:
    """A keyframe with all rows at the first one's time, by the motion around it."""
    if state.config.line_delay_us == 0:
        return frame
    frames, last = state.frames, state.frames.count - 1
    a, b = max(i - 1, 0), min(i + 1, last)
    T_world_cam = frames.T_world_body[[a, b]] @ state.T_body_cam
    twist = rigid.log(rigid.inverse(T_world_cam[0]) @ T_world_cam[1]) / (frames.t[b] - frames.t[a])
    return at_first_row(frame, state.camera, twist, state.config.line_delay_us / 1e6)
