"""What the tracked field's output refers to: the paper's table 9, and one of ours, as compositions.

Tracking asks for the body's motion since the last frame, a function of the seconds since then. A frame of
reference turns a field into that. What changes from frame to frame is a traced `ReferenceFrame`, so nothing
recompiles.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxpose.fields import Params, PoseField, PoseFn, PoseNetConfig, anchored, in_frame, intrinsic, posenet

FrameName = Literal["anchored", "default", "world", "random", "intrinsic"]


class ReferenceFrame(NamedTuple):
    """Where the field stands against the last frame: its reference there, and its clock then."""

    T_ref_field: Float[Array, "4 4"]
    clock: Float[Array, ""]  # [s]


Motion = Callable[[Params, ReferenceFrame], PoseFn]


class FramedField(NamedTuple):
    """A field in a frame of reference.

    `motion` is the body's since the last frame. `direct` is the same without the anchor: equal to it where
    the field is the identity at the last frame, and without the anchor's freedom of gauge. `parts` are the
    outer and the inner field of the frame `intrinsic`.
    """

    field: PoseField
    motion: Motion
    direct: Motion
    parts: tuple[PoseField, PoseField] | None = None


def make_field(name: FrameName, config: PoseNetConfig, interval_s: float, duration_s: float) -> FramedField:
    """The field for a frame of reference of table 9.

    `anchored` is ours: P(f(0))^-1 . P(f(t)), the identity at the last frame by construction, on a clock that
    starts there and spans a few intervals, so that how fast the field can turn does not depend on the length
    of the recording. The others are the paper's and read the time of the sequence.
    """
    if name == "anchored":
        field = posenet(replace(config, span=(-4 * interval_s, 4 * interval_s)))

        def motion(params, reference_frame):
            zero = jnp.zeros(())
            return anchored(lambda t: field.pose(params, t), zero, reference_frame.T_ref_field)

        return FramedField(field, motion, lambda params, reference_frame: lambda t: field.pose(params, t))

    net = posenet(replace(config, span=(0.0, duration_s)))
    field = _held(intrinsic(net, net)) if name == "intrinsic" else net

    def motion_in_frame(params, reference_frame):
        return in_frame(lambda t: field.pose(params, t + reference_frame.clock), reference_frame.T_ref_field)

    return FramedField(field, motion_in_frame, motion_in_frame, (net, net) if name == "intrinsic" else None)


def _held(field: PoseField) -> PoseField:
    """An intrinsic field whose outer part stays as it is: only `reframe.py` changes it."""

    def pose(params, t):
        return field.pose(params | {"outer": jax.lax.stop_gradient(params["outer"])}, t)

    return PoseField(field.init, pose)


def reference_frame(
    name: FrameName,
    t_s: float,
    T_world_ref: np.ndarray,
    T_world_first: np.ndarray,
    generator: np.random.Generator,
) -> ReferenceFrame:
    """The gauge at a last frame at `t_s` seconds: poses of the body there and at the first frame."""
    T_ref_field = np.eye(4)
    if name == "world":
        T_ref_field = np.linalg.inv(T_world_ref) @ T_world_first
    elif name == "random":
        T_ref_field = _perturbation(generator)
    return ReferenceFrame(jnp.asarray(T_ref_field, jnp.float32), jnp.asarray(t_s, jnp.float32))


def _perturbation(generator: np.random.Generator) -> np.ndarray:
    """A random motion of about 0.1 rad and 0.1 m: the paper does not say how large; we do."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(generator.normal(0, 0.1, 3)).as_matrix()
    T[:3, 3] = generator.normal(0, 0.1, 3)
    return T
