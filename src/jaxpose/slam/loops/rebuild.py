"""The map made anew from frames at the poses that they have by now."""

from collections.abc import Iterable
from functools import partial
from itertools import islice
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose.datasets.types import Frame
from jaxpose.geometry import rigid
from jaxpose.scenes.voxel_blocks import BlockConfig, Blocks
from jaxpose.slam.map.backend import allocation_points, map_backend
from jaxpose.slam.map.integrate import grown_map
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.observation import to_device
from jaxpose.slam.rolling_shutter import at_first_row
from jaxpose.slam.types import SlamState

_TOGETHER = 16  # frames that room is made for at once


class Posed(NamedTuple):
    """A frame, what its colours are multiplied by, and where it was taken from."""

    frame: Frame
    exposure: Float[np.ndarray, "3"]
    T_world_cam: Float[np.ndarray, "4 4"]


def rebuilt_map(state: SlamState, frames: Iterable[Posed]) -> MapState:
    """The map that integrating some frames makes, written over the old one.

    Args:
        state: a run that maps by integration. Its map is no longer usable.
        frames: what to integrate; a few of them are held at a time.

    Returns:
        The map; nothing is compiled for it, unless it needs more room than before.
    """
    assert isinstance(state.grid, BlockConfig) and state.map is not None
    made, update, left = MapState(_emptied(state.map.params), ()), map_backend(state).update, iter(frames)
    while some := list(islice(left, _TOGETHER)):
        measured = [allocation_points(x.frame, state.camera, x.T_world_cam) for x in some]
        made = grown_map(state.grid, made, np.concatenate(measured))
        for x in some:
            image = to_device(x.frame)._replace(exposure=jnp.asarray(x.exposure, jnp.float32))
            made = update(made, image, jnp.asarray(x.T_world_cam, jnp.float32))
    return made


@partial(jax.jit, donate_argnums=0)
def _emptied(blocks: Blocks) -> Blocks:
    """The blocks with nothing in them, in the same memory; row 0 is empty space."""
    nothing = jax.tree.map(jnp.zeros_like, blocks)
    values = jnp.broadcast_to(blocks.values[:1], blocks.values.shape)
    return nothing._replace(corner=blocks.corner, count=jnp.ones_like(blocks.count), values=values)


def posed(state: SlamState, frame: Frame, i: int) -> Posed:
    """A frame of a run as it is integrated, all rows at the first one's time by the motion around it.

    Args:
        state: a run.
        frame: one of its frames, as read.
        i: which of them.

    Returns:
        The frame with its pose.
    """
    frames = state.frames
    T_world_cam = frames.T_world_body[i] @ state.T_body_cam
    return Posed(_global_shutter(state, frame, i), frames.exposure[i], T_world_cam)


def _global_shutter(state: SlamState, frame: Frame, i: int) -> Frame:
    """A frame with all rows at the first one's time, by the motion around it."""
    if state.config.line_delay_us == 0:
        return frame
    frames, last = state.frames, state.frames.count - 1
    a, b = max(i - 1, 0), min(i + 1, last)
    T_world_cam = frames.T_world_body[[a, b]] @ state.T_body_cam
    twist = rigid.log(rigid.inverse(T_world_cam[0]) @ T_world_cam[1]) / (frames.t[b] - frames.t[a])
    return at_first_row(frame, state.camera, twist, state.config.line_delay_us / 1e6)
