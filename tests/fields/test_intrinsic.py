"""Degrees of freedom of a motion against scipy and by hand, and the intrinsic frame that makes them few."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from jaxpose.fields import PoseNetConfig, intrinsic, posenet
from jaxpose.fields.intrinsic_motion import components, dof_loss, effective_dof, outer_loss
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, angle_of_view
from jaxpose.slam.tracking.intrinsic_frame import is_due, make_refit, window

VIEW = np.deg2rad(60)


def motion(angles_deg=(0, 0, 0), v=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()
    T[:3, 3] = v
    return jnp.asarray(T, jnp.float32)


def test_components_are_scipys_euler_angles_and_a_direction():
    rng = np.random.default_rng(0)
    angles, v = rng.uniform(-80, 80, (20, 3)), rng.normal(size=(20, 3))
    T = jnp.stack([motion(a, x) for a, x in zip(angles, v, strict=True)])
    direction = v / np.linalg.norm(v, axis=1, keepdims=True)
    assert_allclose(components(T, VIEW), np.hstack([angles / 30, direction]), atol=2e-5)


def test_the_angle_of_view_is_from_edge_to_edge():
    angles = angle_of_view(Camera(320.0, 320.0, 319.5, 239.5, 640, 480))
    assert angles == pytest.approx((np.pi / 2, 2 * np.arctan(0.75)))


@pytest.mark.parametrize(
    ("angles", "v", "dof"),
    [
        ((0, 0, 0), (0, 0, 0), 0),
        ((0, 0, 0), (0.1, 0, 0), 1),
        ((0, 5, 0), (0.01, 0, -0.01), 3),
        ((1, 1, 1), (1, 2, 3), 6),
        ((0.2, 0.4, 0), (0, 0, 1e-7), 1),  # below 0.3 degrees, and too short to have a direction
    ],
)
def test_degrees_of_freedom_by_hand(angles, v, dof):
    assert int(effective_dof(motion(angles, v), VIEW)) == dof


def test_the_losses_are_l1_norms_with_finite_gradients_at_rest():
    assert float(dof_loss(motion((3, 0, -6), (0, 0.3, 0.4)), VIEW)) == pytest.approx(
        0.1 + 0.2 + 1.4, abs=1e-5
    )
    assert float(outer_loss(motion((9, 9, 9), (0.1, -0.2, 0.3)))) == pytest.approx(0.6)
    for loss in (lambda T: dof_loss(T, VIEW), outer_loss):
        gradient = jax.jit(jax.grad(lambda xi, loss=loss: loss(se3.exp(xi))))
        assert np.isfinite(gradient(jnp.zeros(6))).all()


def test_the_intrinsic_frame_takes_what_is_common_and_leaves_every_motion_as_it_was():
    """A camera that pans at a steady rate and moves along a line: three degrees of freedom become one."""
    t = jnp.arange(1, 11, dtype=jnp.float32) / 5
    steps = np.random.default_rng(0).uniform(0.02, 0.06, 10)
    T = np.stack([motion((2, 4, 0), (step, 0, 0)) for step in steps])
    net = posenet(PoseNetConfig(layers=3, width=48, activation="softplus", span=(0.0, 2.0)))
    params = jax.jit(intrinsic(net, net).init)(jax.random.key(0))
    found, T_inner = make_refit(net, net, VIEW)(params, t, T)
    before, after = (np.asarray(jax.jit(lambda T: effective_dof(T, VIEW))(T)) for T in (T, T_inner))
    assert_array_equal(before, 3)
    assert after.mean() < 1.5
    T_outer = np.asarray(jax.jit(jax.vmap(lambda s: net.pose(found["outer"], s)))(t))
    assert_allclose(T_outer @ np.asarray(T_inner), T, atol=1e-6)
    assert np.abs(T_outer[:, :3, 3]).max() < 0.01
    field = jax.jit(jax.vmap(lambda s: intrinsic(net, net).pose(found, s)))(t)
    assert_allclose(field[-4:], T[-4:], atol=1e-3)


def test_every_motion_is_in_one_window():
    """Of those up to the last time that the frame was due; of the first window the first motion repeats."""
    due = [i for i in range(31) if is_due(i)]
    covered = np.concatenate([window(i) for i in due])
    assert_array_equal(covered, np.arange(1, 31))
    assert_array_equal(window(3), [1] * 8 + [2, 3])
