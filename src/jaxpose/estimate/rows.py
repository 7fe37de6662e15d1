"""Whitened residuals with their derivatives, and what keeps a wrong one from pulling as far as it is off."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float
from scipy.special import chdtri

_UNUSUAL = 0.01  # share of squared distances from which on rows count by their size


class Rows(NamedTuple):
    """Whitened residuals with their derivatives by a pair of blocks and the border."""

    residual: Float[Array, "*n"]
    jacobian: Float[Array, "*n 70"]


def robust(r: Float[Array, "n m"], J: Float[Array, "n m 70"]) -> Rows:
    """Rows of n measurements, which count by their size beyond what 99% are within (Huber 1964)."""
    usual = _usual_square(r)
    far = jnp.maximum(jnp.sum(r * r, axis=-1), usual)
    root_weight = (usual / far) ** 0.25
    return Rows(r * root_weight[:, None], J * root_weight[:, None, None])


def robust_cost(rows: Rows) -> Float[Array, ""]:
    """Twice the cost of rows that `robust` has weighted."""
    usual = _usual_square(rows.residual)
    square = jnp.sum(rows.residual**2, axis=-1)
    far = square**2 / usual  # the unweighted square where it is beyond
    return jnp.sum(jnp.where(far > usual, 2 * jnp.sqrt(usual * far) - usual, square))


def _usual_square(r: Float[Array, "n m"]) -> float:
    return float(chdtri(r.shape[-1], _UNUSUAL))  # of chi^2
