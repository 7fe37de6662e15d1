"""What the tracked field's output refers to: the paper's table 9, and one of ours, as compositions.

Tracking asks for the body's motion since the last frame, a function of the seconds since then. A frame of
reference turns a field into that. What changes from frame to frame is a traced `ReferenceFrame`, so nothing
recompiles.
"""

from dataclasses import replace
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.fields import Params, PoseField, PoseFn, PoseNetConfig, anchored, in_frame, intrinsic, posenet
from jaxpose.geometry import rigid
from jaxpose.slam.config import FrameName

_INSIDE = 1 - 1e-6  # of the field's span: at its end float32 may round to beyond, where a field stands still


class ReferenceFrame(NamedTuple):
    """Where the field stands against the last frame: its reference there, and its clock."""

    T_ref_field: Float[Array, "4 4"]
    clock: Float[Array, ""]  # [s] of the field's time 0, counted back from the last frame
    rate: Float[Array, ""]  # [1/s] of the field's time, which spans a few units

    def time(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The field's time at `t` [s] since the last frame."""
        return (t + self.clock) * self.rate


@runtime_checkable
class FramedMotion(Protocol):
    """From a field's parameters to the body's motion since the last frame, `t [s] -> T_ref_body`."""

    def __call__(self, params: Params, reference_frame: ReferenceFrame) -> PoseFn: ...


class FramedField(NamedTuple):
    """A field in a frame of reference; `parts` are the outer and the inner field of the frame `intrinsic`."""

    field: PoseField
    motion: FramedMotion
    parts: tuple[PoseField, PoseField] | None = None


def make_field(name: FrameName, config: PoseNetConfig) -> FramedField:
    """The field for a frame of reference of Ma et al. 2024, table 9.

    `anchored` is not the paper's: P(f(0))^-1 . P(f(t)), the identity at the last frame by construction, on a
    clock that starts there and spans a few intervals, so that how fast the field can turn does not depend on
    the length of the recording. The others are the paper's and read the time of the sequence.
    """
    if name == "anchored":
        field = posenet(replace(config, span=(-4.0, 4.0)))  # intervals

        def motion(params, reference_frame):
            zero = jnp.zeros(())
            pose = lambda t: field.pose(params, reference_frame.time(t))
            return anchored(pose, zero, reference_frame.T_ref_field)

        return FramedField(field, motion)

    net = posenet(replace(config, span=(0.0, 1.0)))  # of the sequence
    field = _held(intrinsic(net, net)) if name == "intrinsic" else net

    def motion_in_frame(params, reference_frame):
        pose = lambda t: field.pose(params, reference_frame.time(t))
        return in_frame(pose, reference_frame.T_ref_field)

    return FramedField(field, motion_in_frame, (net, net) if name == "intrinsic" else None)


def _held(field: PoseField) -> PoseField:
    """An intrinsic field whose outer part stays as it is: only `intrinsic_frame.py` changes it."""

    def pose(params, t):
        return field.pose(params | {"outer": jax.lax.stop_gradient(params["outer"])}, t)

    return PoseField(field.init, pose)


def reference_frame(
    name: FrameName,
    *,
    since_first_s: float,
    interval_s: float,
    duration_s: float,
    T_world_ref: np.ndarray,
    T_world_first: np.ndarray,
    generator: np.random.Generator,
) -> ReferenceFrame:
    """The reference at a last frame, `since_first_s` after the first; both frames by the body's poses."""
    T_ref_field = np.eye(4)
    if name == "world":
        T_ref_field = rigid.inverse(T_world_ref) @ T_world_first
    elif name == "random":
        T_ref_field = _perturbation(generator)
    clock, rate = (0.0, 1 / interval_s) if name == "anchored" else (since_first_s, _INSIDE / duration_s)
    return ReferenceFrame(*(jnp.asarray(x, jnp.float32) for x in (T_ref_field, clock, rate)))


def _perturbation(generator: np.random.Generator) -> np.ndarray:
    """A random motion of about 0.1 rad and 0.1 m: the paper does not say how large; we do."""
    turn, shift = generator.normal(0, 0.1, (2, 3))
    return rigid.make(rigid.so3_exp(turn), shift)
