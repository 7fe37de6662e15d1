"""Residuals and their derivatives, against fields of this package and finite differences in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import hand_held

from jaxpose import fields
from jaxpose.estimate import inertial
from jaxpose.estimate.factors import Factor
from jaxpose.estimate.kinematics import basis, kinematics, of_logarithm, segments
from jaxpose.estimate.system import BLOCK, BORDER, Noise, Prior, Problem, State, residuals, retract
from jaxpose.geometry import rigid, se3

SPAN, INTERVALS = (0.0, 1.2), 6


@pytest.fixture(scope="module")
def control():
    knots = SPAN[0] + (np.arange(INTERVALS + 3) - 1) * (SPAN[1] - SPAN[0]) / INTERVALS
    return hand_held.body(knots)[0]


def test_the_motion_is_that_of_the_field_by_forward_mode(control):
    with jax.enable_x64(True):
        points = fields.control_points(jnp.asarray(control))
        field = fields.bspline(SPAN, INTERVALS)
        motion = jax.jit(lambda t: fields.motion(lambda t: field.pose(points, t), t))
        places = jax.jit(lambda segment, u: kinematics(segment, basis(u, jnp.asarray(0.2))))
        for index, u in ((0, 0.3), (3, 0.9), (5, 0.5)):
            segment = jax.tree.map(lambda x, i=index: x[i], segments(jnp.asarray(control)))
            at = places(segment, jnp.asarray(u))
            there = motion((index + u) * 0.2)
            R = np.asarray(there.pose[:3, :3])
            np.testing.assert_allclose(at.T, there.pose, atol=1e-12)
            np.testing.assert_allclose(at.twist[3:], there.omega_body, atol=1e-11)
            np.testing.assert_allclose(R @ at.twist[:3], there.velocity_world, atol=1e-11)
            np.testing.assert_allclose(at.twist_rate[3:], there.alpha_body, atol=1e-9)
            inward = at.twist_rate[:3] + np.cross(at.twist[3:], at.twist[:3])
            np.testing.assert_allclose(R @ inward, there.acceleration_world, atol=1e-9)


def sped(T_world_cam, twist, datum):
    """A residual of a user, of all that a camera's motion has: its place and its velocity in the world."""
    velocity = T_world_cam[:3, :3] @ twist[:3]
    return jnp.concatenate([velocity * T_world_cam[2, 3] - datum, jnp.sin(twist[3:]) * datum])


def test_every_derivative_is_that_of_finite_differences(control):
    rng = np.random.default_rng(0)
    poses = np.array([0.07, 0.5, 0.93])
    T_body_cam = rigid.exp(np.array([0.1, -0.05, 0.02, 0.3, -0.2, 0.1]))
    imu = hand_held.readings(1.2, 60.0, rng)
    inside = imu.t < 0.6  # none after: there a small acceleration is expected
    reduced = inertial.node_readings(type(imu)(*(x[inside] for x in imu)), SPAN, INTERVALS)
    with jax.enable_x64(True):
        state = State(
            jnp.asarray(control), *jnp.asarray(rng.normal(size=(2, 3, 6)) * 0.01),
            jnp.asarray([0.5, 1.0, -9.7]),
            jnp.asarray(0.013), jnp.asarray(T_body_cam), jnp.asarray(0.4),
        )  # fmt: skip
        one = jnp.ones(inertial.BANDS)
        noise = Noise(0.01 * one, 0.1 * one, *(jnp.asarray(x) for x in (1.1, 0.9, 2.0, 3.0)))
        prior = Prior(jnp.ones(6), 0.1 * jnp.ones(6), jnp.ones(BORDER), jnp.ones(BORDER, bool))
        roots = np.triu(rng.normal(size=(3, 6, 6))) + 3 * np.eye(6)
        measured = hand_held.body(poses)[0] @ T_body_cam @ rigid.exp(0.02 * rng.normal(size=(3, 6)))
        problem = Problem(
            jnp.asarray(0.2), jnp.asarray(reduced.root), jnp.asarray(reduced.value), jnp.ones(2),
            jnp.asarray(poses), jnp.asarray(measured), jnp.asarray(roots),
            *jnp.asarray(7 * np.tril(rng.normal(size=(2, 2, 6, 6)))), jnp.asarray(0.8), state, prior,
            (Factor(jnp.asarray(poses[::-1] - 0.03), jax.tree_util.Partial(sped), jnp.asarray([0.3, 2, 1])),),
        )  # fmt: skip
        at, moved = jax.jit(residuals), jax.jit(retract)
        found = at(problem, state, noise)
        assert float(jnp.sum(found.poses.residual**2, axis=1).max()) < 16  # none counts by its size
        groups = {
            "inertial": (found.inertial, np.arange(2)), "motion": (found.motion, np.arange(2)),
            "walk": (found.walk, np.arange(2)), "drift": (found.drift, np.arange(2)),
            "poses": (found.poses, np.asarray(found.pair)), "sped": found.factors[0],
        }  # fmt: skip
        step = 1e-6
        for unknown in range(3 * BLOCK + BORDER):
            row, corner = np.zeros((3, BLOCK)), np.zeros(BORDER)
            if unknown < 3 * BLOCK:
                row[np.unravel_index(unknown, row.shape)] = step
            else:
                corner[unknown - 3 * BLOCK] = step
            ahead = at(problem, moved(state, jnp.asarray(row), jnp.asarray(corner)), noise)
            back = at(problem, moved(state, jnp.asarray(-row), jnp.asarray(-corner)), noise)
            for name, (rows, pair) in groups.items():
                of = lambda x, name=name: x.factors[0][0] if name == "sped" else getattr(x, name)
                by = lambda x, of=of: np.asarray(of(x).residual)
                slope = (by(ahead) - by(back)) / (2 * step)
                pair = np.asarray(pair)
                column = unknown - BLOCK * pair if unknown < 3 * BLOCK else unknown - BLOCK + 0 * pair
                J = np.asarray(rows.jacobian)
                there = (
                    (column >= 0) & (column < J.shape[-1]) & ((unknown >= 3 * BLOCK) | (column < 2 * BLOCK))
                )
                expected = np.zeros(slope.shape)
                for k in np.flatnonzero(there):
                    expected[k] = J[k][..., column[k]]
                scale = max(np.abs(J).max(), 1.0)
                np.testing.assert_allclose(slope, expected, atol=2e-7 * scale, err_msg=f"{name} by {unknown}")


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.0099, 0.0101, 1.0, 3.1])
def test_a_logarithm_moves_with_its_rotation_as_forward_mode_has_it(angle):
    with jax.enable_x64(True):
        phi = angle * jnp.array([0.6, -0.64, 0.48])
        moved = lambda d: se3.so3_log(se3.so3_exp(phi) @ se3.so3_exp(d))
        np.testing.assert_allclose(of_logarithm(phi), jax.jacfwd(moved)(jnp.zeros(3)), atol=1e-14)
