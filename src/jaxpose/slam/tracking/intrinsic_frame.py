"""The intrinsic frame of a run, brought to the motions of the last frames at every keyframe of its own.

The paper optimises f_o every ten frames, and f_I in every one (section 3.3). Here f_o takes what makes the
last ten motions simple, T_I = T_o^-1 . T being exact throughout, and f_I is then brought to the T_I.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxpose.fields import Params, PoseField, project_onto_poses
from jaxpose.fields.intrinsic_motion import dof_loss, outer_loss
from jaxpose.geometry import se3
from jaxpose.optim import minimize

EVERY = 10  # frames
_STEPS = 400
_RATE = 1e-3
_DECAY = 0.1
_OUTER = 10.0  # of L_o [1/m]: moving T_o by 10 cm costs as much as one degree of freedom
_RECENT = 4  # motions that f_I is brought to

Refit = Callable[[Params, Float[Array, " k"], Float[Array, "k 4 4"]], tuple[Params, Float[Array, "k 4 4"]]]


def make_refit(outer: PoseField, inner: PoseField, angle_of_view: float) -> Refit:
    """The compiled step `refit(params, t, T) -> (params, T_inner)`.

    `params` are those of `fields.intrinsic`, `T` (k, 4, 4) the motions of the frames at `t` [s] since the
    frame before each.
    """
    adam = optax.adam(optax.exponential_decay(_RATE, _STEPS, _DECAY))

    def loss(params, t, T):
        T_outer = jax.vmap(partial(outer.pose, params))(t)
        T_inner = se3.compose(se3.inverse(T_outer), T)
        return jnp.mean(dof_loss(T_inner, angle_of_view) + _OUTER * outer_loss(T_outer))

    @jax.jit
    def refit(params, t, T):
        found = minimize(lambda outer, _: loss(outer, t, T), params["outer"], adam, _STEPS).params
        T_outer = jax.vmap(partial(outer.pose, found))(t)
        T_inner = se3.compose(se3.inverse(T_outer), T)
        recent = lambda p: jax.vmap(partial(inner.pose, p))(t[-_RECENT:])
        return {
            "outer": found,
            "inner": project_onto_poses(recent, params["inner"], T_inner[-_RECENT:]),
        }, T_inner

    return refit


def is_due(i: int) -> bool:
    """Whether the intrinsic frame is brought to the motions so far after frame `i`."""
    return i > 0 and i % EVERY == 0


def window(i: int) -> np.ndarray:
    """The frames whose motions count after frame `i`: the last ten; of fewer the first is repeated."""
    return np.maximum(np.arange(i - EVERY + 1, i + 1), 1)
