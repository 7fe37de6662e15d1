"""Gauss-Newton for a B-spline along stamped poses, in float64 numpy: there is nothing to compile."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import splu

from jaxpose.fields import numpy_evaluator
from jaxpose.fields._bspline import Bspline

DELTA = 1e-2  # [rad or length scales] smaller residuals count by their square, larger by their size
_STEPS = 20  # at most
_SETTLED, _NOTHING = 1e-5, 1e-12  # share of the loss that a step takes off, and loss, at which it is done
_DAMPING = 1e-9  # of the largest entry of the normal equations
_DIFFERENCE = 1e-6  # of control points, for derivatives
_RESIDUALS, _UNKNOWNS = 12, 28  # of a pose: its 3 x 4 numbers, and the four control points that it depends on


def fit_spline(
    spline: Bspline,
    t: Float[np.ndarray, " n"],
    T: Float[np.ndarray, "n 4 4"],
    points: Float[np.ndarray, "k 7"],
    length_scale: float,
) -> Float[np.ndarray, "k 7"]:
    """The control points near the given ones at which the loss of `fields.fit` is least.

    Where poses are too few to say, control points stay where they are. Residuals that count by their size are
    weighted anew in each step.
    """

    row = _first_points(spline, t)

    def residuals(points):
        factor = {"kind": "bspline", "span": np.array(spline.span), "control_points": points}
        error = numpy_evaluator.evaluate(factor, t) - T
        shift, turn = error[:, :3, 3] / length_scale, error[:, :3, :3] / np.sqrt(2)  # the chord of the angle
        return np.concatenate([shift, turn.reshape(-1, 9)], axis=1)

    r, damping = residuals(points), _DAMPING
    value, weights = _loss(r)
    for _ in range(_STEPS):
        J = _jacobian(residuals, points, r, row)
        normal, side = _normal_equations(J, r, weights, row, points.size)
        while True:
            damped = normal + damping * normal.diagonal().max() * eye_array(points.size, format="csc")
            moved = points - splu(damped).solve(side).reshape(-1, 7)
            new = residuals(moved)
            new_value, new_weights = _loss(new)
            if new_value <= value or damping > 1:
                break
            damping *= 100
        if new_value >= value:
            break
        settled = value - new_value < _SETTLED * value or new_value < _NOTHING
        points, r, value, weights = moved, new, new_value, new_weights
        damping = max(damping / 100, _DAMPING)
        if settled:
            break
    return points


def _loss(r: Float[np.ndarray, "n 12"]) -> tuple[float, Float[np.ndarray, "n 12"]]:
    """The mean pseudo-Huber loss of distances and chords, and the weight of each residual's square."""
    square = np.stack([(r[:, :3] ** 2).sum(1), (r[:, 3:] ** 2).sum(1)], axis=1) / DELTA**2
    weights = 1 / np.sqrt(1 + square)
    return float(np.mean(square * weights / (1 + weights))), np.repeat(weights, [3, 9], axis=1)


def _first_points(spline: Bspline, t) -> Int[np.ndarray, " n"]:
    """The first of the four control points that the pose at each time depends on."""
    first, last = spline.span
    place = (t - first) * (spline.intervals / (last - first))
    return np.clip(np.floor(place), 0, spline.intervals - 1).astype(int)


def _jacobian(residuals, points, r, row) -> Float[np.ndarray, "n 12 28"]:
    """Derivatives by differences; every fourth control point is moved at once, as a pose depends on four."""
    J = np.empty((len(row), _RESIDUALS, _UNKNOWNS))
    for a in range(4):
        which = (a - row) % 4  # of a pose's four is moved with points a, a + 4, a + 8, ...
        for k in range(7):
            changed = points.copy()
            changed[a::4, k] += _DIFFERENCE
            J[np.arange(len(row)), :, 7 * which + k] = (residuals(changed) - r) / _DIFFERENCE
    return J


def _normal_equations(J, r, weights, row, size: int) -> tuple[csc_array, Float[np.ndarray, " k"]]:
    """The normal equations of the points; poses of one interval share theirs."""
    intervals, begins = np.unique(row, return_index=True)
    blocks, side = np.empty((len(intervals), _UNKNOWNS, _UNKNOWNS)), np.zeros(size)
    unknowns = 7 * intervals[:, None] + np.arange(_UNKNOWNS)
    for k, (first, last) in enumerate(zip(begins, [*begins[1:], len(row)], strict=True)):
        A = J[first:last].reshape(-1, _UNKNOWNS)
        weighted = weights[first:last].reshape(-1, 1) * A
        blocks[k] = A.T @ weighted
        side[unknowns[k]] += weighted.T @ r[first:last].ravel()
    places = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
    return csc_array((blocks.ravel(), [place.ravel() for place in places]), (size, size)), side
