"""Rigid and similarity transforms in float64 numpy: the twins of `se3` for what is not traced.

`T_a_b` (4 x 4) maps coordinates in frame b to frame a; transforms are chained by `@`. A tangent is
`[translation, rotation]` (m, rad) and acts on the right, as in `se3`. All functions take leading axes. For
rotations in other forms (quaternions, Euler angles, splines) scipy's `Rotation` is the tool.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_finite, check_shapes

# (x - sin x)/x^3 in x^2; below 1 the terms left out are less than 1e-16
_SINE = [(-1) ** k / math.factorial(2 * k + 3) for k in range(8)]


class Similarity(NamedTuple):
    """The map `scale * rotation @ point + translation`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points in the other world."""
        return self.scale * points @ self.rotation.T + self.translation


def make(
    rotation: Float[np.ndarray, "*#n 3 3"], translation: Float[np.ndarray, "*#n 3"]
) -> Float[np.ndarray, "*n 4 4"]:
    """The transform `p -> rotation p + translation`.

    Args:
        rotation: (..., 3, 3); broadcast against `translation`.
        translation: (..., 3).

    Returns:
        (..., 4, 4).

    Raises:
        ValueError: For other shapes, as all functions here.

    >>> make(np.eye(3), np.array([1.0, 2.0, 3.0]))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    check_shapes(rotation=(rotation, "*n 3 3"), translation=(translation, "*n 3"))
    T = np.zeros((*np.broadcast_shapes(np.shape(rotation)[:-2], np.shape(translation)[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1
    return T


def inverse(T_a_b: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """The transform the other way, taking the rotation as orthonormal.

    Args:
        T_a_b: (..., 4, 4); NaN stays NaN.

    Returns:
        `T_b_a` (..., 4, 4).

    >>> inverse(make(np.eye(3), np.array([1.0, 2.0, 3.0])))[:3, 3].tolist()
    [-1.0, -2.0, -3.0]
    """
    check_shapes(T_a_b=(T_a_b, "*n 4 4"))
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return make(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def apply(T_a_b: Float[np.ndarray, "*#n 4 4"], point_b: Float[np.ndarray, "*#n 3"]) -> np.ndarray:
    """The coordinates in frame a of points known in frame b.

    Args:
        T_a_b: (..., 4, 4); leading axes broadcast against those of the points.
        point_b: (..., 3).

    Returns:
        (..., 3), in the points' unit of length.

    >>> apply(make(np.eye(3), np.array([1.0, 2.0, 3.0])), np.zeros((2, 3))).tolist()
    [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]
    """
    check_shapes(T_a_b=(T_a_b, "*n 4 4"), point_b=(point_b, "*m 3"))
    return (T_a_b[..., :3, :3] @ point_b[..., None])[..., 0] + T_a_b[..., :3, 3]


def exp(xi: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 4 4"]:
    """The transform that a constant twist reaches in unit time.

    Args:
        xi: Twists (..., 6), [translation, rotation] [m, rad].

    Returns:
        (..., 4, 4).

    >>> exp(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))[:3, 3].tolist()
    [1.0, 0.0, 0.0]
    """
    check_shapes(xi=(xi, "*n 6"))
    xi = np.asarray(xi, np.float64)
    rho, phi = xi[..., :3], xi[..., 3:]
    return make(so3_exp(phi), (_left_jacobian(phi) @ rho[..., None])[..., 0])


def log(T: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 6"]:
    """The twist of least rotation with `exp(xi) = T`.

    Args:
        T: (..., 4, 4).

    Returns:
        Twists (..., 6), [translation, rotation] [m, rad], turning by at most pi.

    >>> log(np.eye(4)).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """
    check_shapes(T=(T, "*n 4 4"))
    phi = so3_log(T[..., :3, :3])
    rho = np.linalg.solve(_left_jacobian(phi), np.asarray(T, np.float64)[..., :3, 3:])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def so3_exp(phi: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The rotation about a vector by its length.

    Args:
        phi: Rotation vectors (..., 3) [rad].

    Returns:
        (..., 3, 3).
    """
    check_shapes(phi=(phi, "*n 3"))
    return Rotation.from_rotvec(np.reshape(phi, (-1, 3))).as_matrix().reshape(*np.shape(phi), 3)


def so3_log(R: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """The rotation vector of a rotation.

    Args:
        R: (..., 3, 3).

    Returns:
        (..., 3) [rad], of length at most pi; at pi one of the two axes.
    """
    check_shapes(R=(R, "*n 3 3"))
    return Rotation.from_matrix(np.reshape(R, (-1, 3, 3))).as_rotvec().reshape(np.shape(R)[:-1])


def nearest_rotation(matrix: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The rotations closest to matrices, in the sum of squares; never a reflection.

    Args:
        matrix: (..., 3, 3), finite.

    Returns:
        (..., 3, 3).

    Raises:
        ValueError: for NaN and infinity.

    >>> nearest_rotation(2 * np.eye(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    check_shapes(matrix=(matrix, "*n 3 3"))
    check_finite(matrix=matrix)  # a decomposition of others may not return
    left, _, right = np.linalg.svd(matrix)
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right


def is_rotation(matrix: Float[np.ndarray, "*n 3 3"], tolerance: float = 1e-6) -> np.ndarray:
    """Whether matrices are orthonormal and no reflections.

    Args:
        matrix: (..., 3, 3).
        tolerance: How far an entry of R R^T may be off the identity's.

    Returns:
        One bool a matrix; False for NaN.

    >>> bool(is_rotation(np.diag([1.0, 1.0, -1.0])))
    False
    """
    check_shapes(matrix=(matrix, "*n 3 3"))
    off = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    return np.asarray((off <= tolerance) & (np.linalg.det(np.nan_to_num(matrix)) > 0))


def rotation_angle(
    R_world_a: Float[np.ndarray, "*#n 3 3"], R_world_b: Float[np.ndarray, "*#n 3 3"]
) -> np.ndarray:
    """The angle between orientations, accurate near 0 and near pi.

    Compare trajectories after they are aligned, which takes the rotation between their worlds out.

    Args:
        R_world_a: (..., 3, 3); leading axes broadcast.
        R_world_b: (..., 3, 3).

    Returns:
        Angles [rad], 0 to pi; NaN where an input is.

    >>> float(rotation_angle(np.eye(3), np.diag([1.0, -1.0, -1.0]))) == math.pi
    True
    """
    check_shapes(R_world_a=(R_world_a, "*n 3 3"), R_world_b=(R_world_b, "*n 3 3"))
    R_a_b = np.swapaxes(np.asarray(R_world_a, np.float64), -1, -2) @ R_world_b
    skew = R_a_b - R_a_b.swapaxes(-1, -2)
    sine = np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    return np.asarray(np.arctan2(sine, np.trace(R_a_b, axis1=-2, axis2=-1) - 1))


def vector_angle(a: Float[np.ndarray, "*#n 3"], b: Float[np.ndarray, "*#n 3"]) -> np.ndarray:
    """The angle between vectors, accurate near 0 and near pi.

    Args:
        a: (..., 3); leading axes broadcast.
        b: (..., 3).

    Returns:
        Angles [rad], 0 to pi; 0 where a vector has no length.

    >>> float(vector_angle(np.array([1.0, 0.0, 0.0]), np.array([0.0, 2.0, 0.0]))) == math.pi / 2
    True
    """
    check_shapes(a=(a, "*n 3"), b=(b, "*n 3"))
    sine, cosine = np.linalg.norm(np.cross(a, b), axis=-1), np.sum(np.multiply(a, b), axis=-1)
    return np.asarray(np.arctan2(sine, cosine))


def adjoint(T_a_b: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 6 6"]:
    """The matrix that moves a twist from frame b to a: `T exp(xi) T^-1 = exp(adjoint(T) xi)`.

    Args:
        T_a_b: Transforms (..., 4, 4).

    Returns:
        Matrices (..., 6, 6) on twists [translation, rotation] (Sola et al. 2018, eq. 31).
    """
    R = T_a_b[..., :3, :3]
    result = np.zeros((*T_a_b.shape[:-2], 6, 6))
    result[..., :3, :3], result[..., 3:, 3:] = R, R
    result[..., :3, 3:] = _hat(T_a_b[..., :3, 3]) @ R
    return result


def carried(
    T_a_b: Float[np.ndarray, "*n 4 4"], covariance_b: Float[np.ndarray, "*n 6 6"]
) -> Float[np.ndarray, "*n 6 6"]:
    """The covariance of twists of frame b, seen from a.

    Args:
        T_a_b: Transforms (..., 4, 4).
        covariance_b: Of twists [translation, rotation] (..., 6, 6).

    Returns:
        Covariances (..., 6, 6).
    """
    to_a = adjoint(T_a_b)
    return to_a @ covariance_b @ np.swapaxes(to_a, -1, -2)


def _hat(v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The matrix of the cross product with v from the left."""
    return np.cross(np.eye(3), v[..., None, :])


def _left_jacobian(phi: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """How far unit velocities come in unit time while turning by phi: I + b hat(phi) + c hat(phi)^2."""
    square = np.sum(phi * phi, axis=-1)[..., None, None]
    angle = np.sqrt(square)
    near = square < 1
    series = np.polynomial.polynomial.polyval(np.where(near, square, 0), _SINE)
    c = np.where(near, series, (angle - np.sin(angle)) / np.where(near, 1, angle * square))
    hat = _hat(phi)
    return np.eye(3) + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * hat + c * hat @ hat
