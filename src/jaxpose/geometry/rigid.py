"""Rigid and similarity transforms in float64 numpy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Similarity(NamedTuple):
    """The map `scale * rotation @ point + translation`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]


def nearest_rotation(matrix: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The rotations closest (least squares) to finite 3x3 matrices; never a reflection."""
    left, _, right = np.linalg.svd(matrix)
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right


def rotation_angle_deg(
    R_world_a: Float[np.ndarray, "*n 3 3"], R_world_b: Float[np.ndarray, "*n 3 3"]
) -> Float[np.ndarray, "*n"]:
    """Angle between orientations [deg], 0 to 180, accurate at both ends; NaN where an input is.

    Compare trajectories after `align`: it takes the rotation between their worlds out.
    """
    R_a_b = np.asarray(R_world_a, np.float64).swapaxes(-1, -2) @ R_world_b
    skew = R_a_b - R_a_b.swapaxes(-1, -2)
    sine = np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    return np.asarray(np.degrees(np.arctan2(sine, np.trace(R_a_b, axis1=-2, axis2=-1) - 1)))
