"""What another JAX project sees: fields, motion, renderer, losses and IMU alone, with a scene of its own."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from jaxpose import PoseNetConfig, Ray, imu, motion, posenet, render_ray, surface_weights
from jaxpose.losses import weighted_mean

pytestmark = pytest.mark.optimised

TIMES = jnp.linspace(0.0, 1.0, 5)
DEPTHS = jnp.linspace(0.5, 3.5, 41)
WALLS = jnp.array([0.6, 0.4, 2.0])  # [m] x, y and z of the walls of a corner


def corner(point, direction):
    """Their scene: signed distance to a corner of a room whose walls are painted in waves."""
    del direction
    return jnp.min(WALLS - point), 0.5 + 0.3 * jnp.sin(4 * point)


def ground_truth(t):
    """Their camera: a swing and a slow turn, as a plain function."""
    c, s = jnp.cos(0.15 * t), jnp.sin(0.15 * t)
    zero, one = jnp.zeros_like(t), jnp.ones_like(t)
    rows = [[c, zero, s, 0.1 * jnp.sin(2 * t)], [zero, one, zero, 0.05 * t], [-s, zero, c, zero]]
    return jnp.stack([jnp.stack(row) for row in [*rows, [zero, zero, zero, one]]])


def directions():
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 10), np.linspace(-0.5, 0.5, 8))
    return jnp.asarray(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1), jnp.float32)


def photograph(T_world_cam):
    """Their image: colour and depth of every pixel."""

    def pixel(direction_cam):
        ray = Ray(T_world_cam[:3, 3], T_world_cam[:3, :3] @ direction_cam)
        seen = render_ray(corner, ray, DEPTHS, weights=surface_weights(0.05))
        return jnp.append(seen.rgb, seen.depth)

    return jax.vmap(pixel)(directions())


def pose_errors(pose_fn):
    """Largest errors over the photographs [m, degrees]."""
    T, T_true = (np.asarray(jax.vmap(f)(TIMES), np.float64) for f in (pose_fn, ground_truth))
    turn = Rotation.from_matrix(T[:, :3, :3].transpose(0, 2, 1) @ T_true[:, :3, :3])
    return np.linalg.norm((T - T_true)[:, :3, 3], axis=1).max(), np.degrees(turn.magnitude()).max()


def test_a_trajectory_is_found_through_their_scene_and_gyroscope():
    config = PoseNetConfig(span=(0.0, 1.0), octaves=1, layers=3, width=32, activation="softplus", gain=2.0)
    field = posenet(config)
    photographs = jax.jit(jax.vmap(lambda t: photograph(ground_truth(t))))(TIMES)
    gyro_times = jnp.linspace(0.0, 1.0, 20)
    omega_body = jax.vmap(lambda t: motion(ground_truth, t).omega_body)(gyro_times)
    adam = optax.adam(optax.exponential_decay(3e-3, 1000, 0.01))

    def loss_fn(params):
        pose_fn = lambda t: field.pose(params, t)
        error = jax.vmap(lambda t: photograph(pose_fn(t)))(TIMES) - photographs
        rate_error = imu.gyro_tight_residual(pose_fn, gyro_times, omega_body)
        return weighted_mean(error**2, jnp.ones_like(error)) + 0.02 * jnp.mean(rate_error**2)

    @jax.jit
    def train(params):
        def step(carry, _):
            params, state = carry
            loss, gradient = jax.value_and_grad(loss_fn)(params)
            with jax.numpy_dtype_promotion("standard"):
                updates, state = adam.update(gradient, state)
            return (optax.apply_updates(params, updates), state), loss

        (params, _), losses = jax.lax.scan(step, (params, adam.init(params)), length=1000)
        return params, losses

    start = field.init(jax.random.key(0))
    params, losses = train(start)
    metres, degrees = pose_errors(lambda t: field.pose(start, t))
    assert metres > 0.08 and degrees > 5
    metres, degrees = pose_errors(lambda t: field.pose(params, t))
    assert metres < 1e-2 and degrees < 0.4
    assert losses[-1] < 1e-3 * losses[0]


def test_importing_them_brings_nothing_else():
    code = """
import sys
from jaxpose import PoseNetConfig, Ray, imu, losses, motion, posenet, render_ray, surface_weights
imu.gyro_tight_residual, losses.weighted_mean
parts = ("slam", "datasets", "experiments", "plots", "scenes", "evaluation", "events", "training", "cli")
others = [f"jaxpose.{part}" for part in parts] + ["matplotlib", "imageio", "PIL", "tyro", "evo"]
print([name for name in others if name in sys.modules])
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
