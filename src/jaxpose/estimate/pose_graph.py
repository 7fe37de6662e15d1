"""Poses that agree best with relative poses between them, some of which may be wrong.

Gauss-Newton on a sparse system. Edges that may be wrong count by the Geman-McClure kernel, which is made
non-convex step by step (graduated non-convexity; Yang et al. 2020, Algorithm 1), so that the start does not
decide which of them are believed.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from jaxpose.geometry import rigid

CHI2_999 = 22.46  # of 6 degrees of freedom: squared distance from which a relative pose is taken for wrong

_STEPS = 30  # at most, once the kernel is sharp
_SETTLED = 1e-7  # [m, rad]
_SHARPER = 1.4  # from kernel to kernel


class Edges(NamedTuple):
    """Relative poses as measured, each with its information over right increments [m, rad]."""

    a: Int[np.ndarray, " m"]  # which poses it is between
    b: Int[np.ndarray, " m"]
    T_a_b: Float[np.ndarray, "m 4 4"]
    information: Float[np.ndarray, "m 6 6"]
    doubtful: Bool[np.ndarray, " m"]  # whether it may be wrong


class PoseGraph(NamedTuple):
    """Poses, and how well each edge agrees with them."""

    T: Float[np.ndarray, "n 4 4"]
    weight: Float[np.ndarray, " m"]  # 1: believed, 0: not
    chi2: Float[np.ndarray, " m"]  # squared distance in sigmas


def optimise_pose_graph(T: Float[np.ndarray, "n 4 4"], edges: Edges) -> PoseGraph:
    """The most likely poses, the first of them fixed.

    Args:
        T: (n, 4, 4) poses to start from, `T_world_a`; every pose is connected to the first by certain edges.
        edges: relative poses between them.

    Returns:
        Poses, and what was believed.
    """
    T = np.array(T, np.float64)
    chi2 = squared_distances(T, edges)
    graduation = max(2 * float(chi2[edges.doubtful].max(initial=0)) / CHI2_999, 1.0)
    last = 0  # steps with the kernel as it is meant
    while last < _STEPS:
        step = _step(T, edges, _weights(squared_distances(T, edges), graduation, edges.doubtful))
        T = T @ rigid.exp(step)
        last += graduation == 1
        if graduation == 1 and np.abs(step).max() < _SETTLED:
            break
        graduation = max(graduation / _SHARPER, 1.0)
    T[:, :3, :3] = rigid.nearest_rotation(T[:, :3, :3])
    chi2 = squared_distances(T, edges)
    return PoseGraph(T, _weights(chi2, 1.0, edges.doubtful), chi2)


def squared_distances(T: Float[np.ndarray, "n 4 4"], edges: Edges) -> Float[np.ndarray, " m"]:
    """How far off each edge is, in sigmas, squared.

    Args:
        T: (n, 4, 4) poses.
        edges: relative poses between them.

    Returns:
        Squared Mahalanobis distances (m,).
    """
    off = _residuals(T, edges)
    return np.einsum("mi,mij,mj->m", off, edges.information, off)


def _weights(
    chi2: Float[np.ndarray, " m"], graduation: float, doubtful: Bool[np.ndarray, " m"]
) -> Float[np.ndarray, " m"]:
    wide = graduation * CHI2_999
    return np.where(doubtful, (wide / (wide + chi2)) ** 2, 1.0)


def _residuals(T: Float[np.ndarray, "n 4 4"], edges: Edges) -> Float[np.ndarray, "m 6"]:
    return rigid.log(rigid.inverse(edges.T_a_b) @ rigid.inverse(T[edges.a]) @ T[edges.b])


def _step(
    T: Float[np.ndarray, "n 4 4"], edges: Edges, weight: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "n 6"]:
    """Right increments of all poses by one step of Gauss-Newton; none of the first."""
    system, gradient = normal_equations(T, edges, weight)
    step = np.zeros((len(T), 6))
    step[1:] = -splu(system[6:, 6:]).solve(gradient[6:]).reshape(-1, 6)
    return step


def normal_equations(
    T: Float[np.ndarray, "n 4 4"], edges: Edges, weight: Float[np.ndarray, " m"]
) -> tuple[csc_matrix, Float[np.ndarray, " k"]]:
    """The least squares of relative poses, linear at some poses.

    Args:
        T: (n, 4, 4) the poses.
        edges: relative poses between them.
        weight: (m,) how much each counts.

    Returns:
        The sparse matrix (6 n, 6 n) over right increments of all poses, and the gradient.
    """
    residual = _residuals(T, edges)
    by_b = _inverse_right_jacobian(residual)
    by_a = -by_b @ rigid.adjoint(rigid.inverse(T[edges.b]) @ T[edges.a])
    by = np.stack([by_a, by_b], axis=1)  # (m, 2, 6, 6)
    weighted = np.einsum("mpij,mik->mpjk", by, weight[:, None, None] * edges.information)
    blocks = np.einsum("mpik,mqkj->mpqij", weighted, by)
    ends = np.stack([edges.a, edges.b], axis=1)
    place = 6 * ends[:, :, None] + np.arange(6)  # (m, 2, 6)
    rows = np.broadcast_to(place[:, :, None, :, None], blocks.shape)
    columns = np.broadcast_to(place[:, None, :, None, :], blocks.shape)
    size = 6 * len(T)
    system = csc_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), (size, size))
    gradient = np.zeros(size)
    np.add.at(gradient, place, np.einsum("mpik,mk->mpi", weighted, residual))
    return system, gradient


def _inverse_right_jacobian(xi: Float[np.ndarray, "m 6"]) -> Float[np.ndarray, "m 6 6"]:
    """Change of log(T exp(d)) by d at log(T) = xi, to second order: I + ad/2 + ad^2/12."""
    cross = lambda v: np.cross(np.eye(3), v[..., None, :])
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = cross(xi[:, 3:])
    ad[:, :3, 3:] = cross(xi[:, :3])
    return np.eye(6) + ad / 2 + ad @ ad / 12
