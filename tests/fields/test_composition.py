"""Compositions and per-frame poses against products of matrices written out."""

import inspect
import re
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

from jaxpose import fields
from jaxpose.fields import PoseField
from jaxpose.fields.derivatives import velocity
from jaxpose.geometry import se3

TWIST = jnp.asarray([0.3, -0.2, 0.5, 0.4, 0.1, -0.6])
T_REF = expm(np.array([[0, -1, 0.2, 1], [1, 0, -0.4, -2], [-0.2, 0.4, 0, 3], [0, 0, 0, 0]])).astype(
    np.float32
)


def screw_field(scale=1.0):
    """A field that is easy to write out: exp(t params), which `init` sets to a multiple of TWIST."""
    return PoseField(lambda key: scale * TWIST, lambda params, t: se3.exp(t * params))


def screw(t, scale=1.0):
    x, y, z, a, b, c = np.asarray(TWIST, np.float64) * scale
    return expm(float(t) * np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]]))


def test_every_frame_is_the_product_it_says():
    field = screw_field()
    pose = partial(field.pose, field.init(jax.random.key(0)))
    t, t_ref, reference = jnp.asarray(0.7), jnp.asarray(0.25), jnp.asarray(T_REF)
    P, known = screw(0.7), screw(0.7, -2.0)
    known_field = PoseField(lambda key: {}, lambda params, s: se3.exp(-2.0 * s * TWIST))
    right, left = fields.right_correction(field, known_field), fields.left_correction(field, known_field)
    three = fields.product(field, fields.constant(T_REF), screw_field(3.0))
    both = fields.intrinsic(field, screw_field(3.0))
    for found, expected in (
        (right.pose(right.init(jax.random.key(0)), t), known @ P),
        (left.pose(left.init(jax.random.key(0)), t), P @ known),
        (three.pose(three.init(jax.random.key(0)), t), P @ T_REF @ screw(0.7, 3.0)),
        (both.pose(both.init(jax.random.key(0)), t), P @ screw(0.7, 3.0)),
        (fields.in_frame(pose, reference)(t), T_REF @ P),
        (fields.anchored(pose, t_ref, reference)(t), T_REF @ np.linalg.inv(screw(0.25)) @ P),
        (fields.anchored(pose, t_ref, reference)(t_ref), T_REF),
        (fields.body_to_camera(pose, reference)(t), P @ T_REF),
    ):
        assert_allclose(found, expected, atol=2e-6)


def test_intrinsic_draws_two_networks():
    """Both start anew, from different random numbers."""
    network = fields.posenet(fields.PoseNetConfig(layers=2, width=8))
    params = fields.intrinsic(network, network).init(jax.random.key(0))
    outer, inner = (params[name]["rotation"]["layer_0"]["kernel"] for name in ("outer", "inner"))
    assert np.all(outer != inner)


def test_another_reference_is_no_recompilation():
    pose = lambda t: se3.exp(t * TWIST)

    @jax.jit
    @chex.assert_max_traces(n=1)
    def world(t, t_ref, T_world_ref):
        return fields.in_frame(pose, T_world_ref)(t), fields.anchored(pose, t_ref, T_world_ref)(t)

    for k in range(3):
        t, T_world_ref = jnp.asarray(0.1 * k), jnp.asarray(screw(k), jnp.float32)
        first, second = world(t, jnp.asarray(0.0), T_world_ref)
        assert_allclose(first, screw(1.1 * k), atol=5e-6)
        assert_allclose(second, first, atol=2e-6)


STAMPS = np.array([0.0, 0.5, 2.0])


def stamped_screw():
    """Stamped poses of a screw motion, which interpolation at constant twist reproduces."""
    poses = np.array([screw(t) for t in STAMPS])
    return jax.jit(partial(fields.piecewise_geodesic(STAMPS, poses).pose, {}))


@pytest.mark.parametrize("t", [0.0, 0.1, 0.5, 0.51, 1.3, 2.0])
def test_stamped_poses_and_between_them(t, dtype):
    found = stamped_screw()(jnp.asarray(t, dtype))
    assert_allclose(found, screw(t), atol=2e-6 if dtype == jnp.float32 else 1e-14)


@pytest.mark.parametrize(("t", "end"), [(-3.0, 0.0), (2.1, 2.0)])
def test_stamped_poses_stand_still_outside(t, end):
    pose = stamped_screw()
    found, linear, angular = velocity(pose, jnp.asarray(t))
    assert_allclose(found, screw(end), atol=2e-6)
    assert np.all(linear == 0) and np.all(angular == 0)


@pytest.mark.parametrize("t", [0.0, 0.5, 1.0, 2.0])
def test_stamped_poses_move_at_the_ends_too(t):
    """Exactly at the first timestamp, where a clipped fraction would have half the derivative."""
    _, linear, angular = jax.jit(partial(velocity, stamped_screw()))(jnp.asarray(t))
    assert_allclose(linear, screw(t)[:3, :3] @ np.asarray(TWIST[:3]), atol=3e-6)
    assert_allclose(angular, TWIST[3:], atol=3e-6)


def test_one_stamp_is_a_constant():
    field = fields.piecewise_geodesic(np.array([1.0]), T_REF[None])
    assert_allclose(field.pose({}, 5.0), T_REF)
    assert field == fields.piecewise_geodesic(np.ones(1), T_REF[None]) != fields.constant(T_REF)


@pytest.mark.parametrize(
    ("times", "poses", "message"),
    [
        ([0.0, 1.0], np.eye(4)[None], "poses: expected shape (2, 4, 4), got (1, 4, 4)"),
        ([0.0, 0.0], np.tile(np.eye(4), (2, 1, 1)), "times: expected increasing times, got 0.0 after 0.0 s"),
        ([], np.zeros((0, 4, 4)), "times: expected at least one, got none"),
    ],
)
def test_stamped_poses_that_mean_nothing_are_refused(times, poses, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        inspect.unwrap(fields.piecewise_geodesic)(np.array(times), poses)


def test_compositions_that_mean_nothing_are_refused():
    early, late = fields.bspline((0.0, 1.0), 2), fields.bspline((2.0, 3.0), 2)
    with pytest.raises(ValueError, match=r"time in common, got \(0, 1\), \(2, 3\)"):
        fields.product(early, late)
    with pytest.raises(ValueError, match="without parameters, got one with"):
        fields.left_correction(early, early)
    with pytest.raises(ValueError, match="expected at least one field"):
        fields.product()


@pytest.mark.parametrize(
    ("t", "row"), [(-1.0, 0), (0.0, 0), (0.24, 0), (0.26, 1), (1.24, 1), (1.26, 2), (9.0, 2)]
)
def test_the_nearest_of_per_frame_poses(t, row):
    field = fields.per_frame_poses(STAMPS)
    params = jnp.asarray([2 * TWIST, -1 * TWIST, 0.5 * TWIST])
    found, linear, angular = jax.jit(partial(velocity, partial(field.pose, params)))(jnp.asarray(t))
    assert_allclose(found, screw([2, -1, 0.5][row]), atol=2e-6)
    assert np.all(linear == 0) and np.all(angular == 0)


def test_per_frame_poses_start_at_the_identity(dtype):
    field = fields.per_frame_poses(STAMPS)
    params = field.init(jax.random.key(0))
    assert params.shape == (3, 6) and params.dtype == dtype
    assert_allclose(jax.jit(field.pose)(params, jnp.asarray(0.5, dtype)), np.eye(4))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([], "at least one, got none"),
        ([0.0, 0.0], "got 0.0 after 0.0 s"),
        ([1.0, 0.5], "got 0.5 after 1.0 s"),
    ],
)
def test_per_frame_poses_refuse_times_that_do_not_increase(times, message):
    with pytest.raises(ValueError, match=f"times: expected .*{message}"):
        fields.per_frame_poses(np.array(times))
