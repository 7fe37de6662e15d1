"""How photographs that share points are turned to each other, pair by pair, and how well that is known.

An essential matrix by RANSAC (Nister 2004; OpenCV's), then the least Sampson errors (Hartley and Zisserman
2004, section 11.4.3) of all pairs at once. Wide pairs fix their rotation well, near ones hardly: a small
turn and a small move shift an image alike.
"""

from typing import NamedTuple

import cv2
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxpose.geometry import rigid
from jaxpose.structure.tracks import FEWEST, OUTLIER_PX, Tracks

_STEPS = 10  # of Gauss-Newton
_FARTHEST = 0.2  # [rad] of a step
_OUTLIER = 3.0  # sigmas
SIGMA_OF_MEDIAN = 1.4826  # of the size of normal errors
MEDIAN_LENGTH = 1.177  # of a vector in the plane, normal in both directions, in sigmas


class RelativeRotations(NamedTuple):
    """Rotations between photographs, `R_a_b`, and their information over right increments [rad]."""

    a: Int[np.ndarray, " p"]
    b: Int[np.ndarray, " p"]
    R_a_b: Float[np.ndarray, "p 3 3"]
    information: Float[np.ndarray, "p 3 3"]


class _Matches(NamedTuple):
    """What two photographs both see, of all pairs: rays of depth 1 in the axes of each."""

    pair: Int[np.ndarray, " k"]
    ray_a: Float[np.ndarray, "k 3"]
    ray_b: Float[np.ndarray, "k 3"]


class _Motions(NamedTuple):
    """The motion of each pair: rotation and the direction of b's centre, in a's axes."""

    R_a_b: Float[np.ndarray, "p 3 3"]
    direction: Float[np.ndarray, "p 3"]


def sums(index: Int[np.ndarray, " o"], count: int) -> sp.csr_matrix:
    """The matrix (count, o) that sums rows of the same index.

    Args:
        index: Of each row, from 0.
        count: How many sums.

    Returns:
        A sparse matrix of ones.
    """
    return sp.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), (count, len(index)))


def relative_rotations(tracks: Tracks) -> RelativeRotations:
    """Rotations between all photographs that share enough points.

    Args:
        tracks: What they share.

    Returns:
        A rotation for each pair that one motion explains, with each photograph's views of at least so many
        points before both cameras.
    """
    a, b, motions, matches = [], [], [], []
    for i, j, x, y in _shared(tracks):
        found = _motion(x, y, OUTLIER_PX / tracks.focal)
        if found is not None:
            R_a_b, direction, kept = found
            a, b = [*a, i], [*b, j]
            motions.append((R_a_b, direction))
            matches.append((np.full(len(kept), len(matches)), x[kept], y[kept]))
    if not motions:
        return RelativeRotations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    pair, x, y = (np.concatenate(each) for each in zip(*matches, strict=True))
    ones = np.ones((len(pair), 1))
    start = _Motions(*(np.stack(each) for each in zip(*motions, strict=True)))
    R_a_b, information = _refined(_Matches(pair, np.hstack([x, ones]), np.hstack([y, ones])), start)
    return RelativeRotations(np.array(a), np.array(b), R_a_b, information)


def _shared(tracks: Tracks):
    """Photographs a and b that share enough points, and where each sees these."""
    n, m = tracks.views, tracks.points
    order = np.lexsort([tracks.point, tracks.view])
    bounds = np.searchsorted(tracks.view[order], np.arange(n + 1))
    rows = [order[low:high] for low, high in zip(bounds[:-1], bounds[1:], strict=True)]
    sees = sp.csr_matrix((np.ones(len(tracks.view)), (tracks.view, tracks.point)), (n, m))
    both = sp.triu(sees @ sees.T, 1).tocsr()
    both.sort_indices()
    both = both.tocoo()
    for i, j, count in zip(both.row.tolist(), both.col.tolist(), both.data, strict=True):
        if count >= FEWEST:
            point = tracks.point
            _, at_i, at_j = np.intersect1d(
                point[rows[i]], point[rows[j]], assume_unique=True, return_indices=True
            )
            yield i, j, tracks.xy_cam[rows[i][at_i]], tracks.xy_cam[rows[j][at_j]]


def _motion(a: Float[np.ndarray, "m 2"], b: Float[np.ndarray, "m 2"], outlier: float):
    """Rotation, direction, and the matches that agree with them; None unless enough do."""
    E, chosen = cv2.findEssentialMat(
        b, a, np.eye(3), method=cv2.USAC_ACCURATE, prob=0.9999, threshold=outlier
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R_a_b, direction, chosen = cv2.recoverPose(E, b, a, np.eye(3), mask=chosen)
    kept = np.flatnonzero(chosen)
    return None if len(kept) < FEWEST else (R_a_b, direction[:, 0], kept)


def _refined(
    matches: _Matches, motions: _Motions
) -> tuple[Float[np.ndarray, "p 3 3"], Float[np.ndarray, "p 3 3"]]:
    """The rotations of least Sampson errors, and their information, the directions eliminated."""
    R, direction = motions
    pair, by_pair = matches.pair, sums(matches.pair, len(R))
    total = lambda x: (by_pair @ x.reshape(len(x), -1)).reshape(-1, *x.shape[1:])
    for step in range(_STEPS + 1):
        turned = np.einsum("oij,oj->oi", R[pair], matches.ray_b)
        line_a = np.cross(direction[pair], turned)  # of b's ray, in a's axes
        line_b = np.einsum("oji,oj->oi", R[pair], np.cross(matches.ray_a, direction[pair]))
        slope = np.sqrt((line_a[:, :2] ** 2).sum(axis=1) + (line_b[:, :2] ** 2).sum(axis=1))
        residual = np.sum(matches.ray_a * line_a, axis=1) / slope
        sideways = _sideways(direction)
        by_rotation = np.cross(matches.ray_b, line_b)
        by_direction = np.einsum("oi,oij->oj", np.cross(turned, matches.ray_a), sideways[pair])
        by = np.concatenate([by_rotation, by_direction], axis=1) / slope[:, None]
        sigma = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(residual))), 1e-9)
        weight = 1 / (1 + (residual / (_OUTLIER * sigma)) ** 2) ** 2
        H = total(weight[:, None, None] * by[:, :, None] * by[:, None])
        H += 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(5)
        if step < _STEPS:
            move = -np.linalg.solve(H, total((weight * residual)[:, None] * by)[..., None])[..., 0]
            length = np.linalg.norm(move, axis=1, keepdims=True)
            move *= np.minimum(1, _FARTHEST / np.maximum(length, 1e-12))
            R = R @ rigid.so3_exp(move[:, :3])
            direction = direction + np.einsum("pij,pj->pi", sideways, move[:, 3:])
            direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    information = H[:, :3, :3] - H[:, :3, 3:] @ np.linalg.solve(H[:, 3:, 3:], H[:, 3:, :3])
    return R, information / sigma**2


def _sideways(direction: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 2"]:
    """Two axes across each direction."""
    one = np.cross(direction, np.eye(3)[np.abs(direction).argmin(axis=1)])
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(direction, one)], axis=-1)
