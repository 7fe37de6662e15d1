"""What was known of poses before photographs were looked at: factors of bundle adjustment."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose._checks import check_finite, check_shapes
from jaxpose.estimate.pose_graph import Edges, normal_equations, squared_distances


class Prior(NamedTuple):
    """Poses as stated, each with its information over right increments, translation first."""

    from_world: Edges  # the world is a pose too, behind all others

    @property
    def information(self) -> Float[np.ndarray, "n 6 6"]:
        """Of each pose as stated."""
        return self.from_world.information

    def chi2(self, T: Float[np.ndarray, "n 4 4"]) -> float:
        """The squared distance of poses from those stated, in sigmas, of all together."""
        return float(squared_distances(_with_world(T), self.from_world).sum())

    def normal_equations(
        self, T: Float[np.ndarray, "n 4 4"]
    ) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
        """The information over right increments of all poses (6 n, 6 n), linear at some, and the gradient."""
        matrix, gradient = normal_equations(_with_world(T), self.from_world, np.ones(len(T)))
        size = 6 * len(T)
        return matrix[:size, :size].toarray(), gradient[:size]


def stated_prior(T: Float[np.ndarray, "n 4 4"], information: Float[np.ndarray, "n 6 6"]) -> Prior:
    """What is known of poses.

    Args:
        T: Camera-to-world poses (n, 4, 4) as stated.
        information: Of each, over right increments.

    Returns:
        The prior.

    Raises:
        ValueError: For information of another shape, or not positive definite.
    """
    check_shapes(T=(T, "n 4 4"), information=(information, f"{len(T)} 6 6"))
    check_finite(information=information)
    if not np.linalg.eigvalsh(information).min() > 0:
        raise ValueError("information: expected positive definite matrices, got one that is not")
    n = len(T)
    return Prior(Edges(np.full(n, n), np.arange(n), T, information, np.zeros(n, bool)))


def _with_world(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "k 4 4"]:
    return np.concatenate([T, np.eye(4)[None]])
