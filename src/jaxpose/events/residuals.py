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
    """Rendered minus reported change of log intensity, for the colours the pixel sees (EventNeRF's loss).

    `change` is the sum of polarities between the two instants times the threshold.
    """
    return mask * (log_intensity(rgb_now, offset) - log_intensity(rgb_before, offset) - change)
