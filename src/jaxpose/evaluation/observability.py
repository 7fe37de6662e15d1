"""What an alignment of positions leaves free: a straight path can be turned about itself."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxpose._checks import check_shapes

_ROUNDING = 1e-6  # of the path's spread along its direction; less beside it is taken for digits
_DIGITS = 1e-14  # of the distance from the origin


def free_rotation(
    reference: Float[np.ndarray, "n 3"], aligned: Float[np.ndarray, "n 3"]
) -> tuple[Literal["none", "about the path", "all"], float]:
    """Which rotation the least-squares alignment of positions cannot find.

    A rotation about the path shows in how far it leaves its own line. Where that is no more than the residual
    beside the line, the residual decides it.

    Args:
        reference: Positions (n, 3) [m], n at least 3.
        aligned: Those that were aligned to them, row by row (n, 3) [m].

    Returns:
        What is free, and the spread (RMS) [m] that would have to tell it: beside the straightest line, or,
        where all is free, in any direction.

    Raises:
        ValueError: For other shapes.

    >>> line = np.outer(np.arange(5.0), [1.0, 2.0, 0.0])
    >>> free_rotation(line, line)[0]
    'about the path'
    """
    check_shapes(reference=(reference, "n 3"), aligned=(aligned, "n 3"))
    centred, residual = reference - reference.mean(axis=0), aligned - reference
    rms = lambda vectors: float(np.sqrt((vectors**2).sum(axis=1).mean()))
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    beside_line = lambda vectors: vectors - np.outer(vectors @ direction, direction)
    along, beside, digits = rms(centred), rms(beside_line(centred)), _DIGITS * float(np.abs(reference).max())
    if along <= max(rms(residual), digits):
        return "all", along
    if beside <= max(rms(beside_line(residual)), digits, _ROUNDING * along):
        return "about the path", beside
    return "none", beside
