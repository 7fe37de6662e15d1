"""What a field refers to: the frames of the paper's table 9 and its intrinsic motion, as compositions.

Where no parameters are added these take and return pose functions `t -> T`, not fields, so that references
may be traced: the next frame's reference then needs no recompilation.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxpose.fields.types import PoseField, PoseFn
from jaxpose.geometry import se3


def refine(field: PoseField, initial: PoseFn, *, side: Literal["body", "world"] = "body") -> PoseField:
    """The field as a correction of known poses: T_init . P on the body's side, P . T_init on the world's.

    On the world's side a rotation turns the body about the world's origin, where NeRF puts the object; this
    is the supplement's T_c,w = T_init . T_refine, whose poses are world-to-camera, with P = T_refine^-1.
    """
    if side == "body":
        return PoseField(field.init, lambda params, t: se3.compose(initial(t), field.pose(params, t)))
    return PoseField(field.init, lambda params, t: se3.compose(field.pose(params, t), initial(t)))


def intrinsic(outer: PoseField, inner: PoseField) -> PoseField:
    """Slow motion of an intrinsic frame times simple motion in it: T_o(t) . T_I(t) (METHOD section 4).

    The parameters are a dict with `outer` and `inner`.
    """

    def init(key):
        outer_key, inner_key = jax.random.split(key)
        return {"outer": outer.init(outer_key), "inner": inner.init(inner_key)}

    def pose(params, t):
        return se3.compose(outer.pose(params["outer"], t), inner.pose(params["inner"], t))

    return PoseField(init, pose)


def piecewise_geodesic(times: Float[Array, " n"], poses: Float[Array, "n 4 4"]) -> PoseFn:
    """The pose between stamped poses at constant twist; before the first and after the last timestamp, these.

    `times` [s] must increase. Both may be traced.
    """

    def pose(t):
        if times.shape[0] == 1:
            return poses[0]
        before = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, times.shape[0] - 2)
        fraction = (t - times[before]) / (times[before + 1] - times[before])
        # Not `jnp.clip`, whose derivative exactly at an end is one half.
        fraction = jnp.where(fraction < 0, 0, jnp.where(fraction > 1, 1, fraction))
        return se3.interpolate(poses[before], poses[before + 1], fraction)

    return pose


def in_frame(pose: PoseFn, T_world_ref: Float[Array, "4 4"]) -> PoseFn:
    """A motion relative to a reference frame, in the world: T_world_ref . P(t).

    With the last camera as reference this is the paper's default frame, perturbed its random frame.
    """
    return lambda t: se3.compose(T_world_ref, pose(t))


def anchored(pose: PoseFn, t_ref: Float[Array, ""], T_world_ref: Float[Array, "4 4"]) -> PoseFn:
    """The field's motion since `t_ref`, put where the body was then: T_world_ref . P(t_ref)^-1 . P(t).

    Equal to `T_world_ref` at `t_ref` by construction; the field is one trajectory up to a rigid transform.
    """
    return lambda t: se3.compose(T_world_ref, se3.compose(se3.inverse(pose(t_ref)), pose(t)))


def body_to_camera(pose: PoseFn, T_body_cam: Float[Array, "4 4"]) -> PoseFn:
    """The camera's pose from the body's: T_world_body(t) . T_body_cam."""
    return lambda t: se3.compose(pose(t), T_body_cam)
