"""How sure cameras are, whose world is held by what was known of them or free up to a similarity."""

import numpy as np
import scipy.linalg
from jaxtyping import Float


def covariances(information: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "n 6 6"]:
    """Of each camera, where all together are held in the world.

    Args:
        information: (6 n, 6 n) of right increments of all cameras.

    Returns:
        Covariances of right increments; NaN where the information has no inverse.
    """
    return _blocks(_inverse(information))


def aligned_covariances(
    T_world_cam: Float[np.ndarray, "n 4 4"], information: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "n 6 6"]:
    """Of each camera, after the similarity that brings all centres closest to true ones.

    Photographs alone tell no similarity (gauge freedom; Triggs et al. 1999, section 9): its seven directions
    are filled up, and what is left of errors after the alignment is linear in them (an S-transform; Baarda
    1973).

    Args:
        T_world_cam: Camera-to-world poses (n, 4, 4), not all in one place.
        information: (6 n, 6 n) of right increments of all cameras; similarities of the world change nothing.

    Returns:
        Covariances of right increments; NaN where the information leaves more than the similarity open.
    """
    free = _similarities(T_world_cam)
    filled = information + np.trace(information) / len(information) * free @ free.T
    of_centres = free.reshape(-1, 6, 7).copy()
    of_centres[:, 3:] = 0
    of_centres = of_centres.reshape(-1, 7)
    left = np.eye(len(free)) - free @ np.linalg.pinv(of_centres.T @ free, rcond=1e-9) @ of_centres.T
    return _blocks(left @ _inverse(filled) @ left.T)


def _similarities(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "k 7"]:
    """Orthonormal right increments of all cameras by shifts, turns and scales of their world."""
    centre = T[:, :3, 3] - T[:, :3, 3].mean(axis=0)
    size = np.sqrt(np.mean(np.sum(centre**2, axis=1)))
    to_cam = T[:, :3, :3].swapaxes(1, 2)
    by = np.zeros((len(T), 6, 7))
    by[:, :3, :3] = size * to_cam
    by[:, :3, 3:6] = to_cam @ np.cross(np.eye(3), centre[:, None]).swapaxes(1, 2)
    by[:, 3:, 3:6] = to_cam
    by[:, :3, 6] = np.einsum("nij,nj->ni", to_cam, centre)
    return np.linalg.qr(by.reshape(-1, 7))[0]


def _inverse(information: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """NaN where something is held by nothing."""
    try:
        factor = scipy.linalg.cho_factor(information)
    except np.linalg.LinAlgError:
        return np.full_like(information, np.nan)
    return scipy.linalg.cho_solve(factor, np.eye(len(information)))


def _blocks(covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "n 6 6"]:
    n = len(covariance) // 6
    return covariance.reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)]
