"""Robust elementwise losses and their reductions."""

import chex
import jax.numpy as jnp
from jaxtyping import Array, Float


def weighted_mean(x: Float[Array, "*n"], weight: Float[Array, "*n"]) -> Float[Array, ""]:
    """Mean of `x` under weights >= 0; 0 where all weights are 0. Shapes must be equal: nothing broadcasts."""
    chex.assert_equal_shape([x, weight])
    total = jnp.sum(weight)
    return jnp.sum(x * weight) / jnp.where(total > 0, total, 1)
