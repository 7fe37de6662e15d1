"""What else was measured of a camera's motion, as residuals that users write."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxpose._checks import check_finite, check_shapes
from jaxpose.fields.types import Span
from jaxpose.geometry import se3


class Factor(NamedTuple):
    """Measurements of one kind, each at a time of its own.

    Attributes:
        t: times (n,) [s] on the poses' clock, in any order.
        residual: `residual(T_world_cam, twist, datum)`, (4, 4), (6,) and one measurement: predicted less
            measured in multiples of one sigma, (m,). The twist is the camera's velocity [m/s] and rate
            [rad/s] in its own axes. It is differentiated, and compiled once for the same function. What is
            further off than 99% are expected to be counts by its size, not by its square.
        data: the measurements, an array (n, ...) or a pytree of such.

    >>> speed = lambda T_world_cam, twist, forward: (twist[2:3] - forward) / 0.05  # a wheel: 5 cm/s
    >>> wheel = Factor(np.linspace(0.0, 2.0, 100), speed, np.full(100, 0.8))
    """

    t: ArrayLike
    residual: Callable[[Float[Array, "4 4"], Float[Array, "6"], Any], Float[Array, " m"]]
    data: Any


def position_factor(
    t: ArrayLike,
    position_world: ArrayLike,
    sigma_m: float | ArrayLike,
    point_cam: ArrayLike = (0.0, 0.0, 0.0),
) -> Factor:
    """Positions of a point that moves with the camera, as satellites or a laser tracker tell them.

    Args:
        t: times (n,) [s] on the poses' clock.
        position_world: where the point was (n, 3) [m].
        sigma_m: one sigma, a number, (3,) along the world's axes, or (n, 3).
        point_cam: the point in the camera's frame (3,) [m], an antenna for example.

    Returns:
        A factor for `smooth`.

    Raises:
        ValueError: shapes or sigmas that cannot be.

    >>> position_factor([0.0, 1.0], np.zeros((2, 3)), 0.02).data["position"].shape
    (2, 3)
    """
    t, position, point = (np.asarray(x, np.float64) for x in (t, position_world, point_cam))
    check_shapes(t=(t, "n"), position_world=(position, f"{t.size} 3"), point_cam=(point, "3"))
    sigma = np.asarray(sigma_m, np.float64)
    if sigma.shape not in ((), (3,), position.shape) or not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise ValueError(
            f"sigma_m: expected numbers above 0 of shape (), (3,) or {position.shape}, got {sigma_m}"
        )
    every = {"position": position, "sigma": sigma, "point": point}
    return Factor(t, _off_position, {name: np.broadcast_to(x, position.shape) for name, x in every.items()})


def _off_position(T_world_cam, twist, datum):
    return (se3.apply(T_world_cam, datum["point"]) - datum["position"]) / datum["sigma"]


def checked(factors: Sequence[Factor], span: Span) -> tuple[Factor, ...]:
    """Factors with float64 arrays and functions that jit takes; ValueError for what cannot be used.

    Args:
        factors: as users give them.
        span: first and last time of the poses.
    """
    return tuple(_checked(factor, f"factors[{k}]", span) for k, factor in enumerate(factors))


def _checked(factor: Factor, name: str, span: Span) -> Factor:
    t = np.asarray(factor.t, np.float64)
    check_shapes(**{f"{name}.t": (t, "n")})
    check_finite(**{f"{name}.t": t})
    if len(t) and (t.min() < span[0] or t.max() > span[1]):
        beyond = t.min() if t.min() < span[0] else t.max()
        poses = f"between {span[0]:.6g} and {span[1]:.6g} s (the poses)"
        raise ValueError(f"{name}.t: expected times {poses}, got {beyond:.6g}")
    floats = lambda x: np.asarray(x, np.float64) if np.asarray(x).dtype.kind == "f" else np.asarray(x)
    data = jax.tree.map(floats, factor.data)
    for x in jax.tree.leaves(data):
        check_shapes(**{f"{name}.data": (x, " ".join(map(str, (len(t), *x.shape[1:]))))})
        if x.dtype.kind == "f":
            check_finite(**{f"{name}.data": x})
    with jax.enable_x64(True):
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), data)
        pose, twist = (jax.ShapeDtypeStruct(shape, jnp.float64) for shape in ((4, 4), (6,)))
        found = jax.eval_shape(factor.residual, pose, twist, one)
    if not isinstance(found, jax.ShapeDtypeStruct) or len(found.shape) != 1 or found.dtype != jnp.float64:
        raise ValueError(f"{name}.residual: expected an array (m,) of floating-point numbers, got {found}")
    return Factor(t, jax.tree_util.Partial(factor.residual), data)


def linearised(
    factor: Factor,
    T: Float[Array, "n 4 4"],
    J_pose: Float[Array, "n 6 k"],
    twist: Float[Array, "n 6"],
    J_twist: Float[Array, "n 6 k"],
) -> tuple[Float[Array, "n m"], Float[Array, "n m k"]]:
    """Residuals and their derivatives by whatever the camera's motion was derived by."""

    def moved(increment, faster, T, twist, datum):
        return factor.residual(se3.compose(T, se3.exp(increment)), twist + faster, datum)

    none = jnp.zeros(6, T.dtype)
    axes = (None, None, 0, 0, 0)
    r = jax.vmap(moved, axes)(none, none, T, twist, factor.data)
    by_pose, by_twist = jax.vmap(jax.jacfwd(moved, (0, 1)), axes)(none, none, T, twist, factor.data)
    return r, by_pose @ J_pose + by_twist @ J_twist
