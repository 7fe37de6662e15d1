"""Iterations that tracking by gradient takes from a predicted pose to the true one (paper, table 15 right).

The room and the loss of `tracking.py`. Every start is off by a random motion; an iteration draws new pixels
and takes one step of Adam, on six free numbers (a twist) or on a PoseNet brought to the start first.
Converged is where the pose stays within `--metres` and `--degrees` of the ground truth for the rest of the
way.

    python benchmarks/convergence.py --help
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from timing import machine
from tracking import FIELDS, make_loss, room

from jaxpose import optim
from jaxpose.fields import posenet, project_onto_poses
from jaxpose.geometry import se3
from jaxpose.geometry.rigid import rotation_angle
from jaxpose.slam.config import TrackConfig


@dataclass(frozen=True)
class Config:
    """Starts, their distance, and what counts as converged."""

    starts: int = 20
    iterations: int = 150
    rays: int = 1000
    off_metres: float = 0.03  # of a start, standard deviation of each axis
    off_degrees: float = 1.0
    metres: float = 0.005
    degrees: float = 0.2


def make_descent(scene, pose_of, rates, config: Config):
    """The compiled descent `(parameters, scene parameters, image, key) -> poses (iterations, 4, 4)`."""
    loss_fn = make_loss(scene, pose_of, rays=config.rays, even=32, near=16)

    @jax.jit
    def descent(params, scene_params, image, key, rate):
        def improve(carry, key):
            params, state = carry
            gradient = jax.grad(loss_fn)(params, scene_params, image, key)
            params, state = optim.apply(adam, params, gradient, state)
            return (params, state), pose_of(params)

        decay = optax.exponential_decay(rate, config.iterations, TrackConfig().decay)
        schedules = jax.tree.map(lambda r: lambda count: r * decay(count), rates)
        adam = optax.chain(optax.scale_by_adam(), optim.scale_by_rates(schedules))
        keys = jax.random.split(key, config.iterations)
        return jax.lax.scan(improve, (params, adam.init(params)), keys)[1]

    return descent


def converged(poses: np.ndarray, config: Config) -> float:
    """The first iteration from which on the poses are near ground truth, which is the identity; inf: none."""
    angle = np.degrees(rotation_angle(poses[:, :3, :3], np.eye(3)))
    near = (np.linalg.norm(poses[:, :3, 3], axis=1) < config.metres) & (angle < config.degrees)
    far = np.flatnonzero(~near)
    after = far[-1] + 1 if len(far) else 0
    return float(after + 1) if after < len(near) else np.inf


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    scene, scene_params, image = room()
    t = jnp.float32(0.5)
    sigma = np.repeat([config.off_metres, np.deg2rad(config.off_degrees)], 3)
    starts = sigma * np.random.default_rng(0).normal(size=(config.starts, 6))
    variants = {"six numbers": (lambda twist: se3.exp(twist), lambda twist: twist, jnp.ones(6))}
    for name, settings in FIELDS.items():
        field = posenet(settings)
        first = field.init(jax.random.key(0))
        fit = jax.jit(
            lambda twist, field=field, first=first: project_onto_poses(
                lambda p: field.pose(p, t)[None], first, se3.exp(twist)[None]
            )
        )
        rates = {"translation": 1.0, "rotation": 0.2}  # METHOD section 2: 1e-3 and 2e-4
        rates = {part: jax.tree.map(lambda _, r=r: r, first[part]) for part, r in rates.items()}
        variants[name] = (lambda params, field=field: field.pose(params, t), fit, rates)
    print(machine())
    print(
        f"{config.starts} starts off by {config.off_metres:g} m and {config.off_degrees:g} deg an axis, "
        f"{config.rays} rays x 48 samples; iterations until within {config.metres:g} m and "
        f"{config.degrees:g} deg for good, median (middle half):"
    )
    for name, (pose_of, fit, rates) in variants.items():
        descent = make_descent(scene, pose_of, rates, config)
        for rate in (5e-4, 1e-3, 2e-3):
            found = []
            for k, start in enumerate(starts):
                params = fit(jnp.asarray(start, jnp.float32))
                poses = descent(params, scene_params, image, jax.random.key(k), jnp.float32(rate))
                found.append(converged(np.asarray(poses, np.float64), config))
            low, middle, high = np.percentile(found, [25, 50, 75], method="nearest")
            lost = int(np.isinf(found).sum())
            print(f"  {name:26s} rate {rate:g}: {middle:g} ({low:g} to {high:g}), {lost} never")


if __name__ == "__main__":
    main()
