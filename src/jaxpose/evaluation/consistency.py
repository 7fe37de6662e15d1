"""Whether a trajectory's errors are as large as its covariances say: NEES and coverage."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.geometry import rigid

MEDIAN_CHI2 = 5.348  # of chi-squared of six numbers


class Consistency(NamedTuple):
    """Errors against covariances.

    `nees` is the mean of squared errors over their covariances, 6 where these are right; `band` is where 95%
    of such means lie for `independent` errors. `inside_50` and `inside_90` are the shares of errors within
    the ellipsoids that hold 50 and 90% of them.
    """

    nees: float
    band: tuple[float, float]
    inside_50: float
    inside_90: float
    count: int
    independent: int


def consistency(
    error: Float[np.ndarray, "n 6"], covariance: Float[np.ndarray, "n 6 6"], *, independent: int
) -> Consistency:
    """NEES (Bar-Shalom et al. 2001, section 5.4) and coverage of pose errors.

    Args:
        error: increments (n, 6) from estimated to true poses, [translation, rotation].
        covariance: their covariances (n, 6, 6).
        independent: how many of the errors are independent of each other; neighbours in time are not.

    Returns:
        Mean, band and coverage.

    Raises:
        DataError: no errors, or covariances that are not positive definite.

    >>> rng = np.random.default_rng(0)
    >>> found = consistency(rng.normal(size=(1000, 6)), np.tile(np.eye(6), (1000, 1, 1)), independent=1000)
    >>> found.band[0] < found.nees < found.band[1]
    True
    """
    check_shapes(error=(error, "n 6"), covariance=(covariance, "n 6 6"))
    if len(error) == 0:
        raise DataError("consistency: expected at least one error, got none")
    try:
        half = np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])[..., 0]
    except np.linalg.LinAlgError:
        raise DataError("consistency: expected covariances that are positive definite") from None
    square = np.sum(half**2, axis=1)
    low, high = chi2.ppf([0.025, 0.975], 6 * independent) / independent
    half_inside, most_inside = (float(np.mean(square <= chi2.ppf(share, 6))) for share in (0.5, 0.9))
    band = float(low), float(high)
    return Consistency(float(square.mean()), band, half_inside, most_inside, len(error), independent)


def variance_factor(error: Float[np.ndarray, "n 6"], covariance: Float[np.ndarray, "n 6 6"]) -> float:
    """What covariances are to be multiplied by so that they explain errors: by medians, whatever a few are.

    Args:
        error: increments (n, 6), at least one.
        covariance: their covariances as stated (n, 6, 6).

    Returns:
        1 or more: errors that are smaller do not make anything surer.
    """
    square = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return max(float(np.median(square)) / MEDIAN_CHI2, 1.0)


def relative_error(
    estimate: tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "n 4 4"]],
    truth: tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "n 4 4"]],
) -> Float[np.ndarray, "n 6"]:
    """Errors of moves from one pose to a later one; no alignment of trajectories matters to them.

    Args:
        estimate: first and later poses (n, 4, 4).
        truth: the same of the ground truth.

    Returns:
        Increments (n, 6) on the right of the estimated moves.
    """
    moved, truly = (rigid.inverse(first) @ later for first, later in (estimate, truth))
    return rigid.log(rigid.inverse(moved) @ truly)


def aligned_error(
    estimate: Float[np.ndarray, "n 4 4"],
    truth: Float[np.ndarray, "n 4 4"],
    covariance: Float[np.ndarray, "n 6 6"],
) -> Float[np.ndarray, "n 6"]:
    """Errors of poses after the rigid alignment that makes their weighted squares least.

    An alignment of positions alone would leave a common error of rotations in, and count noise that is
    known to be large as much as other.

    Args:
        estimate: poses (n, 4, 4), roughly aligned.
        truth: poses (n, 4, 4).
        covariance: of the estimate (n, 6, 6).

    Returns:
        Increments (n, 6) on the right of the aligned poses; six of their degrees of freedom are used up.
    """
    information = np.linalg.inv(covariance)
    for _ in range(5):
        error = rigid.log(rigid.inverse(estimate) @ truth)
        J = rigid.adjoint(rigid.inverse(estimate))  # of a common increment on the left
        H = np.einsum("nki,nkl,nlj->ij", J, information, J)
        step = np.linalg.solve(H, np.einsum("nki,nkl,nl->i", J, information, error))
        estimate = rigid.exp(step[None])[0] @ estimate
    return rigid.log(rigid.inverse(estimate) @ truth)
