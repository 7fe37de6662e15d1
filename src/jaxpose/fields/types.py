"""What every pose field is: two pure functions of one time, and the description that they follow from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

Params = Any
Span = tuple[float, float]  # first and last time [s]
Time = Any  # one time [s]: a float, an int, or a numpy or jax array of shape ()
PoseFn = Callable[[Time], Float[Array, "4 4"]]
Factor = Mapping[str, Any]  # of a trajectory's file: what is written in `fields/serialization.py`

_COARSE = 1e-3  # of a span: times that are further apart than this do not tell a motion


@runtime_checkable
class Description(Protocol):
    """A field as a value: frozen, hashable, equal to another that describes the same field."""

    @property
    def span(self) -> Span:
        """First and last time [s]; outside of it the field stands still."""
        ...

    def init(self, key: PRNGKeyArray) -> Params: ...

    def pose(self, params: Params, t: Time) -> Float[Array, "4 4"]: ...

    def factors(self, params: Params) -> tuple[Factor, ...]:
        """What a file says of the field with these parameters."""
        ...

    def shifted(self, seconds: float) -> "Description":
        """The same motion so many seconds later."""
        ...


class PoseField(NamedTuple):
    """A trajectory as two pure functions, in the manner of `optax.adam`.

    `init(key)` returns a parameter pytree; `pose(params, t)` is the pose `T_reference_body` (4, 4) at one
    time `t` [s]. What the reference is depends on the composition that the field is used in.

    All fields of this package keep one contract on `t`. It is a float, an int, or a numpy or jax array of
    shape (); another shape is a ValueError, and many times are `jax.vmap(field.pose, (None, 0))(params,
    times)`. Outside its `span` a field stands still at the pose of the span's end: all derivatives are zero
    there, and at the ends they are those from inside. Python numbers and numpy's are taken in float64, so
    that seconds since 1970 lose nothing; a float32 array that cannot tell times within the span apart is
    refused.

    A field with a `description` equals every field of the same configuration, so that `jax.jit` compiles once
    for all of them, and can be saved (`fields.save`) and moved in time (`fields.shifted`). One made of
    functions alone, `PoseField(init, pose)`, works everywhere else.
    """

    init: Callable[[PRNGKeyArray], Params]
    pose: Callable[[Params, Time], Float[Array, "4 4"]]
    description: Description | None = None

    @property
    def span(self) -> Span:
        """First and last time [s] of the field; infinite where it does not say."""
        return (-np.inf, np.inf) if self.description is None else self.description.span


@dataclass(frozen=True)
class _Method:
    """A method of a description as a function that equals the same method of an equal description."""

    description: Any
    name: str

    def __call__(self, *arguments: Any) -> Any:
        return getattr(self.description, self.name)(*arguments)


def described(description: Description) -> PoseField:
    """The field of a description."""
    return PoseField(_Method(description, "init"), _Method(description, "pose"), description)


def shifted(field: PoseField, seconds: float) -> PoseField:
    """The same motion so many seconds later, with the same parameters.

    Args:
        field: a field with a description.
        seconds: added to its clock.

    Returns:
        A field with `shifted(field, s).pose(params, t + s)` equal to `field.pose(params, t)`.

    Raises:
        ValueError: the field is made of functions alone.

    >>> from jaxpose.fields import bspline
    >>> shifted(bspline((1.4e9, 1.4e9 + 5), intervals=10), -1.4e9).span
    (0.0, 5.0)
    """
    if field.description is None:
        raise ValueError("shifted: expected a field with a description, got one of functions alone")
    return described(field.description.shifted(seconds))


class Constant:
    """A numpy array that cannot be written to and compares by its values."""

    def __init__(self, array: Any):
        self.array = np.array(array)
        self.array.flags.writeable = False
        self._values = (self.array.shape, self.array.dtype.str, self.array.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constant) and self._values == other._values

    def __hash__(self) -> int:
        return hash(self._values)

    def __repr__(self) -> str:
        return f"Constant{self.array.shape}"


def within(t: Time, span: Span) -> Any:
    """One time, clamped to the span: numbers and numpy arrays as a float, jax arrays in their own type.

    Raises:
        ValueError: `t` is not one real number, or its type cannot tell times within the span apart.
    """
    if np.shape(t) != ():
        raise ValueError(
            f"t: expected one time [s], a number or an array of shape (), got shape {np.shape(t)}; for many "
            "times: jax.vmap(field.pose, (None, 0))(params, times)"
        )
    first, last = span
    if not isinstance(t, jax.Array):
        return float(np.clip(float(t), first, last))
    if not jnp.issubdtype(t.dtype, jnp.floating):
        if not jnp.issubdtype(t.dtype, jnp.integer):
            raise ValueError(f"t: expected a real number of seconds, got {t.dtype}")
        t = t.astype(jnp.zeros(()).dtype)
    if is_coarse(span, t.dtype):
        raise ValueError(
            f"t: expected a type that tells times within {first} to {last} s apart, got {t.dtype}; move the "
            "field to a clock of small numbers (jaxpose.fields.shifted) or give Python's or numpy's numbers"
        )
    # Not `jnp.clip`, whose derivative exactly at an end is one half.
    return jnp.where(t < first, first, jnp.where(t > last, last, t))


def since(origin: float, t: Time, span: Span, dtype: Any) -> Float[Array, ""]:
    """The time from `origin`, clamped to the span; of Python's and numpy's numbers exactly."""
    t = within(t, span)
    return (t - origin).astype(dtype) if isinstance(t, jax.Array) else jnp.asarray(t - origin, dtype)


def is_coarse(span: Span, dtype: Any) -> bool:
    """Whether times of this type cannot tell moments within the span apart."""
    first, last = span
    if not first < last or not np.isfinite([first, last]).all():
        return False
    return bool(float(jnp.finfo(dtype).eps) * max(abs(first), abs(last)) > _COARSE * (last - first))


def clock_origin(span: Span) -> float:
    """The time [s] from which float32 counts within the span: 0 where that is fine enough."""
    return span[0] if is_coarse(span, jnp.float32) else 0.0


def float_type(params: Params) -> Any:
    """The floating-point type of parameters; the default one where there are none."""
    types = [leaf.dtype for leaf in jax.tree.leaves(params) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return types[0] if types else jnp.zeros(()).dtype
