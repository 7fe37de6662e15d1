"""Work near the origin: float32 holds 0.5 m at UTM's five million."""

import numpy as np
from jaxtyping import Float

from jaxpose._checks import check_shapes


def far_origin(T_world_cam: Float[np.ndarray, "n 4 4"] | None, far: float) -> Float[np.ndarray, "3"]:
    """Where to take the origin of poses that are far from the world's own.

    Args:
        T_world_cam: Poses (n, 4, 4), NaN where there is none.
        far: Distance from the origin from where on another is taken, in their unit.

    Returns:
        The first position in whole units, so that neither taking it off nor adding it again loses a digit;
        zeros where it is nearer than `far`, and without poses.

    Raises:
        ValueError: For another shape.
    """
    if T_world_cam is None:
        return np.zeros(3)
    check_shapes(T_world_cam=(T_world_cam, "n 4 4"))
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.any():
        return np.zeros(3)
    first = T_world_cam[finite][0, :3, 3]
    return np.round(first) if np.abs(first).max() > far else np.zeros(3)


def moved(T_world_cam: Float[np.ndarray, "n 4 4"], by: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 4 4"]:
    """Poses with `by` added to their positions.

    Args:
        T_world_cam: Poses (n, 4, 4).
        by: Translation of the world.

    Returns:
        Poses (n, 4, 4), float64.
    """
    T = np.array(T_world_cam, np.float64)
    T[:, :3, 3] += by
    return T
