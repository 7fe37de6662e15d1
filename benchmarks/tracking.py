"""Cost of one tracking iteration with NICE-SLAM's Replica work: 200 rays x 48 samples, 16 at the surface.

An iteration draws pixels, renders them, takes the gradient of the loss and one step of Adam. What is
optimised is either six free numbers (a twist) or a PoseNet; iterations run inside one compiled loop.

    python benchmarks/tracking.py --help
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from timing import in_turn, machine, milliseconds

from jaxpose.datasets.types import Frame
from jaxpose.fields import PoseNetConfig, posenet
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, pixel_grid, unproject_numpy
from jaxpose.optim import minimize
from jaxpose.scenes import bounding_grid, grid, node_positions
from jaxpose.slam.config import SampleConfig, TrackConfig
from jaxpose.slam.observation import sample_pixels, to_device
from jaxpose.slam.tracking.gradient import image_residuals
from jaxpose.slam.tracking.register import image_loss

CAMERA = Camera(585.0, 585.0, 320.0, 240.0, 640, 480)
FIELDS = {
    "PoseNet 4 x 128 softplus": PoseNetConfig(layers=4, width=128, activation="softplus"),
    "PoseNet 8 x 256 relu": PoseNetConfig(),
}
HALF = np.array([2.5, 1.5, 3.0])  # [m] of the room, whose centre is where the camera is


@dataclass(frozen=True)
class Config:
    """How long to measure."""

    iterations: int = 100  # inside one compiled call
    repeats: int = 15
    rays: int = 200
    even: int = 32  # samples in front of the surface
    near: int = 16  # samples through it


def room() -> tuple:
    """A box-shaped room of coloured walls on about 400,000 nodes: the scene, its parameters, one image."""
    config = bounding_grid(np.stack([-HALF, HALF]), levels=1)
    nodes = node_positions(config)
    distance = np.clip((HALF - np.abs(nodes)).min(axis=-1), -config.truncation, config.truncation)
    values = np.concatenate([distance[..., None], colour(nodes)], axis=-1)
    direction = unproject_numpy(CAMERA, pixel_grid(CAMERA))
    depth = (HALF / np.maximum(np.abs(direction), 1e-9)).min(axis=-1)
    rgb = (255 * colour(depth[..., None] * direction)).astype(np.uint8)
    return grid(config), (jnp.asarray(values, jnp.float32),), to_device(Frame(rgb, depth))


def colour(point: np.ndarray) -> np.ndarray:
    return 0.5 + 0.4 * np.sin(3 * point)


def make_loss(scene, pose_of, *, rays: int, even: int, near: int):
    """The loss `(parameters, scene parameters, image, key)` on newly drawn pixels."""
    track = TrackConfig(pixels=rays, sample=SampleConfig(front=even, surface=near, behind=0))

    def loss_fn(params, scene_params, image, key):
        pixels = sample_pixels(key, image, CAMERA, track.pixels, edge=track.edge)
        query = partial(scene.query, scene_params)
        return image_loss(image_residuals(query, pose_of(params), pixels, jnp.float32(8.0), track), track)

    return loss_fn


def make_loop(scene, pose_of, config: Config):
    """The compiled loop `(parameters, scene parameters, image, key) -> (parameters, last loss)`."""
    loss_fn = make_loss(scene, pose_of, rays=config.rays, even=config.even, near=config.near)
    adam = optax.adam(1e-4)

    @jax.jit
    def loop(params, scene_params, image, key):
        keys = jax.random.split(key, config.iterations)
        loss = lambda params, i: loss_fn(params, scene_params, image, keys[i])
        found = minimize(loss, params, adam, config.iterations)
        return found.params, found.loss

    return loop


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    scene, scene_params, image = room()
    key = jax.random.key(0)
    start = jnp.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.01])
    variants = {"six numbers": (lambda twist: se3.exp(twist), start)}
    for name, settings in FIELDS.items():
        field = posenet(settings)
        variants[name] = (lambda params, field=field: field.pose(params, jnp.float32(0.5)), field.init(key))
    loops = {
        name: partial(make_loop(scene, pose_of, config), params, scene_params, image, key)
        for name, (pose_of, params) in variants.items()
    }
    times = {name: taken / config.iterations for name, taken in in_turn(loops, config.repeats).items()}
    print(machine())
    nodes = scene_params[0][..., 0].size
    print(f"{config.rays} rays x {config.even + config.near} samples, {nodes} nodes, per iteration:")
    for name, taken in times.items():
        print(f"  {name:26s}{milliseconds(taken)}")
    for name in FIELDS:
        # Differences of neighbours in time: what drifts goes out.
        print(f"  {name + ' adds':31s}{milliseconds(times[name] - times['six numbers'])}")


if __name__ == "__main__":
    main()
