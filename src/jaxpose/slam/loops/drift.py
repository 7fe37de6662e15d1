"""How well keyframes' places to each other are known: what tracking alone, and loops since, leave open."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from jaxpose.slam.tracking.relocalise import FOUND_SIGMA
from jaxpose.slam.types import SlamState


class Drift(NamedTuple):
    """One sigma of where frames are to the last one."""

    translation: Float[np.ndarray, " k"]  # [m]
    rotation: Float[np.ndarray, " k"]  # [rad]


def motion_sigmas(state: SlamState, chosen: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k-1 2"]:
    """One sigma [m, rad] of the motion from each of some frames to the next of them, as tracked.

    Both were registered to one map, so only what was new in view could drift: a keyframe is made when that is
    one part in ten. What was lost on the way was found again by a search.

    Args:
        state: a run.
        chosen: (k,) frames, in order, registered.

    Returns:
        A row for each of them but the last.
    """
    frames = state.frames
    sigma = np.nan_to_num(frames.sigma[chosen])  # of the first frame nothing is known: it is the origin
    sigma = np.sqrt(1 - state.config.keyframe_overlap) * np.maximum(sigma[:-1], sigma[1:])
    lost = np.cumsum(frames.lost)[chosen]
    return np.where(np.diff(lost)[:, None] > 0, np.maximum(sigma, FOUND_SIGMA), sigma)


def drift_to_last(state: SlamState, chosen: Int[np.ndarray, " k"]) -> Drift:
    """How well each of some frames' place to the last of them is known, by motions and by settled loops.

    Args:
        state: a run.
        chosen: (k,) frames, in order, registered, all keyframes among them.

    Returns:
        One sigma each, along the way by which it is known best; 0 of the last.
    """
    loops, count = state.loops, len(chosen)
    known = loops.believed & (loops.b <= state.settled)
    a, b = (np.searchsorted(chosen, x[known]) for x in (loops.a, loops.b))
    variance = np.diagonal(np.linalg.inv(loops.information[known]), axis1=1, axis2=2)
    of_loops = variance.reshape(-1, 2, 3).max(axis=2)
    metres, radians = np.concatenate([motion_sigmas(state, chosen) ** 2, of_loops]).T
    position = state.frames.T_world_body[chosen, :3, 3]
    first, second = np.concatenate([np.arange(count - 1), a]), np.concatenate([np.arange(1, count), b])
    lever = np.sum((position[first] - position[-1]) ** 2, axis=1)

    def along(variance):
        graph = csr_matrix((np.maximum(variance, 1e-12), (first, second)), (count, count))
        return np.sqrt(dijkstra(graph, directed=False, indices=count - 1))

    return Drift(along(metres + radians * lever), along(radians))


def may_be_doubled(
    state: SlamState, chosen: Int[np.ndarray, " k"], drift: Drift, depth: float
) -> Bool[np.ndarray, " k"]:
    """Whether surfaces `depth` [m] away that one of some frames and the last one see may be mapped twice.

    Args:
        state: a run.
        chosen: (k,) the frames.
        drift: of each to the last.
        depth: how far away [m].

    Returns:
        False where drift could not have moved them by a share of the map's voxel.
    """
    assert state.grid is not None
    off = np.hypot(drift.translation, drift.rotation * depth)
    return off > state.config.loop.drift * state.grid.voxel
