"""A pose per frame, as in BARF: the discrete trajectory that continuous ones are compared with."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.fields.types import PoseField
from jaxpose.geometry import se3


def table(times: Float[Array | np.ndarray, " n"]) -> PoseField:
    """One free twist per timestamp [s], zero at init; the pose at `t` is that of the nearest timestamp.

    The parameters are an array (n, 6). Every derivative in time is zero. `times` must increase.
    """
    timestamps = np.asarray(times, np.float64)
    if timestamps.size == 0 or not np.all(np.diff(timestamps) > 0):
        raise ValueError("times: expected at least one timestamp, increasing")
    borders = (timestamps[1:] + timestamps[:-1]) / 2

    def init(key):
        del key  # the identity needs no chance
        return jnp.zeros((timestamps.size, 6))

    def pose(params, t):
        return se3.exp(params[jnp.searchsorted(jnp.asarray(borders, t.dtype), t)])

    return PoseField(init, pose)
