"""A radiance field and camera poses optimised together from photographs (the paper's section 4.1, eq. 3)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from jaxpose import render, se3
from jaxpose.camera import Camera, pixel_direction
from jaxpose.fields import PoseField, set_progress
from jaxpose.render import Ray, Spacing
from jaxpose.scenes import SceneField
from jaxpose.train import sum_by_chunks

Params = Any


class Rate(NamedTuple):
    """Adam's learning rate over the training: exponential from `first` to `last`, zero before `start`.

    `start` is a share of the training. All three may be arrays that broadcast against the parameters.
    """

    first: Any
    last: Any
    start: Any = 0.0


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


class State(NamedTuple):
    """All that a training goes on from."""

    scene: Params
    pose: Params
    adam: Any
    key: PRNGKeyArray
    step: Int[Array, ""]


class Trainer(NamedTuple):
    """Compiled functions for one scene, pose field, camera and number of images."""

    start: Callable[[PRNGKeyArray], State]
    # Some steps (static), and the loss of each: the mean squared colour error.
    advance: Callable[[State, Views, int], tuple[State, Float[Array, " k"]]]


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

    `field.pose` is camera-to-world; `scene` has a volume density. The rates are trees of `Rate`, each a
    prefix of its parameters. Coarse-to-fine windows of scene and field follow the steps. Samples are drawn
    anew for every ray. Rays that end nowhere are as in BARF: the last sample closes them.
    """
    adam = optax.scale_by_adam()

    def start(key):
        scene_key, pose_key, key = jax.random.split(key, 3)
        first = scene.init(scene_key), field.init(pose_key)
        return State(*first, adam.init(first), key, jnp.zeros((), jnp.int32))

    def error(scene_params, item):
        ray, depth, rgb = item
        return jnp.sum((_colour(scene, scene_params, ray, depth)[0] - rgb) ** 2)

    total = sum_by_chunks(error, min(config.chunk, config.rays))

    def loss(params, views, key):
        view_key, pixel_key, depth_key = jax.random.split(key, 3)
        count, height, width, _ = views.rgb.shape
        view = jax.random.randint(view_key, (config.rays,), 0, count)
        x, y = _pixels(pixel_key, config.rays, height, width)
        scene_params, pose_params = params
        # Once for every image, not for every ray.
        T_world_cam = jax.vmap(field.pose, (None, 0))(pose_params, views.t)[view]
        rays = jax.vmap(partial(_ray, camera))(T_world_cam, x, y)
        batch = rays, _depths(depth_key, depths, config), _unit(views.rgb[view, y, x])
        return total(scene_params, batch) / (3 * config.rays)

    def step(state, _, views):
        key, loss_key = jax.random.split(state.key)
        progress = state.step.astype(jnp.zeros(()).dtype) / config.steps
        params = _at(state.scene, progress), _at(state.pose, progress)
        value, gradient = jax.value_and_grad(loss)(params, views, loss_key)
        with jax.numpy_dtype_promotion("standard"):  # optax needs it
            direction, memory = adam.update(gradient, state.adam)
        rates = scene_rates, pose_rates
        moves = jax.tree.map(lambda rate: _rate(rate, progress), rates, is_leaf=_is_rate)
        moves = jax.tree.broadcast(moves, params)
        scene_params, pose_params = jax.tree.map(lambda p, rate, d: p - rate * d, params, moves, direction)
        return State(scene_params, pose_params, memory, key, state.step + 1), value

    def advance(state, views, count):
        return jax.lax.scan(partial(step, views=views), state, length=count)

    return Trainer(jax.jit(start), jax.jit(advance, static_argnums=2))


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
        one = lambda xy: _colour(scene, scene_params, _ray(camera, T_world_cam, *xy), depth)
        rgb, found = jax.lax.map(one, (x.ravel(), y.ravel()), batch_size=config.chunk)
        return rgb.reshape(*x.shape, 3), found.reshape(x.shape)

    def settle(scene_params, T_world_cam, rgb, key):
        def error(_, item):
            ray, depth, seen = item
            return jnp.sum((_colour(scene, scene_params, ray, depth)[0] - seen) ** 2)

        total = sum_by_chunks(error, min(config.chunk, config.rays))

        def loss(twist, key):
            pixel_key, depth_key = jax.random.split(key)
            x, y = _pixels(pixel_key, config.rays, *rgb.shape[:2])
            moved = se3.compose(se3.exp(twist), T_world_cam)
            rays = jax.vmap(partial(_ray, camera, moved))(x, y)
            batch = rays, _depths(depth_key, depths, config), _unit(rgb[y, x])
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


def _colour(
    scene: SceneField, scene_params: Params, ray: Ray, depth: Float[Array, " s"]
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Colour and expected depth along one ray whose direction has length 1 along the optical axis."""
    weights = partial(render.density_weights, length=jnp.linalg.norm(ray.direction))
    rendered = render.render_ray(partial(scene.query, scene_params), ray, depth, weights=weights)
    return rendered.rgb, rendered.depth


def _ray(camera: Camera, T_world_cam: Float[Array, "4 4"], x: Int[Array, ""], y: Int[Array, ""]) -> Ray:
    pixel = jnp.stack([x, y]).astype(T_world_cam.dtype)
    direction = jnp.matmul(T_world_cam[:3, :3], pixel_direction(camera, pixel), precision="highest")
    return Ray(T_world_cam[:3, 3], direction)


def _pixels(
    key: PRNGKeyArray, count: int, height: int, width: int
) -> tuple[Int[Array, " count"], Int[Array, " count"]]:
    """Columns and rows, any as likely as any other."""
    pixel = jax.random.randint(key, (count,), 0, height * width)
    return pixel % width, pixel // width


def _depths(key: PRNGKeyArray, depths: Depths, config: TrainConfig) -> Float[Array, "r s"]:
    draw = lambda key: render.sample_depths(
        key, depths.near, depths.far, config.samples, spacing=depths.spacing
    )
    return jax.vmap(draw)(jax.random.split(key, config.rays))


def _unit(rgb: UInt8[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Colours from 0 to 1."""
    return rgb.astype(jnp.zeros(()).dtype) / 255


def _at(params: Params, progress: Float[Array, ""]) -> Params:
    """Parameters whose coarse-to-fine window, if they have one, is where the training is."""
    has_window = isinstance(params, dict) and "progress" in params
    return set_progress(params, progress) if has_window else params


def _is_rate(x: Any) -> bool:
    return isinstance(x, Rate)


def _rate(rate: Rate, progress: Float[Array, ""]) -> Float[Array, "*n"]:
    first, last, start = (jnp.asarray(x, progress.dtype) for x in rate)
    # Not first (last / first)^progress: a rate of zero keeps its parameters at rest.
    return jnp.where(progress >= start, first ** (1 - progress) * last**progress, 0)
