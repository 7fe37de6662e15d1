"""The B-spline against closed-form motion, scipy's splines and itself in float64."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import BSpline
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxpose.fields import bspline, control_points, control_points_along
from jaxpose.fields.derivatives import motion, velocity
from jaxpose.geometry import se3

SCREW = np.array([1.5, 1.0, 4.0, 1.0, 5.5, 2.0])  # 5.9 rad/s: once past 180 degrees in a second
FIRST, LAST, INTERVALS = 2.0, 3.0, 20
# One field and one number of times for most tests: the derivatives compile once for each precision.
FIELD = bspline((FIRST, LAST), INTERVALS)
CONTROLS = FIRST + (LAST - FIRST) / INTERVALS * (np.arange(INTERVALS + 3) - 1)
TIMES = np.linspace(FIRST, LAST, 41).astype(np.float32)  # knots and both ends among them
motions = jax.jit(lambda params, times: jax.vmap(lambda t: motion(partial(FIELD.pose, params), t))(times))
poses = jax.jit(jax.vmap(FIELD.pose, in_axes=(None, 0)))


def wedge(xi):
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -xi[5], xi[4]], [xi[5], 0, -xi[3]], [-xi[4], xi[3], 0]]
    matrix[:3, 3] = xi[:3]
    return matrix


def screw(t):
    """A constant twist from a start that is not the identity."""
    start = expm(wedge([1.0, -2.0, 0.5, 0.3, -0.2, 0.1]))
    return start @ expm((float(t) - FIRST) * wedge(SCREW))


def params_of(poses):
    with jax.enable_x64(True):
        return np.asarray(jax.jit(control_points)(jnp.asarray(np.array(poses))))


def wobbly_params(step, intervals=INTERVALS, seed=0):
    """A random walk of control poses with steps of `step` m and rad, in float64."""
    rng = np.random.default_rng(seed)
    walk = [np.eye(4)]
    for _ in range(intervals + 2):
        walk.append(walk[-1] @ expm(wedge(step * rng.normal(size=6))))
    return params_of(walk)


def assert_close(found, expected, relative):
    """Equal to a fraction of the largest vector of the series."""
    scale = np.max(np.linalg.norm(expected, axis=-1))
    assert_allclose(found, expected, rtol=0, atol=relative * scale)


def test_motion_of_a_screw_is_that_of_the_closed_form(dtype):
    """Control poses on a screw motion give that motion, rotating past 180 degrees."""
    params = params_of([screw(t) for t in CONTROLS])
    found = motions(jnp.asarray(params, dtype), jnp.asarray(TIMES, dtype))
    T = np.array([screw(t) for t in TIMES])
    linear, angular = T[:, :3, :3] @ SCREW[:3], T[:, :3, :3] @ SCREW[3:]
    relative = 1e-5 if dtype == jnp.float32 else 3e-12
    assert_allclose(found.pose, T, atol=relative)
    assert_close(found.velocity_world, linear, relative)
    assert_close(found.acceleration_world, np.cross(angular, linear), relative)
    assert_close(found.omega_body, np.tile(SCREW[3:], (41, 1)), relative)
    assert_allclose(found.alpha_body, 0, atol=relative * np.sum(SCREW[3:] ** 2))


def test_single_precision_derivatives_are_those_of_the_same_spline_in_double():
    """Slow motion far from the origin, steps of 2 cm: only what the parameters round is lost."""
    params = wobbly_params(0.02).astype(np.float32)
    params[:, :3] += np.float32(3.0)
    single = motions(jnp.asarray(params), jnp.asarray(TIMES))
    with jax.enable_x64(True):
        double = motions(jnp.asarray(params, jnp.float64), jnp.asarray(TIMES, jnp.float64))
        double = jax.tree.map(np.asarray, double)
    assert_close(single.velocity_world, double.velocity_world, 1e-5)
    assert_close(single.omega_body, double.omega_body, 1e-5)
    assert_close(single.acceleration_world, double.acceleration_world, 1e-5)
    assert_close(single.alpha_body, double.alpha_body, 1e-5)


def test_without_rotation_it_is_scipys_cubic_spline(dtype):
    points = np.random.default_rng(0).normal(size=(INTERVALS + 3, 3))
    params = np.concatenate([points, np.zeros((INTERVALS + 3, 4))], axis=-1)
    knots = FIRST + (LAST - FIRST) / INTERVALS * (np.arange(INTERVALS + 7) - 3)
    oracle = BSpline(knots, points, 3)
    found = motions(jnp.asarray(params, dtype), jnp.asarray(TIMES, dtype))
    times = TIMES.astype(np.float64)
    relative = 1e-5 if dtype == jnp.float32 else 1e-12
    assert_close(found.pose[:, :3, 3], oracle(times), relative)
    assert_close(found.velocity_world, oracle(times, 1), relative)
    assert_close(found.acceleration_world, oracle(times, 2), relative)
    assert_allclose(found.pose[:, :3, :3], np.tile(np.eye(3), (41, 1, 1)), atol=relative)


def test_twice_continuously_differentiable_across_knots():
    with jax.enable_x64(True):
        params = jnp.asarray(wobbly_params(0.5))
        knots = np.linspace(FIRST, LAST, 21)[1:-1]
        times = np.concatenate([knots - 1e-10, knots + 1e-10, [2.1, 2.2, 2.3]])
        found = motions(params, jnp.asarray(times))
        for series in found:
            assert_close(series[:19], series[19:38], 1e-7)
        assert np.min(np.linalg.norm(found.alpha_body[:19], axis=-1)) > 1, (
            "there is something to be continuous"
        )


def test_control_poses_act_locally():
    """Control pose j moves the intervals j - 3 .. j and no other."""
    params = jnp.asarray(wobbly_params(0.05), jnp.float32)
    middles = jnp.asarray(CONTROLS[1:21] + 0.025, jnp.float32)
    change = np.abs(poses(params.at[8].add(0.1), middles) - poses(params, middles)).max(axis=(1, 2))
    assert_allclose(change[[*range(5), *range(9, 20)]], 0, atol=3e-7)
    assert np.all(change[5:9] > 1e-3)


def test_control_poses_along_stamped_ones_are_those_of_their_screw():
    """At knots between timestamps too, in seconds since 1970; beyond the ends it stands still."""
    times = 1.7e9 + np.linspace(0, 1, 8)
    found = control_points_along(times, np.array([screw(FIRST + t) for t in np.linspace(0, 1, 8)]), INTERVALS)
    expected = params_of([screw(np.clip(t, FIRST, LAST)) for t in CONTROLS])
    assert_allclose(found, expected, atol=1e-6)


def test_control_points_cross_half_a_turn():
    """Quaternions of neighbours stay on one side although each rotation alone has two."""
    angles = np.linspace(0, 4 * np.pi, 23)
    turning = np.tile(np.eye(4, dtype=np.float32), (23, 1, 1))
    turning[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, [0.6, 0, 0.8])).as_matrix()
    params = np.asarray(jax.jit(control_points)(jnp.asarray(turning)))
    assert np.max(np.linalg.norm(np.diff(params[:, 3:], axis=0), axis=-1)) < 0.3
    identity = np.array([1, 0, 0, 0], np.float32)
    found = jax.jit(se3.quaternion_to_rotation)(jnp.asarray(params[:, 3:] + identity))
    assert_allclose(found, turning[:, :3, :3], atol=1e-6)


def test_zero_parameters_are_the_identity_at_rest(dtype):
    params = FIELD.init(jax.random.key(0))
    assert params.shape == (INTERVALS + 3, 7) and params.dtype == dtype
    found = motions(params, jnp.asarray(TIMES, dtype))
    assert_allclose(found.pose, np.tile(np.eye(4), (41, 1, 1)))
    assert_allclose(np.concatenate(found[1:], axis=-1), 0)


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_gradients_are_those_of_finite_differences(order):
    """With respect to the control poses, at zero too, of the pose and of its rates or accelerations."""
    field = bspline((0.0, 3.0), 3)
    weights = np.random.default_rng(1).normal(size=(4, 4))

    def value(params):
        found = (velocity if order == 1 else motion)(partial(field.pose, params), jnp.asarray(1.3))
        linear, angular = found[2 * order - 1 :]
        return jnp.sum(weights * found[0]) + jnp.sum(linear + angular)

    with jax.enable_x64(True):
        gradient_of, several = jax.jit(jax.grad(value)), jax.jit(jax.vmap(value))
        steps = 1e-5 * np.eye(42).reshape(42, 6, 7)
        for start in (np.zeros((6, 7)), wobbly_params(0.5, intervals=3)):
            gradient = np.asarray(gradient_of(jnp.asarray(start)))
            expected = (several(jnp.asarray(start + steps)) - several(jnp.asarray(start - steps))) / 2e-5
            assert_allclose(gradient.ravel(), expected, atol=1e-7)
            assert np.all(gradient[[0, 5]] == 0), "of another interval"
            assert np.max(np.abs(gradient[1])) > 0.1


@pytest.mark.parametrize(("span", "intervals"), [((1.0, 1.0), 3), ((0.0, 1.0), 0)])
def test_settings_that_mean_nothing_are_refused(span, intervals):
    with pytest.raises(ValueError, match="expected first < last and intervals >= 1"):
        bspline(span, intervals)
