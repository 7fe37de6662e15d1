"""Bundle adjustment of cameras that measure depth too, beside what is known of their motions.

Errors of reprojection, of those that are aligned and of others, and of inverse depth: each kind in units of
its own spread, which is measured at every step, in the robust loss of Geman and McClure (1985) by reweighted
least squares. What motions say of their errors is believed up to a factor: what they disagree with the rest
by, over what they would if it were right (a variance component; Helmert 1907). Steps are Gauss-Newton's, with
the points eliminated.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import SuperLU, splu

from jaxpose._checks import check_finite, check_shapes
from jaxpose.estimate.pose_graph import Edges, normal_equations, squared_distances
from jaxpose.geometry import rigid
from jaxpose.structure import schur
from jaxpose.structure.relative import MEDIAN_LENGTH, SIGMA_OF_MEDIAN, sums
from jaxpose.structure.schur import System, eliminate_points
from jaxpose.structure.tracks import Tracks

_OUTLIER = 3.0  # sigmas
_LEAST_PX, _LEAST_DEPTH = 0.05, 1e-4  # [px, 1/m] of a spread
_STEPS, _SETTLED = 25, 2e-5  # at most so many, and the step [m, rad] below which there are no more
_FIRST = 2  # steps by motions as they are stated
_PROBES = 16  # random vectors by which a trace is measured
_LARGE = 9.0  # times the usual squared disagreement: more is no error of the same kind
_DAMPING = 1e-6  # that keeps what nothing observes where it is
_NEAREST = 0.05  # [m] in front of a camera


class _Observations(NamedTuple):
    """What is seen of the points that some view has measured the depth of, in order of the views."""

    view: Int[np.ndarray, " o"]
    point: Int[np.ndarray, " o"]
    xy: Float[np.ndarray, "o 2"]
    depth: Float[np.ndarray, " o"]  # [m]; 0 where there is none
    kind: Int[np.ndarray, " o"]  # 1: aligned
    by_view: csr_matrix  # (n, o), sums over the observations of each view
    by_point: csr_matrix  # (m, o)


class Adjusted(NamedTuple):
    """Camera-to-world poses, and how sure they and the motion from each to the next are.

    Covariances are of right increments [m, rad], of the later pose for a motion; the first pose is as it is.
    """

    T_world_cam: Float[np.ndarray, "n 4 4"]
    covariance: Float[np.ndarray, "n 6 6"]
    motion_covariance: Float[np.ndarray, "k 6 6"]


def adjust_measured(
    tracks: Tracks, depth: Float[np.ndarray, " o"], T_start: Float[np.ndarray, "n 4 4"], motions: Edges
) -> Adjusted:
    """Find the poses that agree best with shared points, measured depths and motions, the first as it is.

    Args:
        tracks: What views share.
        depth: Along the optical axis, of every observation [m]; 0 where none was measured.
        T_start: Camera-to-world poses (n, 4, 4), near the right ones.
        motions: From each view to the next, with information up to a factor.

    Returns:
        Camera-to-world poses [m], and covariances of poses and motions by the spread of all errors.

    Raises:
        ValueError: For depths or poses of another number or shape, or not finite.
    """
    check_shapes(T_start=(T_start, f"{tracks.views} 4 4"), depth=(depth, f"{len(tracks.view)}"))
    check_finite(T_start=T_start, depth=depth)
    seen, generator = _measured(tracks, depth), np.random.default_rng(0)
    if not len(seen.view):
        T, of_motions = np.array(T_start, np.float64), np.linalg.inv(motions.information)
        by_world = np.cumsum(rigid.carried(T[1:], of_motions), axis=0)
        summed = np.concatenate([np.zeros((1, 6, 6)), rigid.carried(rigid.inverse(T[1:]), by_world)])
        return Adjusted(T, summed, of_motions)
    T, points = np.array(T_start, np.float64), _start_points(seen, T_start)
    weight = np.ones(len(motions.a))
    for index in range(_STEPS):
        system = _normal_equations(seen, T, points, tracks.focal)
        reduced = eliminate_points(system, seen.by_view.indptr, seen.point, _DAMPING)
        tied, down = normal_equations(T, motions, weight)
        solver = splu(csc_matrix(reduced.matrix + tied)[6:, 6:])
        twist = np.zeros((len(T), 6))
        twist[1:] = -solver.solve((reduced.by_view + down)[6:]).reshape(-1, 6)
        T, points = T @ rigid.exp(twist), points + reduced.shift(twist)
        if np.abs(twist).max() < _SETTLED:
            break
        if index >= _FIRST:
            weight[:] = _factor(squared_distances(T, motions), tied[6:, 6:], solver, generator)
    T[:, :3, :3] = rigid.nearest_rotation(T[:, :3, :3])
    return Adjusted(T, *_covariances(T, solver))


def _factor(chi2: Float[np.ndarray, " m"], tied: csc_matrix, solver: SuperLU, generator: np.random.Generator):
    """What the motions' information is to be multiplied by, so that they disagree as much as it says."""
    probe = generator.choice([-1.0, 1.0], (6 * len(chi2), _PROBES))  # Hutchinson 1989
    taken = float(np.mean(np.sum(probe * (tied @ solver.solve(probe)), axis=0)))
    left = max(6 * len(chi2) - taken, 1.0)
    return left / max(float(np.minimum(chi2, _LARGE * np.median(chi2)).sum()), 1e-9)


def _covariances(
    T: Float[np.ndarray, "n 4 4"], solver: SuperLU
) -> tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "k 6 6"]]:
    """Of each pose and of the motion from each to the next, the first pose being fixed."""
    size = 6 * (len(T) - 1)
    to_later = -rigid.adjoint(rigid.inverse(T[1:]) @ T[:-1])
    of_poses, of_motions = np.zeros((len(T), 6, 6)), np.zeros((len(T) - 1, 6, 6))
    for k, by_before in enumerate(to_later):
        unit = np.zeros((size, 6))
        unit[6 * k : 6 * k + 6] = np.eye(6)
        column = np.concatenate([np.zeros((6, 6)), solver.solve(unit)])  # of the first pose: zeros
        across, own = column[6 * k : 6 * k + 6], column[6 * k + 6 : 6 * k + 12]
        both = by_before @ across
        of_motions[k] = by_before @ of_poses[k] @ by_before.T + own + both + both.T
        of_poses[k + 1] = own
    return of_poses, of_motions


def _measured(tracks: Tracks, depth: Float[np.ndarray, " o"]) -> _Observations:
    known = np.bincount(tracks.point, depth > 0, tracks.points) > 0
    kept = np.flatnonzero(known[tracks.point])
    kept = kept[np.argsort(tracks.view[kept], kind="stable")]
    _, point = np.unique(tracks.point[kept], return_inverse=True)
    view, kind = tracks.view[kept], tracks.aligned[kept].astype(int)
    of_view, of_point = sums(view, tracks.views), sums(point, int(point.max(initial=-1)) + 1)
    return _Observations(view, point, tracks.xy_cam[kept], depth[kept], kind, of_view, of_point)


def _start_points(seen: _Observations, T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "m 3"]:
    """Each where the view has it that has measured the middle of its depths."""
    order = np.lexsort((seen.depth, seen.point))
    order = order[seen.depth[order] > 0]
    first = np.searchsorted(seen.point[order], np.arange(seen.point.max(initial=-1) + 2))
    middle = order[(first[:-1] + first[1:]) // 2]
    ray = np.concatenate([seen.xy[middle], np.ones((len(middle), 1))], axis=1)
    return rigid.apply(T[seen.view[middle]], ray * seen.depth[middle, None])


def _normal_equations(
    seen: _Observations, T: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "m 3"], focal: float
) -> System:
    R = T[seen.view, :3, :3]
    point_cam = np.einsum("oji,oj->oi", R, points[seen.point] - T[seen.view, :3, 3])
    z = np.maximum(point_cam[:, 2], _NEAREST)
    off = focal * (point_cam[:, :2] / z[:, None] - seen.xy)
    deep = np.where(seen.depth > 0, (z - seen.depth) / z**2, 0)
    residual = np.concatenate([off, deep[:, None]], axis=1)
    by_cam = np.zeros((len(z), 3, 3))  # of the residual by the point in camera axes
    by_cam[:, 0, 0] = by_cam[:, 1, 1] = focal / z
    by_cam[:, :2, 2] = -focal * point_cam[:, :2] / z[:, None] ** 2
    by_cam[:, 2, 2] = 1 / z**2
    weight = _weights(seen, np.linalg.norm(off, axis=1), deep)
    weight *= (point_cam[:, 2] > _NEAREST)[:, None]
    return schur.normal_equations(by_cam, point_cam, R, residual, weight, (seen.by_view, seen.by_point))


def _weights(
    seen: _Observations, size: Float[np.ndarray, " o"], deep: Float[np.ndarray, " o"]
) -> Float[np.ndarray, "o 3"]:
    """What each residual counts, by the spread of its kind and by how well it agrees."""
    sigma = np.ones(2)
    for kind in (0, 1):
        of_kind = size[seen.kind == kind]
        if len(of_kind):
            sigma[kind] = max(float(np.median(of_kind)) / MEDIAN_LENGTH, _LEAST_PX)
    measured = seen.depth > 0
    spread = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(deep[measured]))), _LEAST_DEPTH)
    robust = lambda error, sigma: 1 / (1 + (error / (_OUTLIER * sigma)) ** 2) ** 2 / sigma**2
    of_place = robust(size, sigma[seen.kind])
    return np.stack([of_place, of_place, np.where(measured, robust(deep, spread), 0)], axis=1)
