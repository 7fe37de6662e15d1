"""A cumulative cubic B-spline on SE(3): twice continuously differentiable, local, with few parameters."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxpose.fields import numpy_evaluator
from jaxpose.fields.types import Factor, Params, PoseField, Span, described, float_type, since
from jaxpose.geometry import se3


def bspline(span: tuple[float, float], intervals: int) -> PoseField:
    """A cumulative cubic B-spline with equal knot intervals.

    T(t) = C_i exp(b_1(s) Omega_i+1) exp(b_2(s) Omega_i+2) exp(b_3(s) Omega_i+3) in interval i, s in [0, 1]
    the place in it, Omega_j = log(C_j-1^-1 C_j) (Lovegrove et al. 2013, eq. 5; Sommer et al. 2020).
    Neighbouring control poses must be less than 180 degrees apart, else the spline takes the shorter way.
    Constant twists (C_j = C_0 exp(j xi)) are reproduced exactly.

    Args:
        span: first and last time [s]; outside of it the spline stands still.
        intervals: how many knot intervals there are in the span. A motion of f Hz asks for more than 2 f a
            second.

    Returns:
        A field whose parameters are an array (intervals + 3, 7), a control pose a row: position [m] and
        quaternion wxyz less [1, 0, 0, 0], so that zeros, as at init, are the identity; quaternions need no
        unit length. `control_points` makes it from poses. Control pose j lies, near enough, at time
        first + (j - 1) * interval.

    Raises:
        ValueError: a configuration that means nothing.

    >>> field = bspline((0.0, 2.0), intervals=4)
    >>> field.init(jax.random.key(0)).shape
    (7, 7)
    """
    first, last = map(float, span)
    if not first < last or intervals < 1:
        raise ValueError(f"expected first < last and intervals >= 1, got span {span}, intervals {intervals}")
    return described(Bspline((first, last), int(intervals)))


@dataclass(frozen=True)
class Bspline:
    """The description of `bspline`."""

    span: Span
    intervals: int

    def init(self, key) -> Params:
        del key  # the identity needs no chance
        return jnp.zeros((self.intervals + 3, 7))

    def pose(self, params, t):
        first, last = self.span
        place = since(first, t, self.span, float_type(params)) * (self.intervals / (last - first))
        index = jnp.clip(jnp.floor(place), 0, self.intervals - 1)
        weights = _cumulative_basis(place - index)
        row = index.astype(jnp.int32)
        # The logarithms of all neighbours do not depend on time: computed once, however many times are asked.
        twists = jax.lax.dynamic_slice_in_dim(_increments(params), row, 3)
        first_step, second_step, third_step = se3.exp(weights[:, None] * twists)
        T = _control_pose(jax.lax.dynamic_index_in_dim(params, row, keepdims=False))
        return se3.compose(se3.compose(T, first_step), se3.compose(second_step, third_step))

    def factors(self, params) -> tuple[Factor, ...]:
        return ({"kind": "bspline", "span": np.array(self.span), "control_points": np.asarray(params)},)

    def shifted(self, seconds: float) -> "Bspline":
        return Bspline((self.span[0] + seconds, self.span[1] + seconds), self.intervals)


def from_factor(factor: Factor) -> tuple[PoseField, Params]:
    """The field and the parameters that `Bspline.factors` wrote."""
    points = jnp.asarray(factor["control_points"], jnp.zeros(()).dtype)
    return bspline(tuple(factor["span"]), len(points) - 3), points


def control_points(control_poses: Float[Array, "n 4 4"]) -> Float[Array, "n 7"]:
    """The parameters of the spline with these control poses.

    Args:
        control_poses: (n, 4, 4), the first one knot interval before the span and the last one after it.

    Returns:
        Parameters (n, 7) of `bspline(span, n - 3)`; quaternions of neighbours lie on the same side.
    """
    quaternion = se3.rotation_to_quaternion(control_poses[:, :3, :3])
    same = jnp.sum(quaternion[1:] * quaternion[:-1], axis=-1, keepdims=True) >= 0
    sign = jnp.cumprod(jnp.where(same, 1, -1).astype(quaternion.dtype), axis=0)
    quaternion = jnp.concatenate([quaternion[:1], sign * quaternion[1:]])
    return jnp.concatenate([control_poses[:, :3, 3], _from_identity(quaternion, -1)], axis=-1)


def control_points_along(
    times: Float[np.ndarray, " m"], poses: Float[np.ndarray, "m 4 4"], intervals: int
) -> Float[Array, "n 7"]:
    """The parameters of a spline over stamped poses whose control poses lie on them: a start for a fit.

    Args:
        times: timestamps (m,) [s], increasing, in any origin.
        poses: rigid transforms (m, 4, 4).
        intervals: knot intervals from the first timestamp to the last.

    Returns:
        Parameters (intervals + 3, 7) of `bspline((times[0], times[-1]), intervals)`.
    """
    span = float(times[0]), float(times[-1])
    return jnp.asarray(start_along(span, intervals, times, poses), jnp.zeros(()).dtype)


def start_along(
    span: Span, intervals: int, times: Float[np.ndarray, " m"], poses: Float[np.ndarray, "m 4 4"]
) -> Float[np.ndarray, "n 7"]:
    """`control_points_along` for any span, in float64."""
    return control_rows(control_poses_along(span, intervals, times, poses))


def control_poses_along(
    span: Span, intervals: int, times: Float[np.ndarray, " m"], poses: Float[np.ndarray, "m 4 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Control poses on stamped poses: at each knot that between its neighbours."""
    first, last = span
    knots = first + (np.arange(intervals + 3) - 1) * ((last - first) / intervals)
    return numpy_evaluator.evaluate({"kind": "stamped", "times": times, "poses": poses}, knots)


def control_rows(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 7"]:
    """`control_points` in float64 numpy."""
    return np.concatenate([T[:, :3, 3], unbroken_quaternions(T) - [1, 0, 0, 0]], axis=-1)


def unbroken_quaternions(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4"]:
    """Quaternions wxyz of poses, each on the side of the one before; the first with w >= 0."""
    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True, scalar_first=True)
    turned_over = np.sum(quaternion[1:] * quaternion[:-1], axis=-1) < 0
    quaternion[1:] *= np.cumprod(np.where(turned_over, -1, 1))[:, None]
    return quaternion


def _cumulative_basis(s: Float[Array, ""]) -> Float[Array, "3"]:
    """How much of each of three increments is done at place `s` of an interval."""
    first = 5 + s * (3 + s * (s - 3))
    second = 1 + s * (3 + s * (3 - 2 * s))
    return jnp.stack([first, second, s * s * s]) / 6


def _increments(params: Float[Array, "n 7"]) -> Float[Array, "n-1 6"]:
    """The twist from each control pose to the next, exact relative to its own size.

    Formed from differences of parameters: the product of the inverse of one pose with the next would lose
    about 1e-7 m and rad in float32, a large acceleration once divided by the square of a short interval.
    """
    before, step = params[:-1], params[1:] - params[:-1]
    quaternion = _from_identity(before[:, 3:], 1)
    length = jnp.sum(quaternion * quaternion, axis=-1, keepdims=True)  # squared
    relative = se3.quaternion_multiply(se3.quaternion_conjugate(quaternion), step[:, 3:])
    relative = relative + length * jnp.eye(1, 4, dtype=params.dtype)
    R_before = se3.quaternion_to_rotation(quaternion)
    translation = jnp.einsum("nji,nj->ni", R_before, step[:, :3], precision="highest")
    return se3.log(se3.make(se3.quaternion_to_rotation(relative), translation))


def _control_pose(row: Float[Array, "7"]) -> Float[Array, "4 4"]:
    return se3.make(se3.quaternion_to_rotation(_from_identity(row[3:], 1)), row[:3])


def _from_identity(quaternion: Float[Array, "*n 4"], sign: int) -> Float[Array, "*n 4"]:
    """Add (`sign` = 1) or take away (-1) the identity quaternion."""
    return quaternion.at[..., 0].add(sign)
