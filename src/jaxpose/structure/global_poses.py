"""Poses of photographs from what they share alone: all rotations at once, then all places at once.

Rotations of pairs are averaged (Hartley et al. 2013) by a pose graph that finds out which of them are wrong;
then cameras and points are where rays pass the points closest (one linear problem, after Pan et al. 2024).
"""

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from jaxtyping import Bool, Float
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from jaxpose.estimate.pose_graph import Edges, optimise_pose_graph
from jaxpose.geometry import rigid
from jaxpose.structure.relative import MEDIAN_LENGTH, RelativeRotations, relative_rotations, sums
from jaxpose.structure.tracks import Tracks

_MEDIAN_CHI2 = 2.366  # of three degrees of freedom
_ROUNDS = 6  # of reweighting
_OUTLIER = 3.0  # sigmas
_NEAREST = 0.1  # of the usual distance, below which an error does not count for more


def global_poses(tracks: Tracks) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"]]:
    """Camera poses in a world of their own, by no other knowledge of them.

    Args:
        tracks: What photographs share.

    Returns:
        Camera-to-world poses (n, 4, 4), points at a distance of about 1, and which photographs are tied to
        each other (n,): the most that are by pairs which share enough; others' poses are the identity.
    """
    n = tracks.views
    T, tied = np.tile(np.eye(4), (n, 1, 1)), np.zeros(n, bool)
    pairs = relative_rotations(tracks)
    if len(pairs.a) == 0:
        return T, tied
    _, group = connected_components(sp.coo_matrix((np.ones(len(pairs.a)), (pairs.a, pairs.b)), (n, n)))
    tied = group == np.bincount(group).argmax()
    new = np.cumsum(tied) - 1
    inside, seen = tied[pairs.a], tied[tracks.view]
    pairs = RelativeRotations(
        new[pairs.a[inside]], new[pairs.b[inside]], pairs.R_a_b[inside], pairs.information[inside]
    )
    rotations = _averaged(pairs, int(tied.sum()))
    _, point = np.unique(tracks.point[seen], return_inverse=True)
    inner = tracks._replace(
        view=new[tracks.view[seen]],
        point=point,
        xy_cam=tracks.xy_cam[seen],
        views=int(tied.sum()),
        aligned=tracks.aligned[seen],
    )
    T[tied] = rigid.make(rotations, _places(inner, rotations))
    return T, tied


def _averaged(pairs: RelativeRotations, n: int) -> Float[np.ndarray, "n 3 3"]:
    """The rotations that agree best with those of pairs."""
    still = np.zeros(3)
    T = rigid.make(_along_tree(pairs, n), still)
    information = np.zeros((len(pairs.a), 6, 6))
    information[:, :3, :3] = np.eye(3)  # no pose moves
    scale = 1.0
    for _ in range(2):
        # Errors of the features of a pair are not independent: how much more the rotations are off than by
        # that is seen when they are averaged.
        information[:, 3:, 3:] = pairs.information / scale
        edges = Edges(
            pairs.a, pairs.b, rigid.make(pairs.R_a_b, still), information, np.ones(len(pairs.a), bool)
        )
        graph = optimise_pose_graph(T, edges)
        T, scale = graph.T, scale * max(1.0, float(np.median(graph.chi2)) / _MEDIAN_CHI2)
    return T[:, :3, :3]


def _along_tree(pairs: RelativeRotations, n: int) -> Float[np.ndarray, "n 3 3"]:
    """Rotations chained along the surest pairs."""
    unsure = 1 / np.linalg.eigvalsh(pairs.information)[:, 0]
    tree = minimum_spanning_tree(sp.csr_matrix((unsure, (pairs.a, pairs.b)), (n, n)))
    between = {}
    for a, b, R in zip(pairs.a.tolist(), pairs.b.tolist(), pairs.R_a_b, strict=True):
        between[a, b], between[b, a] = R, R.T
    order, before = breadth_first_order(tree, 0, directed=False)
    R = np.tile(np.eye(3), (n, 1, 1))
    for view in order[1:].tolist():
        R[view] = R[before[view]] @ between[int(before[view]), view]
    return R


def _places(tracks: Tracks, R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Camera centres for which rays to the same point meet best, by angles; points are about 1 away."""
    n, m, view, point = tracks.views, tracks.points, tracks.view, tracks.point
    ray = np.concatenate([tracks.xy_cam, np.ones((len(view), 1))], axis=1)
    ray = np.einsum("oij,oj->oi", R[view], ray / np.linalg.norm(ray, axis=1, keepdims=True))
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    by_view, by_point = sums(view, n), sums(point, m)
    centre, usual, weight = np.zeros((n, 3)), 1.0, np.ones(len(view))
    for _ in range(_ROUNDS):
        centre, place = _closest(by_view, by_point, point, weight[:, None, None] * across)
        away = place[point] - centre[view]
        along = np.sum(away * ray, axis=1)
        sign = -1.0 if np.median(along) < 0 else 1.0  # the problem knows no direction of a ray
        centre, along = sign * centre, sign * along
        usual = float(np.median(np.abs(along)))
        distance = np.maximum(np.abs(along), _NEAREST * usual)
        angle = np.linalg.norm(np.einsum("oij,oj->oi", across, away), axis=1) / distance
        angle[along < 0] = np.inf
        sigma = max(float(np.median(angle)) / MEDIAN_LENGTH, 1e-6)
        weight = (usual / distance) ** 2 / (1 + (angle / (_OUTLIER * sigma)) ** 2) ** 2
    return centre / usual


def _closest(by_view, by_point, point, across) -> tuple[np.ndarray, np.ndarray]:
    """Centres and points of the least sum of squares, by an eigenvector, the points eliminated."""
    n, m = by_view.shape[0], by_point.shape[0]
    total = lambda which: (which @ across.reshape(-1, 9)).reshape(-1, 3, 3)
    of_point = total(by_point)
    size = np.trace(of_point, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(of_point + (1e-9 * size + 1e-30) * np.eye(3))
    _, order = by_view.nonzero()  # observations, view by view
    starts = by_view.indptr
    sparse = lambda blocks: sp.bsr_matrix((blocks[order], point[order], starts), (3 * n, 3 * m))
    both = sparse(across)
    reduced = -(sparse(across @ inverse[point]) @ both.T).toarray()
    place = np.arange(n)
    reduced.reshape(n, 3, n, 3)[place, :, place, :] += total(by_view)
    reduced += np.trace(reduced) / n * np.tile(np.eye(3), (n, n))  # the middle of the cameras is the origin
    _, vector = scipy.linalg.eigh(reduced, subset_by_index=[0, 0])
    centre = np.sqrt(n) * vector[:, 0]
    return centre.reshape(n, 3), np.einsum("mij,mj->mi", inverse, (both.T @ centre).reshape(m, 3))
