"""The end of a run: frames are registered once more, to the map that all of them made.

A frame in doubt was registered beside its place, or not at all: it is looked for between the frames around it
that are in none. Where all frames are asked for, each is registered to what was mapped after it too, and the
map is made anew.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from jaxpose.datasets.types import Frame
from jaxpose.geometry import rigid
from jaxpose.slam.keyframes import FrameReader
from jaxpose.slam.loops.rebuild import posed, rebuilt
from jaxpose.slam.observation import to_device
from jaxpose.slam.tracker import registered_near, registered_status, with_registration
from jaxpose.slam.tracking.register import Tracked
from jaxpose.slam.types import Frames, SlamState

_OFF = 0.02, 0.01  # [m, rad] one sigma of a pose that is in no doubt
_FASTER = 0.1  # [m/s, rad/s] one sigma of the speed between frames that are in none


def refined(
    state: SlamState, read: FrameReader, on_frame: Callable[[int, int], None] | None = None
) -> SlamState:
    """The run after all its frames, with poses and a map that agree.

    Args:
        state: a run that maps by integration. Its map is no longer usable, if all frames are asked for.
        read: its frames.
        on_frame: called with how many are registered, and how many are to be.

    Returns:
        The state. Frames that were in doubt and are found are so no more.
    """
    frames, known = state.frames, np.flatnonzero(~state.frames.doubted)
    everything = state.config.refine == "all"
    chosen = np.arange(1, frames.count) if everything else np.flatnonzero(frames.doubted)
    for done, i in enumerate(chosen.tolist()):
        frames = _again(state, frames, i, known, posed(state, read(i), i).frame)
        if on_frame is not None:
            on_frame(done + 1, len(chosen))
    state = state._replace(frames=frames)
    if not everything:
        return state
    return rebuilt(state, np.flatnonzero(frames.mapped), read)


def _again(state: SlamState, frames: Frames, i: int, known: Int[np.ndarray, " n"], frame: Frame) -> Frames:
    """The frames with one of them registered to the map of `state`, if that is good."""
    guess = _guess(state.frames, i, known)
    if guess is None:
        return frames
    T_world_body, sigma = guess
    tracked = registered_near(state, i, T_world_body, sigma, to_device(frame))
    if not _is_good(state, i, known, tracked):
        return frames
    pose = state.frames.T_world_body[i - 1] @ np.asarray(tracked.T_ref_body, np.float64)
    return with_registration(frames, i, pose, registered_status(state.config.recovery, tracked), tracked)


def _guess(
    frames: Frames, i: int, known: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "2"]] | None:
    """Where a frame may be, and how far off [m, rad] that is: its pose, or between those of known frames."""
    if not frames.doubted[i]:
        return frames.T_world_body[i], np.array(_OFF)
    after = int(np.searchsorted(known, i))
    if after == len(known):
        return None
    a, b, t, T = known[after - 1], known[after], frames.t, frames.T_world_body
    share = (t[i] - t[a]) / (t[b] - t[a])
    between = T[a] @ rigid.exp(share * rigid.log(rigid.inverse(T[a]) @ T[b]))
    return between, np.array(_OFF) + _FASTER * min(t[i] - t[a], t[b] - t[i])


def _is_good(state: SlamState, i: int, known: Int[np.ndarray, " n"], tracked: Tracked) -> bool:
    """Whether a registration explains its frame: as well as before or, of one in doubt, as others are."""
    frames, policy = state.frames, state.config.recovery
    if not np.isfinite(tracked.T_ref_body).all() or not np.isfinite(tracked.loss):
        return False
    usual = lambda values: float(np.nanmedian(values[known]))
    if not frames.doubted[i]:
        return bool(tracked.valid >= state.config.track.minimum_valid)
    return bool(
        tracked.valid > policy.recognised_valid
        and tracked.loss < policy.recognised_loss * max(usual(frames.loss), 1.0)
        and tracked.colour_error < policy.worse_colour * max(usual(frames.colour_error), policy.least_colour)
    )
