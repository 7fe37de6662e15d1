"""Noise on known poses: smooth in time, as a drifting tracker errs, or of each view by itself.

Both give T_noise in the frame of the camera it disturbs: T_init = T_true . T_noise.
"""

import math

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from jaxpose.geometry import rigid


def correlated(
    t: Float[np.ndarray, " n"], *, translation: float, rotation_deg: float, seed: int, knots: int = 6
) -> Float[np.ndarray, "n 4 4"]:
    """Random deviations at equally spaced times, interpolated between them.

    Cubic splines for translation, great arcs (slerp) for rotation. Rotation is scaled along its path of
    rotation vectors, which keeps the path continuous at any angle.

    Args:
        t: Times (n,) [s] of the views.
        translation: The largest deviation over the views is exactly this [scene units]; 0 for none.
        rotation_deg: The largest turn over the views is exactly this.
        seed: Makes the deviations.
        knots: How many times, from the first to the last.

    Returns:
        T_noise (n, 4, 4).

    Raises:
        ValueError: For times all alike, a negative size, an angle above 180 degrees, or fewer than 2 knots.
    """
    first, last = float(np.min(t)), float(np.max(t))
    if not last > first:
        raise ValueError(f"t: expected times that differ, got {len(t)} all at {first}")
    if not (0 <= translation < math.inf and 0 <= rotation_deg <= 180 and knots >= 2):
        raise ValueError(
            "expected translation >= 0, rotation_deg from 0 to 180 and knots >= 2, "
            f"got {translation}, {rotation_deg} and {knots}"
        )
    generator = np.random.default_rng(seed)
    at = np.linspace(first, last, knots)
    shift = CubicSpline(at, generator.normal(size=(knots, 3)))(t)
    turn = generator.normal(size=(knots, 3))
    # Within one radian of the identity arcs are unique and stay there, so no rotation vector jumps at pi.
    turn /= np.linalg.norm(turn, axis=1).max()
    turn = Slerp(at, Rotation.from_rotvec(turn))(np.clip(t, first, last)).as_rotvec()
    return rigid.make(rigid.so3_exp(_scaled(turn, math.radians(rotation_deg))), _scaled(shift, translation))


def independent(n: int, sigma: float, seed: int) -> Float[np.ndarray, "n 4 4"]:
    """BARF's noise (Lin et al., ICCV 2021): per view the exponential of a twist of N(0, sigma^2 I_6).

    BARF itself puts it on the world's side of the pose, T_noise . T_true, where turning about the origin also
    moves the camera.

    Args:
        n: How many views.
        sigma: [scene units and rad].
        seed: Makes the twists.

    Returns:
        (n, 4, 4).

    Raises:
        ValueError: For a negative sigma.
    """
    if not 0 <= sigma < math.inf:
        raise ValueError(f"sigma: expected 0 or more, got {sigma}")
    return rigid.exp(np.random.default_rng(seed).normal(scale=sigma, size=(6, n)).T)


def _scaled(deviations: Float[np.ndarray, "n 3"], largest: float) -> Float[np.ndarray, "n 3"]:
    """The deviations scaled so that the longest has the length asked for."""
    return deviations * (largest / np.linalg.norm(deviations, axis=1).max())
