"""A pose per frame, as in BARF (Lin et al. 2021): the discrete trajectory that fields are compared with."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose._checks import check_increasing, check_shapes
from jaxpose.fields.types import Factor, Params, PoseField, clock_origin, described, float_type, since
from jaxpose.geometry import se3


def per_frame_poses(times: Float[Array | np.ndarray, " n"]) -> PoseField:
    """One free twist per timestamp; the pose at `t` is that of the nearest timestamp.

    Args:
        times: timestamps (n,) [s], increasing.

    Returns:
        A field whose parameters are an array (n, 6), zero at init. Every derivative in time is zero.

    Raises:
        ValueError: no timestamps, or such that do not increase.

    >>> field = per_frame_poses(np.array([0.0, 1.0]))
    >>> params = jnp.zeros((2, 6)).at[1, 0].set(3.0)
    >>> print(field.pose(params, 0.6)[:3, 3])
    [3. 0. 0.]
    """
    timestamps = np.asarray(times, np.float64)
    check_shapes(times=(timestamps, "n"))
    check_increasing(times=timestamps)
    if timestamps.size == 0:
        raise ValueError("times: expected at least one, got none")
    return described(PerFramePoses(tuple(timestamps.tolist())))


@dataclass(frozen=True)
class PerFramePoses:
    """The description of `per_frame_poses`."""

    times: tuple[float, ...]

    @property
    def span(self) -> tuple[float, float]:
        return self.times[0], self.times[-1]

    def init(self, key) -> Params:
        del key  # the identity needs no chance
        return jnp.zeros((len(self.times), 6))

    def pose(self, params, t):
        origin, dtype = clock_origin(self.span), float_type(params)
        times = np.array(self.times)
        borders = jnp.asarray((times[1:] + times[:-1]) / 2 - origin, dtype)
        return se3.exp(params[jnp.searchsorted(borders, since(origin, t, self.span, dtype))])

    def factors(self, params) -> tuple[Factor, ...]:
        poses = np.asarray(jax.jit(se3.exp)(params))
        return ({"kind": "table", "times": np.array(self.times), "poses": poses},)

    def shifted(self, seconds: float) -> "PerFramePoses":
        return replace(self, times=tuple(t + seconds for t in self.times))


def from_factor(factor: Factor) -> tuple[PoseField, Params]:
    """The field and the parameters that `PerFramePoses.factors` wrote."""
    return per_frame_poses(factor["times"]), se3.log(jnp.asarray(factor["poses"], jnp.zeros(()).dtype))
