"""A radiance field and camera poses optimised together from photographs (the paper's section 4.1, eq. 3)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from jaxpose import render
from jaxpose.fields import PoseField
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, unproject
from jaxpose.render import Ray, Spacing
from jaxpose.scenes import SceneField
from jaxpose.training.steps import Trainer, joint, microbatched_sum

Params = Any


@dataclass(frozen=True)
class TrainConfig:
    """How long and on what; the defaults are BARF's on Blender (PEERS B1), the paper draws 4096 rays."""

    steps: int = 200_000
    rays: int = 1024  # random pixels of random images in a step
    samples: int = 128  # along each ray, stratified
    chunk: int = 32  # rays computed at a time: what is stored between the two passes

    def __post_init__(self):
        if min(self.steps, self.rays, self.samples, self.chunk) < 1:
            raise ValueError(f"TrainConfig: expected steps, rays, samples and chunk >= 1, got {self}")


class Depths(NamedTuple):
    """Where samples lie along the optical axis [scene units], equally spaced in depth or in disparity."""

    near: float
    far: float
    spacing: Spacing = "depth"


class Views(NamedTuple):
    """Training images and the times [s] at which their poses are asked for."""

    t: Float[Array, " n"]
    rgb: UInt8[Array, "n h w 3"]


def trainer(
    scene: SceneField,
    field: PoseField,
    camera: Camera,
    depths: Depths,
    scene_rates: Any,
    pose_rates: Any,
    config: TrainConfig = TrainConfig(),  # noqa: B008 - frozen
) -> Trainer:
    """Adam on the mean squared colour error of random rays, jointly over scene and poses.

    `field.pose` is camera-to-world; `scene` has a volume density; the rates are as in `train.joint`. Samples
    are drawn anew for every ray. Rays that end nowhere are as in BARF: the last sample closes them.
    """

    def error(scene_params, item):
        ray, depth, rgb = item
        return jnp.sum((ray_colour(scene, scene_params, ray, depth)[0] - rgb) ** 2)

    total = microbatched_sum(error, min(config.chunk, config.rays))

    def loss(scene_params, pose_params, views, key):
        view_key, pixel_key, depth_key = jax.random.split(key, 3)
        count, height, width, _ = views.rgb.shape
        view = jax.random.randint(view_key, (config.rays,), 0, count)
        x, y = _pixels(pixel_key, config.rays, height, width)
        # Once for every image, not for every ray.
        T_world_cam = jax.vmap(field.pose, (None, 0))(pose_params, views.t)[view]
        rays = jax.vmap(partial(pixel_ray, camera))(T_world_cam, x, y)
        batch = (
            rays,
            draw_depths(depth_key, depths, rays=config.rays, samples=config.samples),
            _unit(views.rgb[view, y, x]),
        )
        return total(scene_params, batch) / (3 * config.rays)

    return joint(loss, scene.init, field.init, scene_rates, pose_rates, config.steps)


class Viewer(NamedTuple):
    """Compiled functions that look at a trained scene from any pose of one camera."""

    # Colour in [0, 1] and z-depth [scene units] of all pixels.
    image: Callable[[Params, Float[Array, "4 4"]], tuple[Float[Array, "h w 3"], Float[Array, "h w"]]]
    # Camera-to-world pose moved, by turns and shifts of the world, to where the scene explains an image.
    settle: Callable[[Params, Float[Array, "4 4"], UInt8[Array, "h w 3"], PRNGKeyArray], Float[Array, "4 4"]]


def viewer(
    scene: SceneField,
    camera: Camera,
    depths: Depths,
    config: TrainConfig = TrainConfig(),  # noqa: B008 - frozen
    *,
    background: float | None = None,
    settle_steps: int = 100,
    settle_rate: float = 1e-3,
) -> Viewer:
    """`image` samples the middles of equal parts; `settle` is BARF's test-time optimisation of one pose.

    That is Adam at a constant rate on a twist, the scene at rest, `config.rays` random pixels a step.
    """
    adam = optax.adam(settle_rate)

    def image(scene_params, T_world_cam):
        y, x = jnp.mgrid[: camera.height, : camera.width]
        depth = render.sample_depths(None, depths.near, depths.far, config.samples, spacing=depths.spacing)
        one = lambda xy: ray_colour(
            scene, scene_params, pixel_ray(camera, T_world_cam, *xy), depth, background
        )
        rgb, found = jax.lax.map(one, (x.ravel(), y.ravel()), batch_size=config.chunk)
        return rgb.reshape(*x.shape, 3), found.reshape(x.shape)

    def settle(scene_params, T_world_cam, rgb, key):
        def error(_, item):
            ray, depth, seen = item
            return jnp.sum((ray_colour(scene, scene_params, ray, depth, background)[0] - seen) ** 2)

        total = microbatched_sum(error, min(config.chunk, config.rays))

        def loss(twist, key):
            pixel_key, depth_key = jax.random.split(key)
            x, y = _pixels(pixel_key, config.rays, *rgb.shape[:2])
            moved = se3.compose(se3.exp(twist), T_world_cam)
            rays = jax.vmap(partial(pixel_ray, camera, moved))(x, y)
            batch = (
                rays,
                draw_depths(depth_key, depths, rays=config.rays, samples=config.samples),
                _unit(rgb[y, x]),
            )
            return total((), batch) / (3 * config.rays)

        def step(carry, key):
            twist, memory = carry
            with jax.numpy_dtype_promotion("standard"):  # optax needs it
                move, memory = adam.update(jax.grad(loss)(twist, key), memory)
            return (twist + move, memory), None

        twist = jnp.zeros(6, T_world_cam.dtype)
        keys = jax.random.split(key, settle_steps)
        (twist, _), _ = jax.lax.scan(step, (twist, adam.init(twist)), keys)
        return se3.compose(se3.exp(twist), T_world_cam)

    return Viewer(jax.jit(image), jax.jit(settle))


def ray_colour(
    scene: SceneField,
    scene_params: Params,
    ray: Ray,
    depth: Float[Array, " s"],
    background: float | None = None,
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Colour and expected depth along one ray whose direction has length 1 along the optical axis.

    Without a `background` the last sample closes the ray, as in BARF; with one, what passes the last sample
    but one shows it, and the depth is that of the rest.
    """

    def weights(density, depth):
        length = jnp.linalg.norm(ray.direction)
        ends = render.density_weights(density, depth, length=length)
        return ends if background is None else ends.at[-1].set(0)

    rendered = render.render_ray(partial(scene.query, scene_params), ray, depth, weights=weights)
    if background is None:
        return rendered.rgb, rendered.depth
    return rendered.opacity * rendered.rgb + (1 - rendered.opacity) * background, rendered.depth


def pixel_ray(camera: Camera, T_world_cam: Float[Array, "4 4"], x: Int[Array, ""], y: Int[Array, ""]) -> Ray:
    """The ray through a pixel, its direction of length 1 along the optical axis."""
    pixel = jnp.stack([x, y]).astype(T_world_cam.dtype)
    direction = jnp.matmul(T_world_cam[:3, :3], unproject(camera, pixel), precision="highest")
    return Ray(T_world_cam[:3, 3], direction)


def _pixels(
    key: PRNGKeyArray, count: int, height: int, width: int
) -> tuple[Int[Array, " count"], Int[Array, " count"]]:
    """Columns and rows, any as likely as any other."""
    pixel = jax.random.randint(key, (count,), 0, height * width)
    return pixel % width, pixel // width


def draw_depths(
    key: PRNGKeyArray, depths: Depths, *, rays: int, samples: int
) -> Float[Array, "rays samples"]:
    """Increasing depths for each of so many rays, drawn as `render.sample_depths` does."""
    draw = lambda key: render.sample_depths(key, depths.near, depths.far, samples, spacing=depths.spacing)
    return jax.vmap(draw)(jax.random.split(key, rays))


def _unit(rgb: UInt8[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Colours from 0 to 1."""
    return rgb.astype(jnp.zeros(()).dtype) / 255
