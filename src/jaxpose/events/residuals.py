"""Change of log intensity against what pixels reported."""

from jaxtyping import Array, Float

from jaxpose.events.simulation import log_intensity


def change_residual(
    rgb_now: Float[Array, "3"],
    rgb_before: Float[Array, "3"],
    change: Float[Array, ""],
    mask: Float[Array, "3"],
    *,
    offset: float = 0.1,
) -> Float[Array, "3"]:
    """Rendered less reported change of log intensity, for the colours that the pixel sees.

    EventNeRF's loss (Rudnev et al., CVPR 2023, eq. 5), before it is squared.

    Args:
        rgb_now: Rendered colour (3,) at the later instant, in [0, 1].
        rgb_before: Rendered colour (3,) at the earlier one.
        change: Sum of polarities between the two instants times the threshold.
        mask: (3,), 1 for the colours that the pixel sees (`mosaic_mask`).
        offset: As in `log_intensity`.

    Returns:
        (3,).

    >>> import jax.numpy as jnp
    >>> change_residual(jnp.ones(3), jnp.ones(3), jnp.zeros(()), jnp.ones(3)).tolist()
    [0.0, 0.0, 0.0]
    """
    return mask * (log_intensity(rgb_now, offset) - log_intensity(rgb_before, offset) - change)
