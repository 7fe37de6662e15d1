"""Pose fields as warps of the plane: what the planar experiment optimises, patch 0 held at the identity."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.interpolate import CubicSpline

from jaxpose import fields
from jaxpose.fields import Params, PoseNetConfig

Pose = Literal["posenet", "per_frame", "spline_reset", "bspline"]
SPLINE_KNOTS = 5  # of both splines, ends included
RESET_EVERY = 100  # steps
_BARF = 1e-3  # Adam's rate of per-frame poses, BARF's
_SERIES = 12  # terms of the matrix exponential after the identity; BARF keeps 10


class Warps(NamedTuple):
    """Warps as two pure functions, and how to optimise them.

    `warps(params)` are the patches' `H_image_patch`, the first of them the identity whatever the parameters.
    """

    init: Callable[[PRNGKeyArray], Params]
    warps: Callable[[Params], Float[Array, "n 3 3"]]
    rates: Any  # Adam's at the start, a prefix of the parameters
    decay: float  # of the rates, exponential, over the whole run; 1: constant
    reset: Float[np.ndarray, "n n"] | None = (
        None  # what per-frame poses are multiplied by every RESET_EVERY steps
    )


def motion_warps(pose: Pose, patches: int, net: PoseNetConfig) -> Warps:
    """SE(2) motions from a pose field on SE(3) (a PoseNet as `net` says), at equal steps from -1 to 1.

    Of a pose the translation in x and y counts, and the rotation about z nearest to its own. All warps are
    relative to the first, which fixes the reference frame; the first of per-frame poses stays zero, as BARF
    has it.
    """
    timestamps = np.linspace(-1, 1, patches)
    if pose == "posenet":
        # A third and a half of the rates for NeRF, with which the field may run out of the image.
        field, rates, decay = fields.posenet(net), {"translation": 3e-4, "rotation": 1e-4}, 0.03
    elif pose == "bspline":
        field, rates, decay = fields.bspline((-1.0, 1.0), SPLINE_KNOTS - 1), _BARF, 0.03
    else:
        field, rates, decay = fields.per_frame_poses(timestamps), _BARF, 0.03

    def warps(params):
        if pose in ("per_frame", "spline_reset"):
            params = params.at[0].set(0)
        times = jnp.asarray(timestamps, jax.tree.leaves(params)[0].dtype)
        return _since_first(planar(jax.vmap(field.pose, (None, 0))(params, times)))

    reset = spline_projection(patches, SPLINE_KNOTS) if pose == "spline_reset" else None
    return Warps(field.init, warps, rates, decay, reset)


def homography_warps(patches: int) -> Warps:
    """A free sl(3) generator of 8 numbers per patch, as in BARF."""

    def init(key):
        del key  # the identity needs no chance
        return jnp.zeros((patches, 8))

    return Warps(init, lambda params: homography(params.at[0].set(0)), _BARF, 1.0)


def planar(T: Float[Array, "*n 4 4"]) -> Float[Array, "*n 3 3"]:
    """The motion of the plane nearest to a pose: its x, y and the rotation about z closest to its own."""
    cosine, sine = T[..., 0, 0] + T[..., 1, 1], T[..., 1, 0] - T[..., 0, 1]
    length = jnp.sqrt(cosine**2 + sine**2)  # zero only half a turn out of the plane
    return _rigid(cosine / length, sine / length, T[..., 0, 3], T[..., 1, 3])


def coordinates(H: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """x, y and the angle [rad] of rigid motions of the plane: what `task.rigid` takes."""
    return jnp.stack([H[..., 0, 2], H[..., 1, 2], jnp.atan2(H[..., 1, 0], H[..., 0, 0])], axis=-1)


def homography(h: Float[Array, "*n 8"]) -> Float[Array, "*n 3 3"]:
    """The matrix exponential of BARF's basis of sl(3), by its series: for entries below 1."""
    h1, h2, h3, h4, h5, h6, h7, h8 = (h[..., k] for k in range(8))
    A = jnp.stack([h5, h3, h1, h4, -h5 - h6, h2, h7, h8, h6], axis=-1).reshape(*h.shape[:-1], 3, 3)
    eye = jnp.broadcast_to(jnp.eye(3, dtype=h.dtype), A.shape)
    result = eye
    for k in range(_SERIES, 0, -1):
        result = eye + jnp.matmul(A, result, precision="highest") / k
    return result


def apply(H_a_b: Float[Array, "3 3"], xy: Float[Array, "2"]) -> Float[Array, "2"]:
    """A point of the plane under a homogeneous matrix."""
    moved = H_a_b[:, 0] * xy[0] + H_a_b[:, 1] * xy[1] + H_a_b[:, 2]
    return moved[:2] / moved[2]


def spline_projection(count: int, knots: int) -> Float[np.ndarray, "n n"]:
    """The matrix that replaces `count` values at equal steps by the least-squares natural cubic spline.

    The spline has `knots` equally spaced knots, both ends counted, and so as many degrees of freedom.
    """
    # One with free ends has two more: five knots would pass through seven values and smooth nothing.
    spline = CubicSpline(np.linspace(0, 1, knots), np.eye(knots), bc_type="natural")
    at_values = spline(np.linspace(0, 1, count))
    return at_values @ np.linalg.pinv(at_values)


def _since_first(H: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    """Motions of the plane relative to the first: H_0^-1 H_i."""
    cosine, sine = H[0, 0, 0], H[0, 1, 0]
    x, y = H[:, 0, 2] - H[0, 0, 2], H[:, 1, 2] - H[0, 1, 2]
    return _rigid(
        cosine * H[:, 0, 0] + sine * H[:, 1, 0],
        cosine * H[:, 1, 0] - sine * H[:, 0, 0],
        cosine * x + sine * y,
        cosine * y - sine * x,
    )


def _rigid(
    cosine: Float[Array, "*n"], sine: Float[Array, "*n"], x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> Float[Array, "*n 3 3"]:
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    return jnp.stack([cosine, -sine, x, sine, cosine, y, zero, zero, one], axis=-1).reshape(*x.shape, 3, 3)
