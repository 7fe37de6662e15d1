"""What every scene is: two pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

Params = Any


class SceneField(NamedTuple):
    """A scene as two pure functions, in the manner of `optax.adam`.

    `init(key)` returns a parameter pytree; `query(params, point, direction)` is what stands at a point of the
    world [m] seen along a direction: its geometry (a volume density or a signed distance; the family says
    which, and `render.py` has the weights that fit) and its colour in [0, 1].
    """

    init: Callable[[PRNGKeyArray], Params]
    query: Callable[
        [Params, Float[Array, "3"], Float[Array, "3"]], tuple[Float[Array, ""], Float[Array, "3"]]
    ]
