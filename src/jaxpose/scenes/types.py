"""What every scene is: two pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

Params = Any


class SceneField(NamedTuple):
    """A scene as two pure functions, in the manner of `optax.adam`.

    `init(key)` returns a parameter pytree. `query(params, point, direction)` returns geometry and colour at
    one point of the world, seen along a direction: geometry is a volume density or a signed distance (the
    family says which, and `render` has the weights that fit), colour is in [0, 1]. For many points,
    `jax.vmap`.
    """

    init: Callable[[PRNGKeyArray], Params]
    query: Callable[
        [Params, Float[Array, "3"], Float[Array, "3"]], tuple[Float[Array, ""], Float[Array, "3"]]
    ]
