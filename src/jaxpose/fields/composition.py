"""What a field refers to: products of fields, the frames of the paper's table 9 and its intrinsic motion.

Products of fields are fields: they are saved and compared as these are. `in_frame`, `anchored` and
`body_to_camera` take and return pose functions `t -> T`, so that their references may be traced: the next
frame's reference then needs no recompilation.
"""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose._checks import check_increasing, check_shapes
from jaxpose.fields.types import (
    Constant,
    Factor,
    Params,
    PoseField,
    PoseFn,
    Span,
    clock_origin,
    described,
    float_type,
    shifted,
    since,
    within,
)
from jaxpose.geometry import se3


def product(*fields: PoseField) -> PoseField:
    """The product of fields at the same time: `fields[0].pose(t) @ fields[1].pose(t) @ ...`.

    Args:
        fields: one or more fields. A camera on a moving body is `product(body, constant(T_body_cam))`.

    Returns:
        A field whose parameters are a tuple of those of the factors. Its span is what the spans of the
        factors have in common.

    Raises:
        ValueError: no fields, or such whose spans have nothing in common.

    >>> field = product(constant(jnp.eye(4)), constant(jnp.eye(4)))
    >>> field.pose(({}, {}), 0.0).shape
    (4, 4)
    """
    return _composed("product", fields)


def right_correction(correction: PoseField, initial: PoseField) -> PoseField:
    """Known poses corrected in the body's axes: T_initial(t) . P(t).

    Args:
        correction: the field P, whose parameters are those of the result.
        initial: a field without parameters, such as `piecewise_geodesic` or `constant`.

    Returns:
        A field of the correction's parameters, in the span that both have in common.

    Raises:
        ValueError: `initial` has parameters (`product` takes such), or the spans have nothing in common.
    """
    return _composed("right_correction", (_without_parameters(initial), correction))


def left_correction(correction: PoseField, initial: PoseField) -> PoseField:
    """Known poses corrected in the world's axes: P(t) . T_initial(t).

    A rotation turns the body about the world's origin, where NeRF puts the object. This is the supplement's
    T_c,w = T_init . T_refine (Ma et al. 2024), whose poses are world-to-camera, with P = T_refine^-1.

    Args:
        correction: the field P, whose parameters are those of the result.
        initial: a field without parameters, such as `piecewise_geodesic` or `constant`.

    Returns:
        A field of the correction's parameters, in the span that both have in common.

    Raises:
        ValueError: `initial` has parameters (`product` takes such), or the spans have nothing in common.
    """
    return _composed("left_correction", (correction, _without_parameters(initial)))


def intrinsic(outer: PoseField, inner: PoseField) -> PoseField:
    """Slow motion of an intrinsic frame times simple motion in it: T_o(t) . T_I(t) (Ma et al. 2024, 3.3).

    Args:
        outer: the field of the frame, in the world.
        inner: the field of the body, in the frame.

    Returns:
        A field whose parameters are a dict with `outer` and `inner`.

    Raises:
        ValueError: spans that have nothing in common.
    """
    return _composed("intrinsic", (outer, inner))


def constant(T: Float[Array | np.ndarray, "4 4"]) -> PoseField:
    """A pose that does not move, as a field without parameters (they are an empty dict).

    Args:
        T: a rigid transform (4, 4).

    Returns:
        A field whose span is endless.

    >>> print(constant(jnp.eye(4)).pose({}, 3.0)[0])
    [1. 0. 0. 0.]
    """
    return piecewise_geodesic(np.zeros(1), np.asarray(T)[None])


def piecewise_geodesic(
    times: Float[Array | np.ndarray, " n"], poses: Float[Array | np.ndarray, "n 4 4"]
) -> PoseField:
    """Stamped poses and constant twist between them, as a field without parameters (an empty dict).

    Args:
        times: timestamps (n,) [s], increasing. With a single one the pose holds at all times.
        poses: rigid transforms (n, 4, 4).

    Returns:
        A field from the first timestamp to the last; before and after it stands still, as any field.

    Raises:
        ValueError: shapes that do not belong together, or times that do not increase.

    >>> poses = se3.exp(jnp.array([[0.0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0]]))
    >>> print(piecewise_geodesic(np.array([0.0, 2.0]), poses).pose({}, 0.5)[:3, 3])
    [0.25 0.   0.  ]
    """
    timestamps, matrices = np.asarray(times, np.float64), np.asarray(poses)
    check_shapes(times=(timestamps, "n"), poses=(matrices, "n 4 4"))
    check_increasing(times=timestamps)
    if timestamps.size == 0:
        raise ValueError("times: expected at least one, got none")
    return described(_PiecewiseGeodesic(Constant(timestamps), Constant(matrices)))


def in_frame(pose: PoseFn, T_world_ref: Float[Array, "4 4"]) -> PoseFn:
    """A motion relative to a reference frame, in the world: T_world_ref . P(t).

    With the last camera as reference this is the paper's default frame, perturbed its random frame (table 9).

    Args:
        pose: P, a function of time [s].
        T_world_ref: the pose (4, 4) of the reference frame; it may be traced.

    Returns:
        A function of time to `T_world_body` (4, 4).
    """
    return lambda t: se3.compose(T_world_ref, pose(t))


def anchored(pose: PoseFn, t_ref: Any, T_world_ref: Float[Array, "4 4"]) -> PoseFn:
    """The field's motion since `t_ref` [s], put where the body was then: T_world_ref . P(t_ref)^-1 . P(t).

    Equal to `T_world_ref` at `t_ref` by construction; the field is one trajectory up to a rigid transform.

    Args:
        pose: P, a function of time [s].
        t_ref: a time [s], and
        T_world_ref: the pose (4, 4) of the body then; both may be traced.

    Returns:
        A function of time to `T_world_body` (4, 4).
    """
    return lambda t: se3.compose(T_world_ref, se3.compose(se3.inverse(pose(t_ref)), pose(t)))


def body_to_camera(pose: PoseFn, T_body_cam: Float[Array, "4 4"]) -> PoseFn:
    """The camera's pose from the body's: T_world_body(t) . T_body_cam.

    Args:
        pose: of the body, a function of time [s].
        T_body_cam: the camera's pose (4, 4) on the body; it may be traced.

    Returns:
        A function of time to `T_world_cam` (4, 4).
    """
    return lambda t: se3.compose(pose(t), T_body_cam)


_Kind = Literal["product", "intrinsic", "left_correction", "right_correction"]


@dataclass(frozen=True)
class Composition:
    """The description of a product of fields; the kind says which of them have parameters, and where."""

    kind: _Kind
    fields: tuple[PoseField, ...]

    @property
    def span(self) -> Span:
        spans = [field.span for field in self.fields]
        return max(first for first, _ in spans), min(last for _, last in spans)

    def init(self, key) -> Params:
        if self.kind == "left_correction":
            return self.fields[0].init(key)
        if self.kind == "right_correction":
            return self.fields[1].init(key)
        keys = jax.random.split(key, len(self.fields))
        params = tuple(field.init(key) for field, key in zip(self.fields, keys, strict=True))
        return params if self.kind == "product" else {"outer": params[0], "inner": params[1]}

    def pose(self, params, t):
        t = within(t, self.span)
        pairs = zip(self.fields, self.parts(params), strict=True)
        first, *others = (field.pose(part, t) for field, part in pairs)
        dtype = float_type(params) if jax.tree.leaves(params) else first.dtype
        T = first.astype(dtype)
        for other in others:
            T = se3.compose(T, other.astype(dtype))
        return T

    def parts(self, params: Params) -> tuple[Params, ...]:
        """The parameters of each factor."""
        return {
            "product": lambda: tuple(params),
            "intrinsic": lambda: (params["outer"], params["inner"]),
            "left_correction": lambda: (params, {}),
            "right_correction": lambda: ({}, params),
        }[self.kind]()

    def factors(self, params) -> tuple[Factor, ...]:
        found = []
        for field, part in zip(self.fields, self.parts(params), strict=True):
            if field.description is None:
                raise ValueError("expected fields with a description, got one of functions alone")
            found.extend(field.description.factors(part))
        return tuple(found)

    def shifted(self, seconds: float) -> "Composition":
        return Composition(self.kind, tuple(shifted(field, seconds) for field in self.fields))


@dataclass(frozen=True)
class _PiecewiseGeodesic:
    """The description of `piecewise_geodesic`."""

    times: Constant
    poses: Constant

    @property
    def span(self) -> Span:
        times = self.times.array
        return (float(times[0]), float(times[-1])) if len(times) > 1 else (-np.inf, np.inf)

    def init(self, key) -> Params:
        del key
        return {}

    def pose(self, params, t):
        del params
        span = self.span
        dtype = t.dtype if isinstance(t, jax.Array) and jnp.issubdtype(t.dtype, jnp.floating) else None
        poses = jnp.asarray(self.poses.array, dtype or jnp.zeros(()).dtype)
        if len(poses) == 1:
            within(t, span)  # for what it refuses
            return poses[0]
        origin = clock_origin(span)
        t = since(origin, t, span, poses.dtype)
        times = jnp.asarray(self.times.array - origin, poses.dtype)
        before = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        fraction = (t - times[before]) / (times[before + 1] - times[before])
        return se3.interpolate(poses[before], poses[before + 1], fraction)

    def factors(self, params) -> tuple[Factor, ...]:
        del params
        return ({"kind": "stamped", "times": self.times.array, "poses": self.poses.array},)

    def shifted(self, seconds: float) -> "_PiecewiseGeodesic":
        return _PiecewiseGeodesic(Constant(self.times.array + seconds), self.poses)


def from_factor(factor: Factor) -> tuple[PoseField, Params]:
    """The field and the (empty) parameters of a factor that `piecewise_geodesic` wrote."""
    return piecewise_geodesic(factor["times"], factor["poses"]), {}


def _composed(kind: _Kind, fields: tuple[PoseField, ...]) -> PoseField:
    if not fields:
        raise ValueError(f"{kind}: expected at least one field, got none")
    description = Composition(kind, tuple(fields))
    first, last = description.span
    if not first <= last:
        spans = ", ".join(f"({a:g}, {b:g})" for a, b in (field.span for field in fields))
        raise ValueError(f"{kind}: expected fields whose spans [s] have time in common, got {spans}")
    return described(description)


def _without_parameters(initial: PoseField) -> PoseField:
    if not isinstance(initial, PoseField):
        raise ValueError(
            "initial: expected a field without parameters (fields.constant, fields.piecewise_geodesic), got "
            f"{type(initial).__name__}"
        )
    if jax.tree.leaves(jax.eval_shape(initial.init, jax.random.key(0))):
        raise ValueError("initial: expected a field without parameters, got one with: use `fields.product`")
    return initial
