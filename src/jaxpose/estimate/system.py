"""The least-squares problem of a spline, its sensors and what they measured: residuals and their derivatives.

Unknowns: the control poses (moved on their right); at every third knot (linear between) the biases of
gyroscope and accelerometer, and the drift of measured poses; and, where they are free, the direction of
gravity, the time offset t_imu = t_pose + offset, the mounting T_body_cam and the scale of the poses. The
spline is the body's, in metres, on the clock of the IMU. Three control poses, the bias and the drift of their
knot are one block.

Poses that are registered to a map which earlier ones made share its errors: T_measured = exp(drift) T. The
drift walks by steps that are small beside the camera, and is forgotten as what was mapped is seen again.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxpose.estimate.blocks import Blocks
from jaxpose.estimate.factors import Factor, linearised
from jaxpose.estimate.inertial import NODES, PLACES, lagrange
from jaxpose.estimate.kinematics import (
    Kinematics,
    Segment,
    ad,
    basis,
    kinematics,
    of_logarithm,
    right_jacobian,
    segments,
)
from jaxpose.estimate.rows import Rows, robust, robust_cost
from jaxpose.geometry import se3
from jaxpose.imu.types import AnyArray

BLOCK = 30  # unknowns: three control poses, and the biases and the drift at the first one's knot
CONTROL, BIAS, DRIFT = slice(0, 18), slice(18, 24), slice(24, 30)
BORDER = 10  # gravity's direction 2, time offset 1, mounting 6, logarithm of the scale 1
GRAVITY, OFFSET, MOUNTING, SCALE = slice(0, 2), slice(2, 3), slice(3, 9), slice(9, 10)
_PAIR = 2 * BLOCK  # what an interval's residuals depend on beside the border
_FIXED = 1e-9  # [m, rad] sigma of the drift of the first pose, which the world's frame is that of
_RIDGE = 1e-3  # share of a motion's likely smallness that holds beside readings, so that all is determined


class State(NamedTuple):
    """What is estimated."""

    control: Float[Array, "k 4 4"]  # T_world_body
    bias: Float[Array, "b 6"]  # gyroscope [rad/s], accelerometer [m/s^2], at every third knot
    drift: Float[Array, "b 6"]  # [m, rad] of measured poses, a twist of the world, at every third knot
    gravity_world: Float[Array, "3"]  # [m/s^2], of known size
    offset_s: Float[Array, ""]  # t_imu - t_pose
    T_body_cam: Float[Array, "4 4"]
    log_scale: Float[Array, ""]  # of metres per unit of the poses' positions


class Noise(NamedTuple):
    """One sigma of everything that is compared."""

    gyro: Float[AnyArray, " m"]  # [rad/s] of a reading, in each band from slow to fast
    accelerometer: Float[AnyArray, " m"]  # [m/s^2] of a reading
    position: Float[AnyArray, ""]  # what the stated sigmas of poses are multiplied by
    rotation: Float[AnyArray, ""]
    acceleration: Float[AnyArray, ""]  # [m/s^2/sqrt(Hz)] of motion where no reading says anything
    angular_acceleration: Float[AnyArray, ""]  # [rad/s^2/sqrt(Hz)]


class Prior(NamedTuple):
    """What is known before: one sigma each; the border's about where the state starts."""

    bias: Float[AnyArray, "6"]  # of the first biases, about 0
    walk: Float[AnyArray, "6"]  # of the biases, per square root of a second
    border: Float[AnyArray, "10"]
    free: Bool[AnyArray, "10"]  # which of the border is estimated


class Problem(NamedTuple):
    """What was measured, on one clock [s] that starts with the spline."""

    interval_s: Float[Array, ""]
    root: Float[Array, "n m m"]  # `inertial.NodeReadings`
    value: Float[Array, "n m 6"]
    used: Float[Array, "2"]  # 1 or 0: gyroscope, accelerometer
    t: Float[Array, " p"]  # of poses
    T: Float[Array, "p 4 4"]  # T_world_cam as measured, positions in units of their own
    root_information: Float[Array, "p 6 6"]  # S with S^T S the inverse of the covariance
    root_drift: Float[Array, "n 6 6"]  # the same of the drift's step over each block, in the axes of a camera
    to_camera: Float[Array, "n 6 6"]  # which twists of the world are brought to by these
    kept: Float[Array, ""]  # share of the drift that is left after a block
    start: State  # what the border's prior is about
    prior: Prior
    factors: tuple[Factor, ...] = ()  # times on the spline's clock less the offset


class Residuals(NamedTuple):
    """All residuals, in groups that share a noise level."""

    inertial: Rows  # (pairs, bands, 6)
    poses: Rows  # (poses, 6)
    pair: Int[Array, " p"]  # that each pose depends on
    motion: Rows  # (pairs, 3, 6)
    walk: Rows  # (pairs, 6)
    drift: Rows  # (pairs, 6)
    factors: tuple[tuple[Rows, Int[Array, " q"]], ...]  # (times, m) each, and the pair of each time


def residuals(problem: Problem, state: State, noise: Noise) -> Residuals:
    """Everything that was measured beside what the state predicts, whitened, and its derivatives."""
    segment = segments(state.control)
    count = segment.start.shape[0]
    t = [problem.t, *(factor.t for factor in problem.factors)]
    index, places = _where(problem, state, jnp.concatenate(t) + state.offset_s)
    index = jnp.concatenate([jnp.repeat(jnp.arange(count, dtype=index.dtype), NODES), index])
    places = jnp.concatenate([jnp.tile(jnp.asarray(PLACES, places.dtype), count), places])
    at = along(problem, segment, index, places)  # at nodes, poses and factors alike: compiled once
    at_nodes = jax.tree.map(lambda x: x[: count * NODES].reshape(count, NODES, *x.shape[1:]), at)
    ends = np.cumsum([count * NODES] + [x.shape[0] for x in t])
    (index_of_poses, at_poses), *others = [
        (index[a:b], jax.tree.map(lambda x, a=a, b=b: x[a:b], at)) for a, b in pairwise(ends)
    ]
    pose_rows, pair = _poses(problem, state, noise, index_of_poses, at_poses)
    factors = tuple(
        _factor(problem, state, factor, *where) for factor, where in zip(problem.factors, others, strict=True)
    )
    inertial, motion = _inertial(problem, state, noise, at_nodes), _motion(problem, noise, at_nodes)
    to_camera = problem.to_camera / _pose_scale(noise)[None, :, None]
    drift = _steps(state.drift, problem.root_drift @ to_camera, DRIFT, problem.kept)
    return Residuals(inertial, pose_rows, pair, motion, _walk(problem, state), drift, factors)


def _inertial(problem: Problem, state: State, noise: Noise, at: Kinematics) -> Rows:
    """Gyroscope: body rate and bias. Accelerometer: R^T (a - g) and bias."""
    intervals = at.T.shape[0]
    R = at.T[..., :3, :3]
    turned = lambda x: jnp.einsum("nmji,j->nmi", R, x)
    v, omega = at.twist[..., :3], at.twist[..., 3:]
    gravity = turned(state.gravity_world)
    force = at.twist_rate[..., :3] + jnp.cross(omega, v) - gravity
    first, second = _shares(intervals, state.bias.dtype)
    bias = state.bias.repeat(3, 0)
    bias = first * bias[:intervals, None] + second * bias[3 : intervals + 3, None]
    predicted = jnp.concatenate([omega, force], axis=-1) + bias
    J_force = at.rate_jacobian[..., :3, :] + se3.hat(omega) @ at.twist_jacobian[..., :3, :]
    J_force -= se3.hat(v) @ at.twist_jacobian[..., 3:, :] + se3.hat(gravity) @ at.pose_jacobian[..., 3:, :]
    J = jnp.concatenate([at.twist_jacobian[..., 3:, :], J_force], axis=-2)
    tilt = se3.hat(state.gravity_world) @ tangent(state.gravity_world)
    J_gravity = jnp.einsum("nmji,jd->nmid", R, tilt * _free(problem)[None, GRAVITY])
    J_gravity = jnp.concatenate([jnp.zeros_like(J_gravity), J_gravity], axis=-2)
    one = jnp.eye(6, dtype=J.dtype)[None, None]
    zero = jnp.zeros_like(first)
    J_bias = jnp.concatenate([x[..., None] * one for x in (first, zero, second, zero)], axis=-1)
    J_bias = jnp.broadcast_to(J_bias, (*J.shape[:-1], 24))
    none = jnp.zeros((*J.shape[:-1], BORDER - 2), J.dtype)
    rows = _in_pairs(predicted, J, J_bias, jnp.concatenate([J_gravity, none], axis=-1))
    sigma = jnp.stack([noise.gyro, noise.accelerometer], axis=1)
    weight = jnp.repeat(problem.used[None] / sigma, 3, axis=1)[None]
    r = jnp.einsum("nkm,nmi->nki", problem.root, rows.residual) - problem.value
    J = jnp.einsum("nkm,nmij->nkij", problem.root, rows.jacobian)
    return Rows(r * weight, J * weight[..., None])


def _motion(problem: Problem, noise: Noise, at: Kinematics) -> Rows:
    """Rate of the twist in the middle of intervals, which is likely small where no reading says anything."""
    by_interval = jnp.abs(problem.root).max(axis=1).reshape(-1, NODES).max(axis=1)
    known = jnp.stack([by_interval * used for used in problem.used[::-1]], axis=1)
    sigma = jnp.stack([noise.acceleration, noise.angular_acceleration])
    weight = jnp.where(known > 0, _RIDGE, 1) * jnp.sqrt(problem.interval_s) / sigma[None]
    weight = jnp.repeat(weight, 3, axis=1)[:, None]
    middle = jnp.asarray(lagrange(np.array([0.5]))[0], weight.dtype)
    r = jnp.einsum("m,nmi->ni", middle, at.twist_rate)[:, None] * weight
    J = jnp.einsum("m,nmij->nij", middle, at.rate_jacobian)[:, None] * weight[..., None]
    rest = jnp.zeros((*J.shape[:-1], 24 + BORDER), J.dtype)
    return _in_pairs(r, J, rest[..., :24], rest[..., 24:])


def _walk(problem: Problem, state: State) -> Rows:
    """From each bias to the next."""
    sigma = jnp.asarray(problem.prior.walk) * jnp.sqrt(3 * problem.interval_s)
    weight = jnp.broadcast_to(jnp.diag(1 / sigma), (len(state.bias) - 1, 6, 6))
    return _steps(state.bias, weight, BIAS)


def _steps(values: Float[Array, "b 6"], weight: Float[Array, "n 6 6"], part: slice, kept: Any = 1.0) -> Rows:
    """The steps of values, a part of blocks, each from a share of the last one; times weights."""
    J = jnp.zeros((*weight.shape[:2], _PAIR + BORDER), values.dtype)
    J = J.at[:, :, part].set(-kept * weight)
    J = J.at[:, :, BLOCK + part.start : BLOCK + part.stop].set(weight)
    return Rows(jnp.einsum("nij,nj->ni", weight, values[1:] - kept * values[:-1]), J)


def _poses(
    problem: Problem, state: State, noise: Noise, index: Int[Array, " p"], at: Kinematics
) -> tuple[Rows, Int[Array, " p"]]:
    """Camera poses: position in the measured camera's axes [its units], and rotation."""
    found, J = jax.vmap(_camera, (0, None))(at, state)
    shrunk = jnp.exp(-state.log_scale)
    (_, place), pair = _where(problem, state, problem.t + state.offset_s), index // 3
    late = (((index % 3).astype(place.dtype) + place) / 3)[:, None]
    drift = (1 - late) * state.drift[pair] + late * state.drift[pair + 1]

    def residual(drift, T, T_measured):
        """With its derivatives by the camera's increment and the scale, and by the drift."""
        moved = se3.compose(se3.exp(drift), T)
        turned, placed = T_measured[:3, :3].T @ moved[:3, :3], shrunk * T_measured[:3, :3].T @ moved[:3, 3]
        turn = se3.so3_log(turned)
        upper = jnp.concatenate([shrunk * turned, jnp.zeros((3, 3), turn.dtype), -placed[:, None]], axis=1)
        by_pose = jnp.concatenate([upper, jnp.pad(of_logarithm(turn), [(0, 0), (3, 1)])])
        by_drift = by_pose[:, :6] @ se3.adjoint(se3.inverse(T)) @ right_jacobian(drift)
        r = jnp.concatenate([placed - T_measured[:3, :3].T @ T_measured[:3, 3], turn])
        return r, by_pose, by_drift

    r, by_pose, by_drift = jax.vmap(residual)(drift, found, problem.T)
    slope = (state.drift[pair + 1] - state.drift[pair]) / (3 * problem.interval_s)
    J = by_pose[..., :6] @ J
    J = J.at[..., 24 + OFFSET.start].add(jnp.einsum("pij,pj->pi", by_drift, slope))
    J = jnp.concatenate([J[..., :-1], J[..., -1:] + by_pose[..., 6:]], axis=-1)
    J = _of_free(problem, J)
    scale = _pose_scale(noise)
    r = jnp.einsum("pij,pj->pi", problem.root_information, r / scale[None])
    J, by_drift = (problem.root_information @ (x / scale[None, :, None]) for x in (J, by_drift))
    early, late = (share[..., None] * by_drift for share in (1 - late, late))
    beside = jnp.concatenate([0 * early, early, 0 * late, late], axis=-1)
    placed = _placed((index % 3)[:, None, None], J[..., :24], beside, J[..., 24:])
    return robust(r, placed), pair


def _factor(
    problem: Problem, state: State, factor: Factor, index: Int[Array, " q"], at: Kinematics
) -> tuple[Rows, Int[Array, " q"]]:
    """What users measured of the camera's pose and twist."""
    T, J_pose = jax.vmap(_camera, (0, None))(at, state)
    twist, J_twist = jax.vmap(_camera_twist, (0, None))(at, state)
    r, J = linearised(factor, T, J_pose, twist, J_twist)
    return robust(r, _beside_pairs(problem, index, J)), index // 3


def _of_free(problem: Problem, J: Float[Array, "*n 34"]) -> Float[Array, "*n 34"]:
    """Derivatives by four control poses and what is free of the border."""
    free = _free(problem).reshape((1,) * (J.ndim - 1) + (BORDER,))
    return jnp.concatenate([J[..., :24], J[..., 24:] * free], axis=-1)


def _beside_pairs(
    problem: Problem, index: Int[Array, " p"], J: Float[Array, "p m 34"]
) -> Float[Array, "p m 70"]:
    """Derivatives by four control poses and the border as those by a pair of blocks."""
    J, none = _of_free(problem, J), jnp.zeros((*J.shape[:-1], 24), J.dtype)
    return _placed((index % 3)[:, None, None], J[..., :24], none, J[..., 24:])


def _pose_scale(noise: Noise) -> Float[Array, "6"]:
    """What the stated sigmas of poses, and of their drift, are multiplied by."""
    return jnp.repeat(jnp.stack([noise.position, noise.rotation]), 3)


def _where(
    problem: Problem, state: State, t: Float[Array, " p"]
) -> tuple[Int[Array, " p"], Float[Array, " p"]]:
    """The interval that each time on the spline's clock falls in, and the place in it."""
    place = t / problem.interval_s
    index = jnp.clip(jnp.floor(place), 0, state.control.shape[0] - 4)
    return index.astype(jnp.int32), jnp.clip(place - index, 0, 1)


def along(
    problem: Problem, segment: Segment, index: Int[Array, " p"], place: Float[Array, " p"]
) -> Kinematics:
    """The motion at places of intervals."""
    weights = basis(place, problem.interval_s)
    return jax.vmap(kinematics)(jax.tree.map(lambda x: x[index], segment), weights)


def _camera(at: Kinematics, state: State) -> tuple[Float[Array, "4 4"], Float[Array, "6 34"]]:
    """The camera's pose, and its increment's derivatives by four control poses and the border."""
    to_camera = se3.adjoint(se3.inverse(state.T_body_cam))
    zero, one = jnp.zeros((6, 1), to_camera.dtype), jnp.eye(6, dtype=to_camera.dtype)
    by_offset = (to_camera @ at.twist)[:, None]
    parts = [to_camera @ at.pose_jacobian, zero, zero, by_offset, one, zero]
    return se3.compose(at.T, state.T_body_cam), jnp.concatenate(parts, axis=1)


def _camera_twist(at: Kinematics, state: State) -> tuple[Float[Array, "6"], Float[Array, "6 34"]]:
    """The camera's velocity and rate in its own axes, and their derivatives, as `_camera`'s."""
    to_camera = se3.adjoint(se3.inverse(state.T_body_cam))
    twist, zero = to_camera @ at.twist, jnp.zeros((6, 1), to_camera.dtype)
    by_offset = (to_camera @ at.twist_rate)[:, None]
    return twist, jnp.concatenate(
        [to_camera @ at.twist_jacobian, zero, zero, by_offset, ad(twist), zero], axis=1
    )


def camera_rows(
    problem: Problem, state: State, t: Float[Array, " p"]
) -> tuple[Float[Array, "p 4 4"], Float[Array, "p 6 70"], Int[Array, " p"]]:
    """Camera poses at times of the poses' clock, and their increments' derivatives by a pair of blocks."""
    index, place = _where(problem, state, t + state.offset_s)
    at = along(problem, segments(state.control), index, place)
    T, J = jax.vmap(_camera, (0, None))(at, state)
    return T, _beside_pairs(problem, index, J), index // 3


def normal_equations(problem: Problem, state: State, found: Residuals) -> tuple[Blocks, Float[Array, ""]]:
    """What Gauss-Newton solves, and half the sum of squares."""
    pairs, size = state.bias.shape[0] - 1, _PAIR + BORDER
    each = [
        jnp.concatenate([rows.jacobian, rows.residual[..., None]], axis=-1).reshape(pairs, -1, size + 1)
        for rows in (found.inertial, found.motion, found.walk, found.drift)
    ]
    J = jnp.concatenate(each, axis=1)  # with the residuals as its last column
    gram = jnp.swapaxes(J, 1, 2) @ J
    total, cost = gram, jnp.sum(gram[:, size, size])
    for rows, pair in ((found.poses, found.pair), *found.factors):
        each = jnp.concatenate([rows.jacobian, rows.residual[..., None]], axis=-1)
        total += jax.ops.segment_sum(jnp.swapaxes(each, 1, 2) @ each, pair, pairs)
        cost += robust_cost(rows)
    H, side = total[:, :size, :size], -total[:, :size, size]

    joined = lambda a, b: jnp.concatenate([a, 0 * a[:1]]) + jnp.concatenate([0 * b[:1], b])
    diagonal = joined(H[:, :BLOCK, :BLOCK], H[:, BLOCK:_PAIR, BLOCK:_PAIR])
    border = joined(H[:, :BLOCK, _PAIR:], H[:, BLOCK:_PAIR, _PAIR:])
    row = joined(side[:, :BLOCK], side[:, BLOCK:_PAIR])
    corner, corner_side = H[:, _PAIR:, _PAIR:].sum(0), side[:, _PAIR:].sum(0)
    prior = problem.prior
    information = 1 / jnp.concatenate([jnp.asarray(prior.bias), jnp.full(6, _FIXED, H.dtype)]) ** 2
    first = jnp.concatenate([state.bias[0], state.drift[0]])
    diagonal = diagonal.at[0, BIAS.start :, BIAS.start :].add(jnp.diag(information))
    row = row.at[0, BIAS.start :].add(-information * first)
    away = border_difference(state, problem.start)
    corner_information = 1 / prior.border**2
    corner += jnp.diag(jnp.where(prior.free, corner_information, 1))
    corner_side -= jnp.where(prior.free, corner_information * away, 0)
    blocks = Blocks(diagonal, H[:, BLOCK:_PAIR, :BLOCK], border, corner, row, corner_side)
    cost += jnp.sum(information * first**2) + jnp.sum(_free(problem) * corner_information * away**2)
    return blocks, cost / 2


def retract(state: State, row: Float[Array, "b 30"], corner: Float[Array, "10"]) -> State:
    """The state that increments of the unknowns lead to."""
    step = row[:, CONTROL].reshape(-1, 6)
    g = state.gravity_world
    turn = se3.so3_exp(tangent(g) @ corner[GRAVITY])
    return State(
        se3.compose(state.control, se3.exp(step)),
        state.bias + row[:, BIAS],
        state.drift + row[:, DRIFT],
        turn @ g,
        state.offset_s + corner[OFFSET][0],
        se3.compose(state.T_body_cam, se3.exp(corner[MOUNTING])),
        state.log_scale + corner[SCALE][0],
    )


def border_difference(state: State, start: State) -> Float[Array, "10"]:
    """The border's increments from the start, which its prior is about."""
    g = start.gravity_world
    axis = jnp.cross(g, state.gravity_world) / jnp.sum(g * g)
    mounting = se3.log(se3.compose(se3.inverse(start.T_body_cam), state.T_body_cam))
    return jnp.concatenate([
        tangent(g).T @ axis, (state.offset_s - start.offset_s)[None], mounting,
        (state.log_scale - start.log_scale)[None],
    ])  # fmt: skip


def tangent(g: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Two unit vectors across gravity, about which it may turn."""
    along = jax.nn.one_hot(jnp.argmin(jnp.abs(g)), 3, dtype=g.dtype)
    first = jnp.cross(g, along)
    first = first / jnp.linalg.norm(first)
    return jnp.stack([first, jnp.cross(g, first) / jnp.linalg.norm(g)], axis=1)


def _shares(intervals: int, dtype) -> tuple[Float[np.ndarray, "n m 1"], Float[np.ndarray, "n m 1"]]:
    second = ((np.arange(intervals) % 3)[:, None] + PLACES)[..., None] / 3
    return np.asarray(1 - second, dtype), np.asarray(second, dtype)


def _free(problem: Problem) -> Float[Array, "10"]:
    return jnp.asarray(problem.prior.free, problem.interval_s.dtype)


def _in_pairs(r, J_control, J_beside, J_border) -> Rows:
    """Rows of every interval (n, m, 6) as rows of pairs of blocks (n / 3, 3 m, 6)."""
    rows = r.shape[1]
    three = lambda x: x.reshape(-1, 3 * rows, *x.shape[2:])
    phase = jnp.repeat(jnp.arange(3), rows)[None, :, None, None]
    return Rows(three(r), _placed(phase, *(three(x) for x in (J_control, J_beside, J_border))))


def _placed(phase, control, beside, border):
    """Derivatives by control poses `phase` to `phase` + 3, and by the rest of two blocks, in their order."""
    four = jnp.split(control, 4, axis=-1)
    zero = jnp.zeros_like(four[0])
    early, late = jnp.split(beside, 2, axis=-1)
    places = []
    for k in range(6):
        options = [four[k - p] if 0 <= k - p < 4 else zero for p in range(3)]
        places.append(jnp.where(phase == 0, options[0], jnp.where(phase == 1, options[1], options[2])))
    return jnp.concatenate([*places[:3], early, *places[3:], late, border], axis=-1)
