"""Normal equations of cameras and points, the points eliminated (Schur complement; Triggs et al. 1999)."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int


class System(NamedTuple):
    """Normal equations in blocks: of the views (increments on the right), of the points, of both."""

    view: Float[np.ndarray, "n 6 6"]
    point: Float[np.ndarray, "m 3 3"]
    both: Float[np.ndarray, "o 6 3"]
    by_view: Float[np.ndarray, "n 6"]
    by_point: Float[np.ndarray, "m 3"]


class Reduced(NamedTuple):
    """What is left of them for the views, and what leads back to the points."""

    matrix: sp.bsr_matrix  # (6 n, 6 n)
    by_view: Float[np.ndarray, " k"]
    both: sp.bsr_matrix  # (6 n, 3 m)
    inverse: Float[np.ndarray, "m 3 3"]
    by_point: Float[np.ndarray, "m 3"]

    def shift(self, twist: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "m 3"]:
        """How points move with the views."""
        down = self.by_point + (self.both.T @ twist.ravel()).reshape(-1, 3)
        return -np.einsum("mij,mj->mi", self.inverse, down)


def normal_equations(
    by_cam: Float[np.ndarray, "o d 3"],
    point_cam: Float[np.ndarray, "o 3"],
    R_world_cam: Float[np.ndarray, "o 3 3"],
    residual: Float[np.ndarray, "o d"],
    weight: Float[np.ndarray, "o d"],
    sums: tuple[sp.csr_matrix, sp.csr_matrix],
) -> System:
    """The least squares of residuals of points as views see them, linear at some poses and points.

    Args:
        by_cam: Derivative of each residual by its point in camera axes.
        point_cam: The point there.
        R_world_cam: Rotation of its view.
        residual: Residuals.
        weight: What each counts.
        sums: Over the observations of each view, and of each point.

    Returns:
        The equations.
    """
    by_view = np.concatenate([-by_cam, np.cross(by_cam, point_cam[:, None])], axis=-1)
    by_point = np.einsum("oij,okj->oik", by_cam, R_world_cam)
    weighted_view, weighted_point = (weight[..., None] * each for each in (by_view, by_point))
    product = lambda a, b: np.einsum("oki,okj->oij", a, b)
    down = lambda a: np.einsum("oki,ok->oi", a, residual)
    total = lambda which, blocks: (which @ blocks.reshape(len(blocks), -1)).reshape(-1, *blocks.shape[1:])
    of_view, of_point = sums
    return System(
        total(of_view, product(weighted_view, by_view)),
        total(of_point, product(weighted_point, by_point)),
        product(weighted_view, by_point),
        total(of_view, down(weighted_view)),
        total(of_point, down(weighted_point)),
    )


def eliminate_points(
    system: System, starts: Int[np.ndarray, " s"], point: Int[np.ndarray, " o"], damping: float
) -> Reduced:
    """The normal equations of the views alone.

    Args:
        system: of both; observations are in the order of their views.
        starts: Where those of each view begin, and their number.
        point: Which point each is of.
        damping: Added to the diagonals, as a share of them.

    Returns:
        The equations.
    """
    n, m = len(system.view), len(system.point)
    of_view, of_point = (_damped(blocks, damping) for blocks in (system.view, system.point))
    inverse = np.linalg.inv(of_point)
    sparse = lambda blocks: sp.bsr_matrix((blocks, point, starts), (6 * n, 3 * m))
    both, eliminated = sparse(system.both), sparse(system.both @ inverse[point])
    of_views = sp.bsr_matrix((of_view, np.arange(n), np.arange(n + 1)), (6 * n, 6 * n))
    by_view = system.by_view.ravel() - eliminated @ system.by_point.ravel()
    return Reduced(of_views - eliminated @ both.T, by_view, both, inverse, system.by_point)


def _damped(blocks: Float[np.ndarray, "k d d"], damping: float) -> Float[np.ndarray, "k d d"]:
    """Blocks with more on their diagonals; those of nobody's observations are ones."""
    d = blocks.shape[-1]
    diagonal = np.einsum("kii->ki", blocks)
    least = 1e-9 * diagonal.max()
    damped = blocks.copy()
    more = damping * np.maximum(diagonal, 1e-3 * diagonal.max(axis=1, keepdims=True)) + max(least, 1e-30)
    damped[:, np.arange(d), np.arange(d)] += more
    return damped
