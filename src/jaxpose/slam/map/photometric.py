"""Mapping as in the paper: the scene is optimised on rays of the current frame and of keyframes beside it.

`integrate.py` is the other way, and the default.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxpose.geometry.camera import Camera
from jaxpose.losses import weighted_mean
from jaxpose.optim import minimize
from jaxpose.render import Ray, composite, sdf_weights
from jaxpose.scenes import SceneField
from jaxpose.scenes.types import Params
from jaxpose.slam.config import MapConfig
from jaxpose.slam.observation import Image, depth_sigma, sample_depths, sample_pixels


class MapState(NamedTuple):
    """The scene, and what else its method remembers: Adam's moments; nothing beside blocks, which hold it."""

    params: Params
    fusion_state: Any


def make_descend(scene: SceneField, camera: Camera, config: MapConfig):
    """`init(params)` and the compiled step `update(state, images, T_world_cam, far, rate, iterations, key)`.

    `images` and `T_world_cam` are stacked over the window. The number of iterations is traced.
    """
    adam = lambda rate: optax.chain(optax.scale_by_adam(b2=0.99), optax.scale(-rate))
    share = config.pixels // config.window

    def loss_fn(params, images, T_world_cam, far, key):
        def of_frame(key, image, pose):
            pixels = sample_pixels(key, image, camera, share, edge=config.edge)
            direction = jnp.einsum("ij,nj->ni", pose[:3, :3], pixels.direction_cam, precision="highest")
            ray = Ray(jnp.broadcast_to(pose[:3, 3], direction.shape), direction)
            losses, has_depth = jax.vmap(of_ray, in_axes=(0, 0, 0, None, None))(
                ray, pixels.depth, pixels.rgb, far, params
            )
            return losses, has_depth

        losses, has_depth = jax.vmap(of_frame)(jax.random.split(key, config.window), images, T_world_cam)
        return weighted_mean(losses, has_depth)

    def of_ray(ray, depth, rgb, far, params):
        depths = sample_depths(depth, far, config.sample)
        points = ray.origin[None] + depths[:, None] * ray.direction[None]
        distance, colours = jax.vmap(partial(scene.query, params), in_axes=(0, None))(points, ray.direction)
        weights = jax.lax.stop_gradient(sdf_weights(distance, depths, width=config.sample.width))
        seen = composite(weights, depths, colours)
        band = config.sample.band
        target = jnp.clip(depth - depths, -band, band)
        supervised = (depths <= depth + band).astype(distance.dtype)
        # Near depth is worth more than far depth.
        weight = (depth_sigma(jnp.ones(())) / depth_sigma(depth)) ** 2
        loss = weight * jnp.sum(supervised * (distance - target) ** 2) + jnp.sum((seen.rgb - rgb) ** 2)
        return loss, (depth > 0).astype(loss.dtype)

    @partial(jax.jit, donate_argnums=0)
    def update(
        state: MapState,
        images: Image,
        T_world_cam: Float[Array, "k 4 4"],
        far: Float[Array, ""],
        rate: Float[Array, ""],
        iterations: Int[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[MapState, Float[Array, ""]]:
        loss = lambda params, i: loss_fn(params, images, T_world_cam, far, jax.random.fold_in(key, i))
        found = minimize(loss, state.params, adam(rate), iterations, state=state.fusion_state)
        return MapState(found.params, found.state), found.loss

    def init(params: Params) -> MapState:
        return MapState(params, adam(0.0).init(params))

    return init, update
