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
from jaxpose.render import Ray, Samples, Spacing, pixel_ray
from jaxpose.scenes import SceneField
from jaxpose.training.shutter import Shutter, exposure_times
from jaxpose.training.steps import Trainer, joint, microbatched_sum

Params = Any

_OPAQUE, _CLEAR = 0.1, 2e-3  # weights of a part of a ray in `importance`: at most, and where nothing is


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


@runtime_checkable
class Sampler(Protocol):
    """Where a ray of a scene is looked at: drawn with a key, always the same without."""

    def __call__(self, scene_params: Params, ray: Ray, key: PRNGKeyArray | None, /) -> Samples: ...


def trainer(
    scene: SceneField,
    field: PoseField,
    camera: Camera,
    depths: Depths,
    optimizer: optax.GradientTransformation,
    config: TrainConfig = TrainConfig(),  # noqa: B008 - frozen
    shutter: Callable[[Params], Shutter] | None = None,
    sampler: Sampler | None = None,
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
        sampler: Where a ray is looked at, by what is known of the scene; None: in equal parts of `depths`.

    Returns:
        A trainer whose data are `Views`.
    """

    def error(scene_params, item):
        rays, samples, rgb, weight = item
        colour = lambda ray: ray_colour(scene, scene_params, ray, samples)[0]
        seen = colour(rays) if shutter is None else jnp.mean(jax.vmap(colour)(rays), axis=0)
        return weight * jnp.sum((seen - rgb) ** 2)

    total = microbatched_sum(error, min(config.chunk, config.rays))
    sample = sampler or stratified(depths, config.samples)

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
            draw_samples(sample, scene_params, rays, depth_key),
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
    sampler: Sampler | None = None,
    background: float | None = None,
    refine_steps: int = 100,
    refine_optimizer: optax.GradientTransformation = optax.adam(1e-3),  # noqa: B008 - functions
) -> Viewer:
    """Functions that render a trained scene, and refine the pose of an image it was not trained on.

    `image` samples the same depths of a ray at any time. `refine_pose` is BARF's test-time optimisation of
    one pose, the scene at rest, on `config.rays` random pixels a step.

    Args:
        scene: A scene whose geometry is a volume density.
        camera: Intrinsics of the images.
        depths: Where samples lie along the optical axis.
        config: How many rays and samples.
        sampler: Where a ray is looked at, by what is known of the scene; None: in equal parts of `depths`.
        background: Known colour behind the scene in [0, 1], as `ray_colour` takes it.
        refine_steps: How many steps `refine_pose` takes.
        refine_optimizer: Any optax transformation of a twist (6,).

    Returns:
        The two functions.
    """
    colour = lambda params, ray, samples: ray_colour(scene, params, ray, samples, background)
    sample = sampler or stratified(depths, config.samples)

    def image(scene_params, T_world_cam):
        pixels = jnp.asarray(pixel_grid(camera), T_world_cam.dtype)

        def one(pixel):
            ray = pixel_ray(camera, T_world_cam, pixel)
            return colour(scene_params, ray, sample(scene_params, ray, None))

        rgb, found = jax.lax.map(one, pixels.reshape(-1, 2), batch_size=config.chunk)
        return rgb.reshape(pixels.shape[0], -1, 3), found.reshape(pixels.shape[:2])

    refine_pose = _refiner(colour, sample, camera, config, refine_steps, refine_optimizer)
    return Viewer(jax.jit(image), jax.jit(refine_pose))


def _refiner(
    colour: Callable[..., Any],
    sample: Sampler,
    camera: Camera,
    config: TrainConfig,
    steps: int,
    optimizer: optax.GradientTransformation,
) -> RefinePose:
    """The function that refines a pose, for a `viewer`."""

    def refine_pose(scene_params, T_world_cam, rgb, key, mask=None):
        def error(_, item):
            ray, samples, seen, weight = item
            return weight * jnp.sum((colour(scene_params, ray, samples)[0] - seen) ** 2)

        total = microbatched_sum(error, min(config.chunk, config.rays))

        def loss(twist, step):
            pixel_key, depth_key = jax.random.split(jax.random.fold_in(key, step))
            pixel = _pixels(pixel_key, config.rays, *rgb.shape[:2])
            moved = se3.compose(se3.exp(twist), T_world_cam)
            rays = jax.vmap(partial(pixel_ray, camera, moved))(pixel.astype(moved.dtype))
            batch = (
                rays,
                draw_samples(sample, scene_params, rays, depth_key),
                _unit(rgb[pixel[:, 1], pixel[:, 0]]),
                _weights(mask, (pixel[:, 1], pixel[:, 0]), moved.dtype),
            )
            return _mean(total((), batch), batch[-1])

        twist = optim.minimize(loss, jnp.zeros(6, T_world_cam.dtype), optimizer, steps).params
        return se3.compose(se3.exp(twist), T_world_cam)

    return refine_pose


def ray_colour(
    scene: SceneField,
    scene_params: Params,
    ray: Ray,
    samples: Samples,
    background: float | None = None,
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Colour and expected depth along one ray through a scene with a volume density.

    Without a `background` the last sample closes the ray, as in BARF; with one, what passes the last sample
    but one shows it, and the depth is that of the rest.

    Args:
        scene: The scene, and
        scene_params: its parameters.
        ray: A ray whose direction has length 1 along the optical axis, as `pixel_ray` gives it.
        samples: Where it is looked at, along the optical axis [scene units].
        background: Colour behind the scene in [0, 1]; None: there is none.

    Returns:
        Colour in [0, 1] and expected z-depth [scene units].
    """

    def weights(density, depth):
        length = jnp.linalg.norm(ray.direction)
        ends = render.density_weights(density, depth, length=length, interval=samples.interval)
        return ends if background is None else ends.at[-1].set(0)

    rendered = render.render_ray(partial(scene.query, scene_params), ray, samples.depth, weights=weights)
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


def stratified(depths: Depths, samples: int) -> Sampler:
    """One sample in each of equal parts of every ray, drawn with a key, as `render.sample_depths` does.

    Args:
        depths: The range [scene units], and what is equally spaced in it.
        samples: How many.

    Returns:
        The sampler; it looks at neither scene nor ray.
    """

    def sample(scene_params: Params, ray: Ray, key: PRNGKeyArray | None) -> Samples:
        del scene_params, ray
        found = render.sample_depths(key, depths.near, depths.far, samples, spacing=depths.spacing)
        return render.to_next(found)

    return sample


def importance(
    depths: Depths,
    density: Callable[[Params, Float[Array, "3"]], Float[Array, ""]],
    samples: int,
    *,
    coarse: int = 64,
) -> Sampler:
    """Samples where a ray may meet something, and one at its end, which closes it.

    Equal parts of the ray share the samples by their opacity, up to a limit (after the fine samples of
    Mildenhall et al. 2020, whose first pass is here a look at what is known of the scene).

    Args:
        depths: The range [scene units], and what is equally spaced in it.
        density: `density(scene_params, point)`, the density that the scene may have at a point.
        samples: How many, the last one apart.
        coarse: How many parts.

    Returns:
        The sampler, of `samples` + 1 depths.
    """
    edges = render.depth_at(jnp.linspace(0.0, 1.0, coarse + 1), *depths)
    middle, width = (edges[1:] + edges[:-1]) / 2, jnp.diff(edges)

    def sample(scene_params: Params, ray: Ray, key: PRNGKeyArray | None) -> Samples:
        points = ray.origin[None] + middle[:, None] * ray.direction[None]
        found = jax.vmap(density, (None, 0))(scene_params, points)
        weight = jnp.minimum(found * width * jnp.linalg.norm(ray.direction), _OPAQUE) + _CLEAR
        total = jnp.concatenate([jnp.zeros(1), jnp.cumsum(weight)])
        shift = 0.5 if key is None else jax.random.uniform(key, ())
        wanted = (jnp.arange(samples + 1, dtype=total.dtype) + shift) / (samples + 1) * total[-1]
        part = jnp.clip(jnp.searchsorted(total, wanted, side="right") - 1, 0, coarse - 1)
        # Rounding must not leave the part: the last one may be endless, and a sample before it would be
        # behind the camera.
        share = jnp.clip((wanted - total[part]) / weight[part], 0, 1)
        cut = edges[part] + share * width[part]
        depth = jnp.append((cut[1:] + cut[:-1]) / 2, edges[-1])
        return jax.lax.stop_gradient(Samples(depth, jnp.append(jnp.diff(cut), render.ENDLESS)))

    return sample


def draw_samples(sampler: Sampler, scene_params: Params, rays: Ray, key: PRNGKeyArray) -> Samples:
    """Samples of many rays, drawn anew for each.

    Args:
        sampler: Where a ray is looked at.
        scene_params: Parameters of the scene.
        rays: (n, 3), or (n, k, 3) of k instants of an exposure, which share the samples of the middle one.
        key: A random key.

    Returns:
        (n, s).
    """
    if rays.origin.ndim == 3:
        rays = jax.tree.map(lambda x: x[:, x.shape[1] // 2], rays)
    keys = jax.random.split(key, len(rays.origin))
    return jax.vmap(sampler, (None, 0, 0))(scene_params, rays, keys)


def _unit(rgb: UInt8[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Colours from 0 to 1."""
    return rgb.astype(jnp.zeros(()).dtype) / 255
