"""Motion against closed-form trajectories: a helix, a tumbling body, and their composition."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.fields.derivatives import Motion, motion, velocity
from jaxpose.geometry import se3

TIMES = np.linspace(0.0, 4.0, 1000)
TOLERANCE = {jnp.float32: 1e-5, jnp.float64: 1e-10}
RADIUS, RATE, PITCH = 1.5, 2.0, 0.3  # m, rad/s, m/s
SPIN, START = np.array([0.5, -1.2, 0.8]), np.array([0.3, 0.1, -0.4])  # rad/s, rad
SWAY, SWAY_RATE = np.array([0.4, 0.2, -0.3]), 1.7  # rad, rad/s


def skew(w):
    W = np.zeros((*w.shape[:-1], 3, 3))
    for (i, j), component in {(2, 1): 0, (0, 2): 1, (1, 0): 2}.items():
        W[..., i, j], W[..., j, i] = w[..., component], -w[..., component]
    return W


def matrices(rotation, translation):
    T = np.broadcast_to(np.eye(4), (len(TIMES), 4, 4)).copy()
    T[:, :3, :3], T[:, :3, 3] = rotation, translation
    return T


def helix(t):
    """A helix about z with its tangent frame: x along the path, y towards the axis."""
    c, s = jnp.cos(RATE * t), jnp.sin(RATE * t)
    speed = (RADIUS**2 * RATE**2 + PITCH**2) ** 0.5
    up, along = PITCH / speed, RADIUS * RATE / speed
    zero = jnp.zeros_like(t)
    x = jnp.stack([-along * s, along * c, up + zero])
    y = jnp.stack([-c, -s, zero])
    z = jnp.stack([up * s, -up * c, along + zero])
    return se3.make(jnp.stack([x, y, z], axis=1), jnp.stack([RADIUS * c, RADIUS * s, PITCH * t]))


def helix_truth() -> Motion:
    """Frenet's formulas: the frame turns with the world at `RATE` about z, written in its own axes."""
    c, s, zero, one = np.cos(RATE * TIMES), np.sin(RATE * TIMES), 0 * TIMES, 1 + 0 * TIMES
    speed = np.hypot(RADIUS * RATE, PITCH)
    up, along = PITCH / speed, RADIUS * RATE / speed
    frame = np.stack([[-along * s, along * c, up * one], [-c, -s, zero], [up * s, -up * c, along * one]])
    return Motion(
        pose=matrices(frame.transpose(2, 1, 0), np.stack([RADIUS * c, RADIUS * s, PITCH * TIMES], axis=1)),
        velocity_world=np.stack([-RADIUS * RATE * s, RADIUS * RATE * c, PITCH * one], axis=1),
        omega_body=np.stack([RATE * up * one, zero, RATE * along * one], axis=1),
        acceleration_world=-RADIUS * RATE**2 * np.stack([c, s, zero], axis=1),
        alpha_body=np.zeros((len(TIMES), 3)),
    )


def spin(t):
    """A body in free fall that turns at a constant rate from a start attitude."""
    rotation = se3.so3_exp(jnp.asarray(START, t.dtype)) @ se3.so3_exp(t * jnp.asarray(SPIN, t.dtype))
    return se3.make(rotation, jnp.stack([2 * t, jnp.ones_like(t), -4.9 * t**2]))


def spin_truth() -> Motion:
    R = (Rotation.from_rotvec(START) * Rotation.from_rotvec(TIMES[:, None] * SPIN)).as_matrix()
    zero, one = 0 * TIMES, 1 + 0 * TIMES
    return Motion(
        pose=matrices(R, np.stack([2 * TIMES, one, -4.9 * TIMES**2], axis=1)),
        velocity_world=np.stack([2 * one, zero, -9.8 * TIMES], axis=1),
        omega_body=np.broadcast_to(SPIN, (len(TIMES), 3)),
        acceleration_world=np.broadcast_to([0, 0, -9.8], (len(TIMES), 3)),
        alpha_body=np.zeros((len(TIMES), 3)),
    )


def tumble(t):
    """The spinning body on a platform that sways: R = R_spin exp(SWAY sin(w t)), a rate that changes."""
    sway = jnp.concatenate([jnp.zeros(3, t.dtype), jnp.asarray(SWAY, t.dtype) * jnp.sin(SWAY_RATE * t)])
    return se3.compose(spin(t), se3.exp(sway))


def tumble_truth() -> Motion:
    """omega = Q^T SPIN + q', alpha = -q' x Q^T SPIN + q'', with Q = exp(q) about a fixed axis."""
    base = spin_truth()
    angle = SWAY_RATE * TIMES[:, None]
    Q = Rotation.from_rotvec(SWAY * np.sin(angle))
    rate, change = SWAY * SWAY_RATE * np.cos(angle), -SWAY * SWAY_RATE**2 * np.sin(angle)
    carried = Q.inv().apply(SPIN)
    return base._replace(
        pose=base.pose @ matrices(Q.as_matrix(), np.zeros(3)),
        omega_body=carried + rate,
        alpha_body=change - np.cross(rate, carried),
    )


def composed(t):
    """The tumbling body carried along the helix."""
    return se3.compose(helix(t), tumble(t))


def composed_truth() -> Motion:
    """Motion in a steadily turning frame: transport, Coriolis and centripetal terms."""
    outer, inner = helix_truth(), tumble_truth()
    R, Q, p = outer.pose[:, :3, :3], inner.pose[:, :3, :3], inner.pose[:, :3, 3]
    W = skew(outer.omega_body)
    turn = lambda matrix, vector: np.einsum("nij,nj->ni", matrix, vector)
    carried = turn(Q.transpose(0, 2, 1), outer.omega_body)
    return Motion(
        pose=outer.pose @ inner.pose,
        velocity_world=outer.velocity_world + turn(R, inner.velocity_world + turn(W, p)),
        omega_body=carried + inner.omega_body,
        acceleration_world=outer.acceleration_world
        + turn(R, inner.acceleration_world + 2 * turn(W, inner.velocity_world) + turn(W @ W, p)),
        alpha_body=inner.alpha_body - np.cross(inner.omega_body, carried),
    )


def assert_relative(actual, expected, tolerance):
    """Within `tolerance` of the largest magnitude of the quantity (or of 1, where it is zero)."""
    scale = max(np.abs(expected).max(), 1.0)
    np.testing.assert_allclose(np.asarray(actual, float), expected, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize(
    ("pose_fn", "ground_truth"),
    [(helix, helix_truth), (tumble, tumble_truth), (composed, composed_truth)],
)
def test_closed_form_trajectories(pose_fn, ground_truth, dtype):
    """1000 times under jit and vmap, every field of the motion, and the first-order function beside it."""
    both = jax.jit(jax.vmap(lambda s: (motion(pose_fn, s), velocity(pose_fn, s))))
    actual, first_order = both(jnp.asarray(TIMES, dtype))
    expected = ground_truth()
    for field, value in actual._asdict().items():
        assert value.dtype == dtype
        assert_relative(value, getattr(expected, field), TOLERANCE[dtype])
    for value, reference in zip(first_order, expected[:3], strict=True):
        assert_relative(value, reference, TOLERANCE[dtype])


def test_alpha_is_the_derivative_of_omega():
    t = jnp.asarray(TIMES[::100], jnp.float32)
    alpha = jax.jit(jax.vmap(lambda s: motion(tumble, s).alpha_body))(t)
    derivative = jax.jit(jax.vmap(jax.jacfwd(lambda s: velocity(tumble, s)[2])))(t)
    assert_relative(alpha, np.asarray(derivative, float), TOLERANCE[jnp.float32])


@pytest.mark.parametrize("factor", [0.01, 250.0])
def test_reparametrised_time_scales_derivatives(factor, dtype):
    """A field that maps seconds to its own clock still gives derivatives per second."""
    t = jnp.asarray(TIMES[::10] / factor, dtype)
    actual = jax.jit(jax.vmap(lambda s: motion(lambda q: tumble(factor * q), s)))(t)
    expected = tumble_truth()
    powers = Motion(0, 1, 1, 2, 2)
    for field, value in actual._asdict().items():
        assert_relative(
            np.asarray(value, float) / factor ** getattr(powers, field),
            getattr(expected, field)[::10],
            TOLERANCE[dtype],
        )


def test_the_forward_pass_is_shared():
    """A layer costs three products (value, first and second derivative), not one pass for each derivative."""
    weights = 0.1 * jax.random.normal(jax.random.key(0), (3, 8, 8))

    def network(t):
        h = t * jnp.ones(8)
        for w in weights:
            h = jax.nn.softplus(jnp.matmul(w, h, precision="highest"))
        return se3.exp(h[:6])

    compiled = jax.jit(jax.vmap(lambda t: motion(network, t))).lower(jnp.zeros(64)).compile()
    assert compiled.as_text().count(" dot(") == 3 * len(weights)


def test_one_compilation_for_all_times():
    step = jax.jit(chex.assert_max_traces(lambda t: motion(helix, t), n=1))
    for t in (0.0, 0.5, 2.0):
        step(jnp.asarray(t))
