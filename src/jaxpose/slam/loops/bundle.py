"""The end of a run: features of all keyframes, their depths and the motions as tracked, adjusted together.

A frame is registered to what was mapped before it, so that errors add up along the way. Here points that
many keyframes see hold all of them at once, each point moved to where its patch is to a fraction of a pixel.
That takes a camera whose colour and depth belong together. Where depth images fit each other less well at the
poses found than at those tracked, colour is beside the depth or of another time, and what is found is not
to be taken.
"""

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from jaxpose.datasets.types import Frame
from jaxpose.estimate.pose_graph import Edges
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, project_numpy, unproject_numpy
from jaxpose.slam.batch import inflation, own_covariances
from jaxpose.slam.keyframes import FrameReader, overlap
from jaxpose.slam.loops.closure import followed
from jaxpose.slam.loops.rebuild import posed, rebuilt
from jaxpose.slam.loops.types import Proposal
from jaxpose.slam.tracking.features import Features, match
from jaxpose.slam.types import SlamState
from jaxpose.structure.measured import Adjusted, adjust_measured
from jaxpose.structure.patches import align_patches
from jaxpose.structure.tracks import FEWEST, Tracks, joined

_MOST = 500  # keyframes: half a megabyte is held of each
_NEXT, _FAR = 4, 6  # keyframes after each, and others that see the same, that it is matched with
_SHARED = 0.3  # of what a keyframe sees, that another one also sees
_POINTS = 64  # of a keyframe, by which that is found
_OFF = 0.05  # of the image's width, that matches are off by at tracked poses, at most
_OUTLIER = 3.0  # times the usual distance of two keyframes' matches at tracked poses
_INDEPENDENT = 100.0  # observations of a keyframe: errors of depth and of patches go together
_UNKNOWN = 1.0  # [m, rad] sigma of a motion that is not known
_GAPS = 1, 2, 4, 8  # keyframes between two whose depth images are compared
_GRID = 6  # [px] between compared depths
_SAME = 0.1  # of the depth, beyond which two are of different surfaces
_WORSE = 1.1  # times as far apart: what depth says, and features against it


def propose(
    state: SlamState, read: FrameReader, on_keyframe: Callable[[int, int], None] | None = None
) -> Proposal | None:
    """Where features, depths and motions together have the keyframes.

    Args:
        state: a run.
        read: its frames.
        on_keyframe: called with how many images are looked at, and how many are to be.

    Returns:
        Their poses, to be taken where depth agrees; None where too little is shared, and of more than
        500 keyframes.
    """
    keyframes = np.flatnonzero(state.frames.keyframe)
    if not 3 <= len(keyframes) <= _MOST or len(state.keyframe_features) < len(keyframes):
        return None
    T = state.frames.T_world_body[keyframes] @ state.T_body_cam
    counted = _counted(read, 3 * len(keyframes), on_keyframe)

    def image(k: int) -> Frame:
        i = int(keyframes[k])
        return posed(state, counted(i), i).frame

    found = _adjusted(state, keyframes, T, lambda k: image(k).rgb)
    if found is None:
        return None
    apart = _depths_apart(lambda k: image(k).depth, (T, found.T_world_cam), state.camera)
    moved = float(np.linalg.norm(found.T_world_cam[:, :3, 3] - T[:, :3, 3], axis=1).max())
    agrees = apart < _WORSE
    tracked = state.frames.T_world_body @ state.T_body_cam
    larger = 1.0 if agrees else inflation(state.frames, tracked, keyframes, found.T_world_cam)
    return Proposal(
        keyframes,
        found.T_world_cam,
        found.covariance,
        found.motion_covariance,
        moved_max=moved,
        depths_apart=apart,
        agrees=agrees,
        inflation=larger,
    )


def adopt(
    state: SlamState,
    found: Proposal,
    read: FrameReader,
    on_frame: Callable[[int, int], None] | None = None,
) -> SlamState:
    """The run with keyframes where they are proposed, other frames moved with them, and the map made anew.

    Args:
        state: a run that maps by integration. Its map is no longer usable.
        found: what is proposed for it.
        read: its frames.
        on_frame: called with how many frames are integrated anew, and how many are to be.

    Returns:
        The state.
    """
    T = state.frames.T_world_body[found.keyframes] @ state.T_body_cam
    frames = followed(state.frames, found.keyframes, found.T_world_cam @ rigid.inverse(T))
    frames = frames.put(found.keyframes[1:], covariance=found.motion_covariance)
    mapped = np.flatnonzero(frames.mapped)
    return rebuilt(state._replace(frames=frames), mapped, _counted(read, len(mapped), on_frame))


def _counted(read: FrameReader, total: int, on_frame: Callable[[int, int], None] | None) -> FrameReader:
    """What reads frames, and says how many it has begun, and how many there are to be."""
    begun = itertools.count(1)

    def counted(i: int) -> Frame:
        if on_frame is not None:  # a map that has to be coarser is made once more
            on_frame(min(next(begun), total), total)
        return read(i)

    return counted


def _adjusted(
    state: SlamState,
    keyframes: Int[np.ndarray, " k"],
    T: Float[np.ndarray, "k 4 4"],
    image: Callable[[int], np.ndarray],
) -> Adjusted | None:
    """Poses of the keyframes by all that they share; None where that is too little."""
    features, camera = state.keyframe_features[: len(keyframes)], state.camera
    pixel = [project_numpy(camera, each.direction_cam) for each in features]
    matches = []
    for a, b in _pairs(features, T, camera):
        T_b_a = rigid.inverse(T[b]) @ T[a]
        i, j, off = _agreeing((features[a], features[b]), (pixel[a], pixel[b]), T_b_a, camera)
        matches += [(e, a, p, b, q) for e, p, q in zip(off.tolist(), i.tolist(), j.tolist(), strict=True)]
    view, feature, point = joined(sorted(matches), [len(each.depth) for each in features])
    if not len(view):
        return None
    of = lambda values: np.array([values[v][f] for v, f in zip(view, feature, strict=True)], np.float64)
    placed = align_patches(image, view, point, of(pixel))
    xy = unproject_numpy(camera, placed.pixel)[:, :2]
    focal = float(camera.fx + camera.fy) / 2
    tracks = Tracks(view, point, xy, len(T), focal, placed.found)
    found = adjust_measured(tracks, of([each.depth for each in features]), T, _motions(state, keyframes, T))
    together = max(len(view) / len(T) / _INDEPENDENT, 1.0)
    return found._replace(
        covariance=together * found.covariance, motion_covariance=together * found.motion_covariance
    )


def _pairs(features: tuple[Features, ...], T: Float[np.ndarray, "k 4 4"], camera: Camera):
    """Keyframes to match: each with those after it, and with some of all times that see the same."""
    count = len(features)
    pairs = {(a, b) for a in range(count) for b in range(a + 1, min(a + 1 + _NEXT, count))}
    share = np.zeros((count, count))
    for k, each in enumerate(features):
        points = each.points_cam[each.depth > 0]
        if len(points):
            some = points[np.linspace(0, len(points) - 1, min(_POINTS, len(points))).astype(int)]
            share[k] = overlap(rigid.apply(T[k], some), T, camera, margin=0)
    both = np.minimum(share, share.T)
    for k in range(count):
        far = np.flatnonzero((both[k] > _SHARED) & (np.abs(np.arange(count) - k) > _NEXT))
        chosen = far[np.linspace(0, len(far) - 1, min(_FAR, len(far))).astype(int)].tolist()
        pairs |= {(min(k, other), max(k, other)) for other in chosen}
    return sorted(pairs)


def _agreeing(
    features: tuple[Features, Features],
    pixels: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 2"]],
    T_b_a: Float[np.ndarray, "4 4"],
    camera: Camera,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Matches of two keyframes that are about where poses as tracked have them, and how far off [px]."""
    (a, b), (pixel_a, pixel_b) = features, pixels
    i, j = match(a, b)
    off = np.full(len(i), np.inf)
    ways = (a, i, T_b_a, pixel_b[j]), (b, j, rigid.inverse(T_b_a), pixel_a[i])
    for one, row, T, seen in ways:
        there = rigid.apply(T, one.points_cam[row])
        known = (one.depth[row] > 0) & (there[:, 2] > 0)
        apart = np.linalg.norm(project_numpy(camera, there[known]) - seen[known], axis=1)
        off[known] = np.minimum(off[known], apart)
    usual = float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else np.inf
    good = off < _OUTLIER * max(usual, 1.0)
    if usual > _OFF * camera.width or good.sum() < FEWEST:
        good[:] = False
    return i[good], j[good], off[good]


def _motions(state: SlamState, keyframes: Int[np.ndarray, " k"], T: Float[np.ndarray, "k 4 4"]) -> Edges:
    """From keyframe to keyframe as tracked, each with the errors of both beside the map."""
    own = own_covariances(state.frames)[keyframes]
    own[np.isnan(own).any(axis=(1, 2))] = _UNKNOWN**2 * np.eye(6)
    motion = rigid.inverse(T[:-1]) @ T[1:]
    covariance = rigid.carried(rigid.inverse(motion), own[:-1]) + own[1:]
    a = np.arange(len(motion))
    return Edges(a, a + 1, motion, np.linalg.inv(covariance), np.zeros(len(a), bool))


def _depths_apart(
    depth: Callable[[int], np.ndarray], poses: tuple[Float[np.ndarray, "k 4 4"], ...], camera: Camera
) -> float:
    """How many times as far apart depth images are at the second poses as at the first."""
    height, width = camera.height, camera.width
    row, column = (x.ravel() for x in np.mgrid[0:height:_GRID, 0:width:_GRID])
    ray = unproject_numpy(camera, np.stack([column, row], axis=-1).astype(np.float64))
    held, ratios = {}, []
    for b in range(len(poses[0])):
        held[b] = depth(b)
        held.pop(b - max(_GAPS) - 1, None)
        for a in (b - gap for gap in _GAPS if b >= gap):
            z = held[a][row, column].astype(np.float64)
            point = ray[z > 0] * z[z > 0, None]
            before, after = (_apart(point, rigid.inverse(T[b]) @ T[a], held[b], camera) for T in poses)
            both = np.isfinite(before) & np.isfinite(after)
            if both.sum() >= _POINTS:
                ratios.append(np.log(np.median(after[both]) / max(np.median(before[both]), 1e-9)))
    return float(np.exp(np.mean(ratios))) if ratios else np.inf


def _apart(
    point: Float[np.ndarray, "n 3"], T: Float[np.ndarray, "4 4"], depth: np.ndarray, camera: Camera
) -> Float[np.ndarray, " n"]:
    """How far points are from what another image has measured there [1/m]; NaN: another surface, or none."""
    there = rigid.apply(T, point)
    front = np.flatnonzero(there[:, 2] > 0)
    place = project_numpy(camera, there[front])
    within = (
        (place > -0.5).all(axis=1) & (place[:, 0] < camera.width - 0.5) & (place[:, 1] < camera.height - 0.5)
    )
    inside, (column, row) = front[within], np.rint(place[within]).astype(int).T
    z = np.zeros(len(point))
    z[inside] = depth[row, column]
    same = (z > 0) & (np.abs(z - there[:, 2]) < _SAME * there[:, 2])
    return np.where(same, np.abs(z - there[:, 2]) / np.maximum(there[:, 2], 1e-9) ** 2, np.nan)
