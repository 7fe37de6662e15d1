"""A radiance field and camera poses optimised together from photographs (Ma et al. 2024, section 4.1)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from jaxpose import optim, render
from jaxpose.fields import PoseField
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, pixel_grid
from jaxpose.render import Ray, Spacing, pixel_ray
from jaxpose.scenes import SceneField
from jaxpose.training.shutter import Shutter, exposure_times
from jaxpose.training.steps import Trainer, joint, microbatched_sum

Params = Any


@dataclass(frozen=True)
class TrainConfig:
    """How long and on what; the defaults are BARF's on Blender (Lin et al. 2021)."""

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
    """Training images, times [s] at which their poses are asked for, and pixels that count (None: all)."""

    t: Float[Array, " n"]
    rgb: UInt8[Array, "n h w 3"]
    mask: Bool[Array, "n h w"] | None = None


def trainer(
    scene: SceneField,
    field: PoseField,
    camera: Camera,
    depths: Depths,
    optimizer: optax.GradientTransformation,
    config: TrainConfig = TrainConfig(),  # noqa: B008 - frozen
    shutter: Callable[[Params], Shutter] | None = None,
) -> Trainer:
    """Minimise the mean squared colour error of random rays, jointly over scene and poses (BARF).

    Samples are drawn anew for every ray. A ray that ends nowhere is closed by its last sample, as in BARF.

    Args:
        scene: A scene whose geometry is a volume density.
        field: Camera-to-world poses, asked at the times of the views.
        camera: Intrinsics of all views.
        depths: Where samples lie along the optical axis.
        optimizer: As `joint` takes it.
        config: How many steps, rays and samples.
        shutter: Of the camera, from the pose field's parameters: a pixel's colour is then the mean of rays
            from the poses at the instants of its row's exposure. None: all of a photograph is seen at once.

    Returns:
        A trainer whose data are `Views`.
    """

    def error(scene_params, item):
        rays, depth, rgb, weight = item
        colour = lambda ray: ray_colour(scene, scene_params, ray, depth)[0]
        seen = colour(rays) if shutter is None else jnp.mean(jax.vmap(colour)(rays), axis=0)
        return weight * jnp.sum((seen - rgb) ** 2)

    total = microbatched_sum(error, min(config.chunk, config.rays))

    def loss(scene_params, pose_params, views, key):
        view_key, pixel_key, depth_key = jax.random.split(key, 3)
        count, height, width, _ = views.rgb.shape
        view = jax.random.randint(view_key, (config.rays,), 0, count)
        pixel = _pixels(pixel_key, config.rays, height, width)
        at = pixel.astype(views.t.dtype)
        if shutter is None:  # once for every image, not for every ray
            T_world_cam = jax.vmap(field.pose, (None, 0))(pose_params, views.t)[view]
            rays = jax.vmap(partial(pixel_ray, camera))(T_world_cam, at)
        else:
            times = jax.vmap(partial(exposure_times, shutter(pose_params), height=height))
            from_pixel = lambda t, at: pixel_ray(camera, field.pose(pose_params, t), at)
            rays = jax.vmap(jax.vmap(from_pixel, (0, None)))(times(views.t[view], at[:, 1]), at)
        batch = (
            rays,
            draw_depths(depth_key, depths, rays=config.rays, samples=config.samples),
            _unit(views.rgb[view, pixel[:, 1], pixel[:, 0]]),
            _weights(views.mask, (view, pixel[:, 1], pixel[:, 0]), at.dtype),
        )
        return _mean(total(scene_params, batch), batch[-1])

    return joint(loss, scene.init, field.init, optimizer, config.steps)


@runtime_checkable
class RenderImage(Protocol):
    """Colour in [0, 1] and z-depth [scene units] of all pixels of one camera, from a camera-to-world pose."""

    def __call__(
        self, scene_params: Params, T_world_cam: Float[Array, "4 4"], /
    ) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]: ...


@runtime_checkable
class RefinePose(Protocol):
    """A camera-to-world pose moved, by a twist of the world, to where the scene explains an image.

    Pixels without mask (None: none) do not count.
    """

    def __call__(
        self,
        scene_params: Params,
        T_world_cam: Float[Array, "4 4"],
        rgb: UInt8[Array, "h w 3"],
        key: PRNGKeyArray,
        mask: Bool[Array, "h w"] | None = None,
        /,
    ) -> Float[Array, "4 4"]: ...


class Viewer(NamedTuple):
    """Compiled functions that look at a trained scene from any pose of one camera."""

    image: RenderImage
    refine_pose: RefinePose


def viewer(
    scene: SceneField,
    camera: Camera,
    depths: Depths,
    config: TrainConfig = TrainConfig(),  # noqa: B008 - frozen
    *,
    background: float | None = None,
    refine_steps: int = 100,
    refine_optimizer: optax.GradientTransformation = optax.adam(1e-3),  # noqa: B008 - functions
) -> Viewer:
    """Functions that render a trained scene, and refine the pose of an image it was not trained on.

    `image` samples the middles of equal parts of each ray. `refine_pose` is BARF's test-time optimisation of
    one pose, the scene at rest, on `config.rays` random pixels a step.

    Args:
        scene: A scene whose geometry is a volume density.
        camera: Intrinsics of the images.
        depths: Where samples lie along the optical axis.
        config: How many rays and samples.
        background: Known colour behind the scene in [0, 1], as `ray_colour` takes it.
        refine_steps: How many steps `refine_pose` takes.
        refine_optimizer: Any optax transformation of a twist (6,).

    Returns:
        The two functions.
    """
    colour = lambda params, ray, depth: ray_colour(scene, params, ray, depth, background)

    def image(scene_params, T_world_cam):
        pixels = jnp.asarray(pixel_grid(camera), T_world_cam.dtype)
        depth = render.sample_depths(None, depths.near, depths.far, config.samples, spacing=depths.spacing)
        one = lambda pixel: colour(scene_params, pixel_ray(camera, T_world_cam, pixel), depth)
        rgb, found = jax.lax.map(one, pixels.reshape(-1, 2), batch_size=config.chunk)
        return rgb.reshape(pixels.shape[0], -1, 3), found.reshape(pixels.shape[:2])

    def refine_pose(scene_params, T_world_cam, rgb, key, mask=None):
        def error(_, item):
            ray, depth, seen, weight = item
            return weight * jnp.sum((colour(scene_params, ray, depth)[0] - seen) ** 2)

        total = microbatched_sum(error, min(config.chunk, config.rays))

        def loss(twist, step):
            pixel_key, depth_key = jax.random.split(jax.random.fold_in(key, step))
            pixel = _pixels(pixel_key, config.rays, *rgb.shape[:2])
            moved = se3.compose(se3.exp(twist), T_world_cam)
            batch = (
                jax.vmap(partial(pixel_ray, camera, moved))(pixel.astype(moved.dtype)),
                draw_depths(depth_key, depths, rays=config.rays, samples=config.samples),
                _unit(rgb[pixel[:, 1], pixel[:, 0]]),
                _weights(mask, (pixel[:, 1], pixel[:, 0]), moved.dtype),
            )
            return _mean(total((), batch), batch[-1])

        twist = optim.minimize(loss, jnp.zeros(6, T_world_cam.dtype), refine_optimizer, refine_steps).params
        return se3.compose(se3.exp(twist), T_world_cam)

    return Viewer(jax.jit(image), jax.jit(refine_pose))


def ray_colour(
    scene: SceneField,
    scene_params: Params,
    ray: Ray,
    depth: Float[Array, " s"],
    background: float | None = None,
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Colour and expected depth along one ray through a scene with a volume density.

    Without a `background` the last sample closes the ray, as in BARF; with one, what passes the last sample
    but one shows it, and the depth is that of the rest.

    Args:
        scene: The scene, and
        scene_params: its parameters.
        ray: A ray whose direction has length 1 along the optical axis, as `pixel_ray` gives it.
        depth: Increasing depths of the samples along the optical axis [scene units].
        background: Colour behind the scene in [0, 1]; None: there is none.

    Returns:
        Colour in [0, 1] and expected z-depth [scene units].
    """

    def weights(density, depth):
        length = jnp.linalg.norm(ray.direction)
        ends = render.density_weights(density, depth, length=length)
        return ends if background is None else ends.at[-1].set(0)

    rendered = render.render_ray(partial(scene.query, scene_params), ray, depth, weights=weights)
    if background is None:
        return rendered.rgb, rendered.depth
    return rendered.opacity * rendered.rgb + (1 - rendered.opacity) * background, rendered.depth


def _pixels(key: PRNGKeyArray, count: int, height: int, width: int) -> Int[Array, "{count} 2"]:
    """Columns and rows, any as likely as any other."""
    pixel = jax.random.randint(key, (count,), 0, height * width)
    return jnp.stack([pixel % width, pixel // width], axis=-1)


def _weights(mask: Any, at: tuple[Any, ...], dtype: Any) -> Float[Array, " rays"]:
    """1 for pixels that count, 0 for others."""
    return jnp.ones(at[0].shape, dtype) if mask is None else mask[at].astype(dtype)


def _mean(total: Float[Array, ""], weights: Float[Array, " rays"]) -> Float[Array, ""]:
    """The error of a colour channel of the pixels that count, from its sum over all."""
    return total / (3 * jnp.maximum(jnp.sum(weights), 1))


def draw_depths(
    key: PRNGKeyArray, depths: Depths, *, rays: int, samples: int
) -> Float[Array, "rays samples"]:
    """Increasing depths for each of many rays, drawn as `render.sample_depths` does.

    Args:
        key: A random key.
        depths: The range [scene units], and what is equally spaced in it.
        rays: How many rays.
        samples: How many depths of each.

    Returns:
        Depths along the optical axis [scene units].
    """
    draw = lambda key: render.sample_depths(key, depths.near, depths.far, samples, spacing=depths.spacing)
    return jax.vmap(draw)(jax.random.split(key, rays))


def _unit(rgb: UInt8[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Colours from 0 to 1."""
    return rgb.astype(jnp.zeros(()).dtype) / 255
