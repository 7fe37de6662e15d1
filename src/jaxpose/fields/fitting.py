"""Fit any pose field to stamped poses: how a trajectory is started, kept and read from a list.

The loss is the mean over poses of a pseudo-Huber function of distance / length_scale and of the chord
2 sin(angle / 2). (The chord is smooth at half a turn, where the twist log(P(t)^-1 T) jumps, and the same as
the angle for small ones.) A B-spline is brought to the least loss by Gauss-Newton, per-frame poses are read
off, and every other field descends by an optax transformation, in one compiled call.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import ArrayLike

from jaxpose import optim
from jaxpose.fields._bspline import Bspline, start_along
from jaxpose.fields._fit_input import check_bounds, check_span, checked_poses, evaluated, posenet_for
from jaxpose.fields._gauss_newton import DELTA, fit_spline
from jaxpose.fields._per_frame import PerFramePoses
from jaxpose.fields._posenet import PoseNetConfig
from jaxpose.fields.types import Params, PoseField, described, float_type, is_coarse
from jaxpose.geometry import rigid, se3

_RATE, _DECAY = 1e-3, 1e-2  # Adam's at first, and the share of it that it falls to, exponentially


class FitResult(NamedTuple):
    """A fitted field with its parameters, and what is left: errors over all poses."""

    field: PoseField
    params: Params
    translation_rmse_m: float
    translation_max_m: float
    rotation_rmse_deg: float
    rotation_max_deg: float


def fit(
    field: PoseField | PoseNetConfig,
    times: ArrayLike,
    poses: ArrayLike,
    *,
    key: PRNGKeyArray | None = None,
    params: Params | None = None,
    tx: optax.GradientTransformation | None = None,
    steps: int = 1000,
    length_scale: float | None = None,
    batch: int = 256,
) -> FitResult:
    """Fit a field to stamped poses `T_reference_body`; this module says how.

    Args:
        field: a field, or the configuration of a PoseNet. Of a configuration what is None is chosen here: the
            span is that of the timestamps, and the translation scale is twice what the poses ask for. Its
            PoseNet is a correction of a constant, the middle pose, so that its bounds count from there.
        times: timestamps (n,) [s], increasing, in any origin: seconds since 1970 in float64 lose nothing.
        poses: rigid transforms (n, 4, 4).
        key: draws the start of a PoseNet, where `params` do not say it.
        params: a warm start.
        tx: any optax transformation for the descent; None: Adam at a rate that falls from 1e-3 to 1e-5. A new
            transformation is compiled anew: make it once.
        steps: of the descent.
        length_scale: [m] the distance that matters as much as one radian; None: half the extent of the poses.
        batch: of more poses than this each step of the descent takes every k-th, the offset going round.

    Returns:
        The field (made here for a configuration) with its parameters, and the errors that are left. The field
        takes times as they were given here.

    Raises:
        ValueError: no start; times or poses that are empty, not finite, of other shapes or do not increase;
            poses that are not rigid, or beyond a PoseNet's bounds; times outside of the field's span.

    >>> from jaxpose.fields import bspline
    >>> times = np.linspace(0.0, 2.0, 21)
    >>> poses = se3.exp(jnp.outer(times, np.array([0.3, 0.0, 0.1, 0.0, 0.0, 0.4])))
    >>> found = fit(bspline((0.0, 2.0), intervals=4), times, poses)
    >>> found.translation_max_m < 1e-6 and found.rotation_max_deg < 1e-4
    True
    """
    t, T = checked_poses(times, poses)
    if isinstance(field, PoseNetConfig):
        field = posenet_for(field, t, T)
    check_span(field, t)
    check_bounds(field, t, T)
    if length_scale is None:
        length_scale = float(np.ptp(T[:, :3, 3], axis=0).max()) / 2 or 1.0
    if tx is None and isinstance(field.description, Bspline | PerFramePoses):
        return _solved(field, field.description, t, T, params, length_scale)
    if params is None:
        if key is None:
            raise ValueError("expected `params` or a `key` to start from")
        params = field.init(key)
    return _descended(field, t, T, params, tx, steps, batch, length_scale)


def _solved(field: PoseField, shape: Bspline | PerFramePoses, t, T, params, length_scale: float) -> FitResult:
    """The field without a descent, and its errors by the numpy evaluator, in float64."""
    if isinstance(shape, PerFramePoses):
        solution = _read_off(shape, t, T)
    else:
        start = start_along(shape.span, shape.intervals, t, T) if params is None else params
        solution = fit_spline(shape, t, T, np.asarray(start, np.float64), length_scale)
    found = jnp.asarray(solution, jnp.zeros(()).dtype)
    poses = evaluated(shape.factors(found), t)
    distance = np.linalg.norm(poses[:, :3, 3] - T[:, :3, 3], axis=1)
    angle = np.degrees(rigid.rotation_angle(poses[:, :3, :3], T[:, :3, :3]))
    return FitResult(field, found, *_errors(distance), *_errors(angle))


def _descended(field: PoseField, t, T, params, tx, steps: int, batch: int, length_scale: float) -> FitResult:
    """The field on a clock that its parameters' type resolves, descended to the poses."""
    dtype = float_type(params)
    local, origin = field, 0.0
    if field.description is not None and np.isfinite(field.span[0]):
        origin = field.span[0]  # the same for every call with this field, so that nothing recompiles
        local = described(field.description.shifted(-origin))
    elif is_coarse((t[0], t[-1]), dtype):
        raise ValueError(f"times: expected such as {dtype} can tell apart, got {t[0]} to {t[-1]} s")
    arrays = (jnp.asarray(x, dtype) for x in (t - origin, T, length_scale))
    params, distance, angle = _descend(local, tx, steps, batch, params, *arrays)
    return FitResult(field, params, *_errors(distance), *_errors(np.degrees(angle)))


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _descend(field, tx, steps, batch, params, times, poses, length_scale):
    if tx is None:  # one pose in thousands has gradients below the usual 1e-8
        tx = optax.adam(optax.exponential_decay(_RATE, steps, _DECAY), eps=1e-15)
    count = times.shape[0]
    rounds = -(-count // batch)  # steps in which every pose comes up once
    indices = jnp.arange(0, count, rounds)

    def loss(params, step):
        chosen = (indices + step % rounds) % count
        distance, chord = _squares(field, params, times[chosen], poses[chosen])
        return jnp.mean(_pseudo_huber(distance / length_scale**2) + _pseudo_huber(chord))

    params = optim.minimize(loss, params, tx, steps).params
    distance, chord = _squares(field, params, times, poses)
    return params, jnp.sqrt(distance), 2 * jnp.arcsin(jnp.minimum(jnp.sqrt(chord) / 2, 1))


def _squares(field, params, times, poses) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Squares of the distance [m] and of the chord of the angle between found and given poses."""
    error = jax.vmap(field.pose, in_axes=(None, 0))(params, times) - poses
    return jnp.sum(error[:, :3, 3] ** 2, axis=-1), jnp.sum(error[:, :3, :3] ** 2, axis=(-2, -1)) / 2


def _pseudo_huber(square: Float[Array, " n"]) -> Float[Array, " n"]:
    # sqrt(1 + x) - 1, written so that it does not cancel for small residuals.
    x = square / DELTA**2
    return x / (1 + jnp.sqrt(1 + x))


def _read_off(frames: PerFramePoses, t, T) -> Float[np.ndarray, "n 6"]:
    """The twist of the pose nearest in time to each of the field's timestamps."""
    times = np.array(frames.times)
    nearest = np.abs(times[:, None] - t).argmin(axis=1)
    borders = (times[1:] + times[:-1]) / 2
    without = np.flatnonzero(np.bincount(np.searchsorted(borders, t), minlength=len(times)) == 0)
    if len(without):
        raise ValueError(
            f"poses: expected one for each of the field's {len(times)} timestamps, got none for "
            f"{times[without[0]]} s"
        )
    return np.asarray(jax.jit(se3.log)(jnp.asarray(T[nearest], jnp.zeros(()).dtype)))


def _errors(errors: Any) -> tuple[float, float]:
    errors = np.asarray(errors, np.float64)
    return float(np.sqrt(np.mean(errors**2))), float(errors.max())
