"""Gauss-Newton for a B-spline along stamped poses, in float64 numpy: there is nothing to compile."""

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import splu

from jaxpose.fields import numpy_evaluator
from jaxpose.fields._bspline import Bspline

DELTA = 1e-2  # [rad or length scales] smaller residuals count by their square, larger by their size
_STEPS = 20  # at most
_SETTLED, _NOTHING = 1e-6, 1e-12  # share of the loss that a step takes off, and loss, at which it is done
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

    def residuals(points):
        factor = {"kind": "bspline", "span": np.array(spline.span), "control_points": points}
        error = numpy_evaluator.evaluate(factor, t) - T
        shift, turn = error[:, :3, 3] / length_scale, error[:, :3, :3] / np.sqrt(2)  # the chord of the angle
        return np.concatenate([shift, turn.reshape(-1, 9)], axis=1)

    r, damping = residuals(points), _DAMPING
    value, weights = _loss(r)
    for _ in range(_STEPS):
        J = _jacobian(spline, residuals, points, r, t)
        weighted = J.T * weights.ravel()
        normal, side = (weighted @ J).tocsc(), weighted @ r.ravel()
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


def _jacobian(spline: Bspline, residuals, points, r, t) -> csr_array:
    """Derivatives by differences; every fourth control point is moved at once, as a pose depends on four."""
    first, last = spline.span
    place = (t - first) * (spline.intervals / (last - first))
    row = np.clip(np.floor(place), 0, spline.intervals - 1).astype(int)  # the first point of each pose's four
    values = np.zeros((len(t), _RESIDUALS, _UNKNOWNS))
    for a in range(4):
        which = (a - row) % 4  # of a pose's four is moved with points a, a + 4, a + 8, ...
        for k in range(7):
            changed = points.copy()
            changed[a::4, k] += _DIFFERENCE
            values[np.arange(len(t)), :, 7 * which + k] = (residuals(changed) - r) / _DIFFERENCE
    columns = np.repeat(7 * row[:, None] + np.arange(_UNKNOWNS), _RESIDUALS, axis=0)
    starts = np.arange(0, columns.size + 1, _UNKNOWNS)
    return csr_array((values.ravel(), columns.ravel(), starts), shape=(r.size, points.size))
