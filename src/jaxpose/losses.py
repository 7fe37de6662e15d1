"""Reductions of elementwise losses, for all rooms that weigh residuals."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def weighted_mean(x: Float[Array, "*n"], weight: Float[Array, "*n"]) -> Float[Array, ""]:
    """Mean under weights; nothing broadcasts, so that a lost axis is an error and not another mean.

    Args:
        x: Values, of any shape.
        weight: Weights >= 0, of the same shape.

    Returns:
        Their weighted mean, 0 where all weights are 0.

    Raises:
        ValueError: For shapes that differ.

    >>> print(weighted_mean(jnp.array([1.0, 5.0]), jnp.array([3.0, 1.0])))
    2.0
    """
    if x.shape != weight.shape:
        raise ValueError(f"x, weight: expected one shape, got {x.shape} and {weight.shape}")
    total = jnp.sum(weight)
    return jnp.sum(x * weight) / jnp.where(total > 0, total, 1)
