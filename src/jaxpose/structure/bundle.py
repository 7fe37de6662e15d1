"""Bundle adjustment: poses and points that agree with what photographs share, whatever poses one starts from.

Reprojection errors in the robust loss of Geman and McClure (1985), minimised by Levenberg-Marquardt with the
points eliminated (Schur complement; Triggs et al. 1999). The loss starts as wide as the errors and narrows to
their noise (graduated non-convexity, Blake and Zisserman 1987), so that wrong matches count less and less.
Two descents, from the given poses and from those that the photographs alone tell: that of less loss counts.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from jaxpose._checks import check_finite, check_shapes
from jaxpose.evaluation.trajectory_error import align, procrustes
from jaxpose.geometry import rigid
from jaxpose.geometry.rigid import Similarity
from jaxpose.structure.global_poses import global_poses
from jaxpose.structure.prior import Prior, stated_prior
from jaxpose.structure.relative import MEDIAN_LENGTH, sums
from jaxpose.structure.schur import System, eliminate_points, normal_equations
from jaxpose.structure.tracks import Tracks
from jaxpose.structure.uncertainty import aligned_covariances, covariances

_OUTLIER = 3.0  # sigmas of reprojection
_FEWEST = 12  # observations that agree, of a photograph whose pose is believed
_FEWEST_TIED = 4  # photographs
_NARROWER = 3.0  # times the loss, from stage to stage
_LEAST_NOISE = 0.05  # [px]
_WIDE = 90  # [%] of the errors at the start, that the loss begins with
_WEIGHINGS, _WEIGHED = 5, 0.05  # at most so many, and the share by which weights have to change
_STEPS, _SETTLED = 15, 1e-3  # of a stage: at most so many, and the share by which its loss has to fall
_NEAREST = 1e-2  # of the usual depth, in front of a camera
_WIDEST = 1e-2  # spread of camera centres, in usual depths, below which they are all in one place
_UNDAMPED = 1e-12
_IN_PLACE = Similarity(1.0, np.eye(3), np.zeros(3))


class Bundle(NamedTuple):
    """Poses and points that agree with what photographs share, in the world of the poses it started from."""

    T_world_cam: Float[np.ndarray, "n 4 4"]  # where `supported`; else as at the start
    supported: Bool[np.ndarray, " n"]  # photographs with enough observations that agree, tied to the others
    points: Float[np.ndarray, "m 3"]  # those seen by supported photographs
    depth: Float[np.ndarray, " k"]  # of every observation that agrees, along the optical axis
    noise_px: float  # sigma of the reprojection errors that agree
    start_agrees: float  # share of the observations that agree, which do with the poses it started from too
    # Of right increments, translation first; NaN where not `supported`, unless their poses were known before.
    covariance: Float[np.ndarray, "n 6 6"]


class _Problem(NamedTuple):
    """Observations, and who sees what as sparse matrices."""

    view: Int[np.ndarray, " o"]  # in order
    point: Int[np.ndarray, " o"]
    xy: Float[np.ndarray, "o 2"]
    aligned: Bool[np.ndarray, " o"]
    weight: Float[np.ndarray, " o"]  # how many times surer than others, in sigmas
    focal: float
    nearest: float  # depth in front of a camera
    by_view: sp.csr_matrix  # (n, o), sums over the observations of each view
    by_point: sp.csr_matrix  # (m, o)
    prior: Prior | None = None


class _Errors(NamedTuple):
    """Reprojection errors, times their weights [px]; infinite behind a camera."""

    point_cam: Float[np.ndarray, "o 3"]
    residual: Float[np.ndarray, "o 2"]
    size: Float[np.ndarray, " o"]


class _Solution(NamedTuple):
    T: Float[np.ndarray, "n 4 4"]
    points: Float[np.ndarray, "m 3"]
    errors: _Errors
    sigma: float


def adjust(
    tracks: Tracks,
    T_start: Float[np.ndarray, "n 4 4"],
    depth: float,
    on_step: Callable[[float, float], None] = lambda sigma, error: None,
    information: Float[np.ndarray, "n 6 6"] | None = None,
) -> Bundle | None:
    """Find the poses that agree with what photographs share, and with what was known of them before.

    Args:
        tracks: What they share.
        T_start: Camera-to-world poses (n, 4, 4) to start from; they may be far off, or all the same.
        depth: Where points are along the optical axis, as far as it is known: it settles the scale if all
            poses start in one place.
        on_step: Called after every stage with the width of the loss and the median error [px].
        information: (n, 6, 6) of `T_start`, over right increments, translation first: how sure each is. They
            then hold the world. None: nothing is known, and the world is where the poses found are closest
            to those at the start.

    Returns:
        Poses and points; None where fewer than half the photographs share enough. Covariances are by the
        spread of the errors that agree, as if these were independent, and where nothing else was known of
        what is left after an alignment of the camera centres.

    Raises:
        ValueError: For poses of another number or shape, or not finite, a depth that is not above 0, and
            information that is not positive definite.
    """
    check_shapes(T_start=(T_start, f"{tracks.views} 4 4"))
    check_finite(T_start=T_start)
    if not depth > 0:
        raise ValueError(f"depth: expected more than 0, got {depth}")
    problem = _problem(tracks, _NEAREST * depth)
    if problem is None:
        return None
    if information is not None:
        problem = problem._replace(prior=stated_prior(T_start, information))
    problem, best = _weighed(problem, _best(problem, T_start, depth, on_step), depth, on_step)
    return _believed(problem, best, T_start, depth)


def _best(
    problem: _Problem,
    T_start: Float[np.ndarray, "n 4 4"],
    depth: float,
    on_step: Callable[[float, float], None],
) -> _Solution:
    """The one of least loss, of the descents from every start."""
    found = [_solution(problem, T, depth, on_step) for T in _starts(problem, T_start, depth)]
    width = _OUTLIER * min(each.sigma for each in found)
    return min(found, key=lambda each: _loss(problem, each.T, each.errors, width))


def _believed(
    problem: _Problem, best: _Solution, T_start: Float[np.ndarray, "n 4 4"], depth: float
) -> Bundle | None:
    """What of a solution enough observations agree with, in the world of the start."""
    T, points, errors, sigma = best
    agree = errors.size < _OUTLIER * sigma
    supported = np.asarray(problem.by_view @ agree.astype(np.float64)) >= _FEWEST
    if supported.sum() < max(_FEWEST_TIED, len(T) / 2):
        return None
    covariance = _covariances(problem, best, supported)
    to_start = _IN_PLACE
    if problem.prior is None:
        to_start = _gauge(T[supported], T_start[supported], errors.point_cam[agree, 2], depth)
        covariance[:, :3] *= to_start.scale
        covariance[:, :, :3] *= to_start.scale
    moved = np.where(supported[:, None, None], align(to_start, T), T_start)
    agree &= supported[problem.view]
    seen = np.unique(problem.point[agree])
    place = to_start.apply(points[seen])
    depths = to_start.scale * errors.point_cam[agree, 2]
    right = _of_some(_tracks(problem, len(T)), np.flatnonzero(agree), problem.nearest)
    right = right._replace(weight=problem.weight[agree])
    at_start = _reproject(right, T_start, _start_points(right, T_start, depth)).size
    size = errors.size[agree]
    noise = sigma * float(np.median(size / problem.weight[agree]) / max(np.median(size), 1e-12))
    start_agrees = float(np.mean(at_start < _OUTLIER * sigma))
    return Bundle(moved, supported, place, depths, noise, start_agrees, covariance)


def _solution(
    problem: _Problem,
    T: Float[np.ndarray, "n 4 4"],
    depth: float,
    on_step: Callable[[float, float], None],
) -> _Solution:
    """Descents of narrower and narrower losses, down to the noise."""
    points = _start_points(problem, T, depth)
    size = _reproject(problem, T, points).size
    size = np.where(np.isfinite(size), size, problem.focal)
    sigma = max(float(np.percentile(size, _WIDE)), _LEAST_NOISE)
    while True:
        T, points, errors = _stage(problem, T, points, sigma)
        median = float(np.median(errors.size))
        on_step(sigma, median)
        narrower = max(sigma / _NARROWER, median / MEDIAN_LENGTH, _LEAST_NOISE)
        if narrower > 0.9 * sigma:
            return _Solution(T, points, errors, sigma)
        sigma = narrower


def _weighed(
    problem: _Problem, solution: _Solution, depth: float, on_step: Callable[[float, float], None]
) -> tuple[_Problem, _Solution]:
    """The same where aligned observations count as they are surer, until both agree."""
    for _ in range(_WEIGHINGS):
        weight = _weights(problem, solution)
        if np.allclose(weight, problem.weight, rtol=_WEIGHED):
            break
        problem = problem._replace(weight=weight)
        solution = _solution(problem, solution.T, depth, on_step)
    return problem, solution


def _weights(problem: _Problem, solution: _Solution) -> Float[np.ndarray, " o"]:
    """How sure aligned observations are beside others, by the median errors of both that agree."""
    agree = solution.errors.size < _OUTLIER * solution.sigma
    # What a point's own three numbers have taken off its errors: the more, the fewer tell where it is.
    square = problem.weight**2 * agree
    share = square / np.maximum((problem.by_point @ square)[problem.point], 1e-12)
    left = np.sqrt(np.maximum(1 - 1.5 * share, 0.25))
    size = solution.errors.size / problem.weight / left
    aligned, others = (size[agree & which] for which in (problem.aligned, ~problem.aligned))
    if min(len(aligned), len(others)) < _FEWEST:
        return np.ones(len(size))
    ratio = np.median(others) / max(float(np.median(aligned)), _LEAST_NOISE / 4)
    return np.where(problem.aligned, ratio, 1.0)


def _apart(T: Float[np.ndarray, "n 4 4"], depth: float) -> bool:
    """Whether cameras are in places apart."""
    centre = T[:, :3, 3]
    return float(np.linalg.norm(centre - centre.mean(axis=0), axis=1).mean()) > _WIDEST * depth


def _problem(tracks: Tracks, nearest: float) -> _Problem | None:
    """The observations of the most photographs that hang together; None where there are none."""
    n, m = tracks.views, tracks.points
    if m == 0:
        return None
    one = np.ones(len(tracks.view))
    seen = sp.coo_matrix((one, (tracks.view, n + tracks.point)), (n + m, n + m))
    _, group = connected_components(seen, directed=False)
    kept = group[tracks.view] == np.bincount(group[:n]).argmax()
    kept = np.flatnonzero(kept)[np.argsort(tracks.view[kept], kind="stable")]
    return _of_some(tracks, kept, nearest) if len(kept) else None


def _of_some(tracks: Tracks, kept: np.ndarray, nearest: float) -> _Problem:
    """Some of the observations, in order of their views; points are numbered anew."""
    view, (_, point) = tracks.view[kept], np.unique(tracks.point[kept], return_inverse=True)
    by_view, by_point = sums(view, tracks.views), sums(point, int(point.max()) + 1)
    aligned, weight = tracks.aligned[kept], np.ones(len(kept))
    xy, focal = tracks.xy_cam[kept], tracks.focal
    return _Problem(view, point, xy, aligned, weight, focal, nearest, by_view, by_point)


def _tracks(problem: _Problem, views: int) -> Tracks:
    return Tracks(problem.view, problem.point, problem.xy, views, problem.focal, problem.aligned)


def _starts(
    problem: _Problem, T_start: Float[np.ndarray, "n 4 4"], depth: float
) -> list[Float[np.ndarray, "n 4 4"]]:
    """The given poses, unless they are all in one place, and those that the photographs alone tell."""
    given = np.array(T_start, np.float64)
    T, tied = global_poses(_tracks(problem, len(given)))
    if tied.sum() < _FEWEST_TIED:
        return [given]
    in_world = align(_gauge(T[tied], given[tied], np.ones(1), depth), T)
    told = np.where(tied[:, None, None], in_world, given)
    return [told, given] if _apart(given, depth) else [told]


def _start_points(problem: _Problem, T: Float[np.ndarray, "n 4 4"], depth: float) -> Float[np.ndarray, "m 3"]:
    """Where the rays to a point come nearest to each other; in mid-scene if that is not before them all."""
    ray_cam = np.concatenate([problem.xy, np.ones((len(problem.xy), 1))], axis=1)
    ray = np.einsum("oij,oj->oi", T[problem.view, :3, :3], ray_cam)
    origin = T[problem.view, :3, 3]
    unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None]
    count = np.bincount(problem.point)
    A = (problem.by_point @ across.reshape(-1, 9)).reshape(-1, 3, 3)
    b = problem.by_point @ np.einsum("oij,oj->oi", across, origin)
    near = np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0]
    middle = problem.by_point @ (origin + depth * ray) / count[:, None]
    z = np.einsum("oi,oi->o", near[problem.point] - origin, T[problem.view, :3, 2])
    good = (z > depth / 10) & (z < 10 * depth)
    all_good = problem.by_point @ (~good).astype(np.float64) == 0
    return np.where(all_good[:, None], near, middle)


def _reproject(problem: _Problem, T: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "m 3"]) -> _Errors:
    away = points[problem.point] - T[problem.view, :3, 3]
    point_cam = np.einsum("oji,oj->oi", T[problem.view, :3, :3], away)
    front = point_cam[:, 2] > problem.nearest
    depth = np.where(front, point_cam[:, 2], 1.0)
    scale = (problem.focal * problem.weight)[:, None]
    residual = scale * (point_cam[:, :2] / depth[:, None] - problem.xy)
    residual[~front] = 0
    return _Errors(point_cam, residual, np.where(front, np.linalg.norm(residual, axis=1), np.inf))


def _loss(problem: _Problem, T: Float[np.ndarray, "n 4 4"], errors: _Errors, width: float) -> float:
    """Geman and McClure's, in squares of the width, 1 behind a camera; and what the prior says."""
    ratio = (np.where(np.isfinite(errors.size), errors.size, 0) / width) ** 2
    seen = float(np.where(np.isfinite(errors.size), ratio / (1 + ratio), 1.0).sum())
    if problem.prior is None:
        return seen
    return seen + problem.prior.chi2(T) / _OUTLIER**2


def _stage(
    problem: _Problem, T: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "m 3"], sigma: float
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "m 3"], _Errors]:
    """Levenberg and Marquardt's descent of a loss of one width."""
    width, damping = _OUTLIER * sigma, 1e-3
    errors = _reproject(problem, T, points)
    loss = _loss(problem, T, errors, width)
    for _ in range(_STEPS):
        system = _normal_equations(problem, T, errors, width)
        while True:
            twist, shift = _solve(problem, T, system, damping)
            moved, placed = T @ rigid.exp(twist), points + shift
            after = _reproject(problem, moved, placed)
            lower = _loss(problem, moved, after, width)
            if lower < loss:
                break
            damping *= 8
            if damping > 1e8:
                return T, points, errors
        settled = loss - lower < _SETTLED * loss
        T, points, errors, loss, damping = moved, placed, after, lower, max(damping / 5, 1e-9)
        if settled:
            break
    return T, points, errors


def _normal_equations(
    problem: _Problem, T: Float[np.ndarray, "n 4 4"], errors: _Errors, width: float
) -> System:
    front = np.isfinite(errors.size)
    ratio = (np.where(front, errors.size, 0) / width) ** 2
    weight = np.where(front, 1 / (1 + ratio) ** 2, 0) / width**2
    point_cam = np.where(front[:, None], errors.point_cam, 1.0)
    x, y, z = point_cam.T
    zero = np.zeros_like(z)
    by_cam = (problem.focal * problem.weight)[:, None, None] * np.stack(
        [np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], 1
    )  # of the residual by the point in camera axes
    R, both = T[problem.view, :3, :3], np.repeat(weight[:, None], 2, axis=1)
    sums_over = problem.by_view, problem.by_point
    return normal_equations(by_cam, point_cam, R, errors.residual, both, sums_over)


def _solve(
    problem: _Problem, T: Float[np.ndarray, "n 4 4"], system: System, damping: float
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "m 3"]]:
    """The increments of poses and points, the points eliminated."""
    reduced = eliminate_points(system, problem.by_view.indptr, problem.point, damping)
    matrix, down = reduced.matrix.toarray(), reduced.by_view
    if problem.prior is not None:
        known, to_known = problem.prior.normal_equations(T)
        matrix, down = matrix + known / _OUTLIER**2, down + to_known / _OUTLIER**2
    twist = -np.linalg.solve(matrix, down).reshape(-1, 6)
    return twist, reduced.shift(twist)


def _covariances(
    problem: _Problem, solution: _Solution, supported: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n 6 6"]:
    """Of all poses, by what supported photographs have seen and by the prior."""
    T, _, errors, sigma = solution
    system = _normal_equations(problem, T, errors, _OUTLIER * sigma)
    reduced = eliminate_points(system, problem.by_view.indptr, problem.point, _UNDAMPED)
    seen = np.flatnonzero(np.repeat(supported, 6))
    information = _OUTLIER**2 * reduced.matrix.toarray()[np.ix_(seen, seen)]
    covariance = np.full((len(T), 6, 6), np.nan)
    if problem.prior is None:
        covariance[supported] = aligned_covariances(T[supported], information)
    else:
        covariance[~supported] = np.linalg.inv(problem.prior.information[~supported])
        known, _ = problem.prior.normal_equations(T)
        covariance[supported] = covariances(information + known[np.ix_(seen, seen)])
    return covariance


def _gauge(
    T: Float[np.ndarray, "n 4 4"],
    T_start: Float[np.ndarray, "n 4 4"],
    z: Float[np.ndarray, " k"],
    depth: float,
) -> Similarity:
    """The similarity into the world of the start; what that leaves open is settled by the depth."""
    if _apart(T_start, depth):
        return procrustes(T, T_start)
    centre = T_start[:, :3, 3]
    scale = depth / float(np.median(z))
    rotation = rigid.nearest_rotation(np.einsum("nij,nkj->ik", T_start[:, :3, :3], T[:, :3, :3]))
    return Similarity(scale, rotation, centre.mean(axis=0) - scale * rotation @ T[:, :3, 3].mean(axis=0))
