"""What every pose field is: two pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

Params = Any
PoseFn = Callable[[Float[Array, ""]], Float[Array, "4 4"]]


class PoseField(NamedTuple):
    """A trajectory as two pure functions, in the manner of `optax.adam`.

    `init(key)` returns a parameter pytree; `pose(params, t)` is the pose `T_reference_body` at `t` seconds.
    What the reference is depends on the composition the field is used in (`fields/composition.py`).
    """

    init: Callable[[PRNGKeyArray], Params]
    pose: Callable[[Params, Float[Array, ""]], Float[Array, "4 4"]]
