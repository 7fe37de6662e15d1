"""The map made anew from frames at the poses that they have by now."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxpose._memory import give_back_zeros
from jaxpose.datasets.types import Frame
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.scenes.voxel_blocks import BlockConfig, Blocks, PoolFull, with_blocks, with_first_rows
from jaxpose.slam.keyframes import FrameReader
from jaxpose.slam.map.backend import allocation_points, grow_to_fit, map_backend
from jaxpose.slam.map.integrate import grown_map
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.observation import to_device
from jaxpose.slam.rolling_shutter import at_first_row
from jaxpose.slam.types import SlamState

_TOGETHER = 16  # frames that room is made for at once
EACH = 2  # frames integrated anew beside each that comes


class Posed(NamedTuple):
    """A frame, what its colours are multiplied by, and where it was taken from."""

    frame: Frame
    exposure: Float[np.ndarray, "3"]
    T_world_cam: Float[np.ndarray, "4 4"]


def rebuilt(
    state: SlamState, chosen: Int[np.ndarray, " k"], read: FrameReader, at_once: int | None = None
) -> SlamState:
    """The run with the map that integrating some of its frames makes, written over the old one.

    Args:
        state: a run that maps by integration. Its map is no longer usable.
        chosen: (k,) which frames, the most needed ones first.
        read: gives them; a few are held at a time.
        at_once: how many to integrate now; the rest is `pending`. None: all.

    Returns:
        The state; nothing is compiled for it, unless it needs more room than before. Where there is none, its
        voxels are twice as wide.
    """
    assert state.map is not None
    begun, earlier = _emptied(state.map.params), state.earlier
    give_back_zeros(begun.values)
    if earlier is not None:
        assert isinstance(state.grid, BlockConfig)
        begun = with_blocks(state.grid, begun, earlier.coords.astype(np.int64))
        begun = with_first_rows(begun, jnp.asarray(earlier.values))
    return resumed(state._replace(map=MapState(begun, ()), pending=chosen), read, at_once)


def resumed(state: SlamState, read: FrameReader, count: int | None = None) -> SlamState:
    """The run with more of the frames integrated that its map still lacks since it was begun anew.

    Args:
        state: a run. Its map is no longer usable, if it lacks any.
        read: gives frames.
        count: how many at most; None: all.

    Returns:
        The state.
    """
    if not len(state.pending):
        return state
    count = len(state.pending) if count is None else count
    left, state = state.pending[:count].tolist(), state._replace(pending=state.pending[count:])
    assert isinstance(state.grid, BlockConfig) and state.map is not None
    made, update = state.map, map_backend(state).update
    while left:
        some, left = [posed(state, read(i), i) for i in left[:_TOGETHER]], left[_TOGETHER:]
        measured = [allocation_points(x.frame, state.camera, x.T_world_cam) for x in some]
        try:
            made = grown_map(state.grid, made, np.concatenate(measured), state.config.map_budget)
        except PoolFull:
            return rebuilt(_coarser(state._replace(map=made)), np.flatnonzero(state.frames.keyframe), read)
        for x in some:
            image = to_device(x.frame)._replace(exposure=jnp.asarray(x.exposure, jnp.float32))
            made = update(made, image, jnp.asarray(x.T_world_cam, jnp.float32))
    return state._replace(map=jax.block_until_ready(made))


def with_room(
    frame: Frame, points: Float[np.ndarray, "n 3"], state: SlamState, read: FrameReader
) -> SlamState:
    """The state with a map that holds what its last frame has measured, coarser if there is no room.

    Args:
        frame: the last one.
        points: world points of it [m].
        state: a run. Its map is no longer usable, if it has to be made anew.
        read: keyframes before.

    Returns:
        The state.

    Raises:
        DataError: where the budget does not hold the first frame.
    """
    try:
        return grow_to_fit(frame, points, state)
    except PoolFull as full:
        keyframes, gb = np.flatnonzero(state.frames.keyframe), full.needed / 1e9
        if not len(keyframes):
            budget = state.config.map_budget_gb
            raise DataError(f"map_budget_gb: expected {gb:.2g} for the first frame, got {budget:g}") from None
    return with_room(frame, points, rebuilt(_coarser(state), keyframes, read), read)


def _coarser(state: SlamState) -> SlamState:
    """The state with voxels twice as wide, which its map does not have yet."""
    assert isinstance(state.grid, BlockConfig)
    if state.earlier is not None:
        used = state.config.map_budget_gb
        raise DataError(f"map_budget_gb: expected more, to go on in the map of an earlier run, got {used:g}")
    grid = BlockConfig(2 * state.grid.voxel, 2 * state.grid.truncation)
    return state._replace(grid=grid, coarser_at=np.append(state.coarser_at, state.frames.count - 1))


@partial(jax.jit, donate_argnums=0)
def _emptied(blocks: Blocks) -> Blocks:
    """The blocks with nothing in them, in the same memory; row 0 is empty space."""
    nothing = jax.tree.map(jnp.zeros_like, blocks)
    return nothing._replace(corner=blocks.corner, count=jnp.ones_like(blocks.count))


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
