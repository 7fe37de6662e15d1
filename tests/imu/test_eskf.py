"""The pure filter: its derivatives, and that both passes are what the theory says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose.geometry import se3
from jaxpose.imu import GRAVITY_WORLD, ImuNoise, eskf


def random_state(generator):
    turn, rest = generator.normal(size=3), generator.normal(size=(4, 3))
    return eskf.State(
        se3.make(se3.so3_exp(jnp.asarray(turn)), jnp.asarray(rest[0])), *map(jnp.asarray, rest[1:])
    )


def test_retract_and_difference_are_inverse():
    with jax.enable_x64(True):
        generator = np.random.default_rng(0)
        a, b = random_state(generator), random_state(generator)
        for moved, expected in zip(eskf.retract(a, eskf.difference(a, b)), b, strict=True):
            np.testing.assert_allclose(moved, expected, atol=1e-12)


@pytest.mark.parametrize("seed, dt", [(0, 0.005), (1, 0.05), (2, 0.3)])
def test_transition_against_finite_differences(seed, dt):
    """Of the true propagation, at a bias, rate, tilt and speed that are all far from zero."""
    with jax.enable_x64(True):
        generator = np.random.default_rng(seed)
        state = random_state(generator)
        omega, force = (jnp.asarray(generator.normal(size=(2, 3)) * scale) for scale in (2, 10))
        ahead = lambda s: eskf.propagate(s, jnp.asarray(dt), omega, force, jnp.asarray(GRAVITY_WORLD))
        after, F = jax.jit(eskf.transition)(state, jnp.asarray(dt), omega, force, jnp.asarray(GRAVITY_WORLD))
        h = 1e-6
        error = jax.jit(lambda e: eskf.difference(after, ahead(eskf.retract(state, e))))
        moved = [(error(e) - error(-e)) / (2 * h) for e in h * jnp.eye(15)]
        np.testing.assert_allclose(F, np.stack(moved, axis=1), atol=2e-8)


def line(n, measured):
    """A body at rest on a line of n steps of 10 ms without rate, and random poses along x."""
    generator = np.random.default_rng(3)
    x = generator.normal(size=n) * 0.1
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = x
    readings = np.tile([0.0, 0.0, 9.80665], (n, 2, 1))
    readings[:, :, 0] = generator.normal(size=(n, 1)) * 0.3
    return eskf.Step(np.full(n, 0.01), np.zeros((n, 2, 3)), readings, poses, np.zeros(n), measured)


def test_both_passes_against_batch_least_squares():
    """Along x with rotation and biases known this is linear: the smoother must be the one solution of all
    measurements, and the log likelihood that of their joint normal distribution."""
    n, sigma, density, tiny = 40, 0.02, 0.05, 1e-7
    measured = np.arange(n) % 4 == 3
    with jax.enable_x64(True):
        steps = jax.tree.map(jnp.asarray, line(n, measured))
        start = jax.tree.map(jnp.asarray, eskf.State(np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3)))
        P = jnp.diag(jnp.repeat(jnp.array([0.1, 0.5, tiny, tiny, tiny]) ** 2, 3))
        noise = ImuNoise(*map(jnp.asarray, (0.0, density, 0.0, 0.0)))
        passed = eskf.forward(
            start,
            P,
            steps,
            noise,
            eskf.PoseNoise(*map(jnp.asarray, (sigma, 1.0))),
            jnp.asarray(GRAVITY_WORLD),
        )
        smoothed, covariance = eskf.backward(start, P, passed)
    # Every x is linear in the start, its speed and the white noise of each step.
    dt, force = 0.01, np.asarray(steps.acceleration_body[:, 0, 0])
    A = np.zeros((n + 1, n + 2))
    mean, position, speed = np.zeros(n + 1), 0.0, 0.0
    A[:, 0], A[:, 1] = 1, np.arange(n + 1) * dt
    for k in range(n):
        A[k + 1 :, 2 + k] = dt**2 / 2 + np.arange(n - k) * dt**2
        position, speed = position + speed * dt + force[k] * dt**2 / 2, speed + force[k] * dt
        mean[k + 1] = position
    prior = A @ np.diag([0.1**2, 0.5**2] + [density**2 / dt] * n) @ A.T
    seen = np.flatnonzero(measured) + 1
    S = prior[np.ix_(seen, seen)] + sigma**2 * np.eye(len(seen))
    gain = np.linalg.solve(S, prior[seen]).T
    rest = np.asarray(steps.T_world_body)[seen - 1, 0, 3] - mean[seen]
    np.testing.assert_allclose(smoothed.T_world_body[:, 0, 3], mean + gain @ rest, atol=1e-6)
    np.testing.assert_allclose(covariance[:, 0, 0], np.diag(prior - gain @ prior[seen]), rtol=1e-4)
    # The other five components are right and certain but for their own noise, so they add nothing.
    np.testing.assert_allclose(np.asarray(passed.innovation)[measured, 1:], 0, atol=1e-6)
    assert np.asarray(passed.nis)[measured].sum() == pytest.approx(rest @ np.linalg.solve(S, rest), rel=1e-4)
