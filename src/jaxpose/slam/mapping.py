"""Mapping: what a frame with a known pose adds to the scene.

Two ways. `gradient` is the paper's: the scene is optimised on rays of the current frame and of keyframes that
see the same place. `fused` solves for the signed distance in closed form: at every node of the grid the
weighted mean of all distances measured along the optical axis, which is what the gradient's L2 loss tends to
when every frame is seen equally often (Curless and Levoy 1996). It has no step size, forgets nothing and
costs one pass over the grid; the figures of both are in experiments/.

The scene's distance is cut off close behind surfaces, as thin things have two sides. Beside it the fused map
has a second one that reaches farther to both sides, and keeps where anything was measured: a camera is
aligned to that one (`look_up`), from farther off.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxpose.camera import Camera
from jaxpose.losses import weighted_mean
from jaxpose.render import Ray, composite, sdf_weights
from jaxpose.scenes import GridConfig, SceneField, node_axes
from jaxpose.scenes.base import Params
from jaxpose.scenes.grid import trilinear
from jaxpose.slam.observe import (
    Image,
    SampleConfig,
    depth_sigma,
    locate,
    sample_depths,
    sample_pixels,
)

_MEMORY = 100.0  # frames, at a depth of one metre: older ones are slowly forgotten
_REACH = 8  # voxels to either side of a surface of which the wide distance knows


@dataclass(frozen=True)
class MapConfig:
    """How the scene is mapped; all but the first is of the method `gradient`."""

    method: Literal["fused", "gradient"] = "fused"
    pixels: int = 1000  # per iteration, shared by the frames of the window
    edge: int = 4
    window: int = 5  # frames: the current one, the last keyframe, and keyframes that overlap
    iterations: int = 20
    first_iterations: int = 200
    learning_rate: float = 2e-3  # of Adam
    first_rate: float = 5e-3
    sample: SampleConfig = SampleConfig(front=8, surface=14, behind=0)


class MapState(NamedTuple):
    """The scene, and what the method remembers: Adam's moments, or the weight of each node."""

    params: Params
    memory: Any


class Nearby(NamedTuple):
    """What a map says about a point: signed distance [m] to the surface, colour there, 1 where it knows."""

    distance: Float[Array, ""]
    rgb: Float[Array, "3"]
    known: Float[Array, ""]


Lookup = Callable[[Float[Array, "3"]], Nearby]


def make_fuse(config: GridConfig, camera: Camera, band: float):
    """`init(params)` and the compiled step `update(state, image, T_world_cam)` of closed-form mapping.

    `band` [m] is how far behind a surface a distance of the scene still counts as measured. The memory
    (x, y, z, 5) holds the weights of distance, colour and wide distance, then the wide distance [m] and 1
    where it is known.
    """
    x, y, z = (jnp.asarray(axis) for axis in node_axes(config))
    reach = _REACH * config.voxel

    @partial(jax.jit, donate_argnums=0)
    def update(state: MapState, image: Image, T_world_cam: Float[Array, "4 4"]) -> MapState:
        def slice_at(item):
            values, memory, x = item
            weight, wide, known = memory[..., :3], memory[..., 3], memory[..., 4]
            nodes = jnp.stack(jnp.broadcast_arrays(x, y[:, None], z[None, :]), axis=-1)
            at = locate(camera, T_world_cam, nodes)
            depth = image.depth[at.row, at.column]
            distance = depth - at.depth
            near = (depth_sigma(jnp.ones(())) / depth_sigma(depth)) ** 2
            worth = jnp.where(at.inside & (depth > 0), near, 0)
            gain = jnp.stack([
                jnp.where(distance > -band, worth, 0),
                jnp.where(jnp.abs(distance) < band, worth, 0),
                jnp.where(distance > -reach, worth, 0),
            ], axis=-1)  # fmt: skip
            total = weight + gain
            share = gain / jnp.where(total > 0, total, 1)
            rgb = image.rgb[at.row, at.column].astype(values.dtype) / 255
            measured = jnp.concatenate([jnp.minimum(distance, band)[..., None], rgb], axis=-1)
            values = values + share[..., jnp.array([0, 1, 1, 1])] * (measured - values)
            wide = wide + share[..., 2] * (jnp.minimum(distance, reach) - wide)
            known = jnp.where(gain[..., 2] > 0, 1, known)
            memory = [jnp.minimum(total, _MEMORY), wide[..., None], known[..., None]]
            return values, jnp.concatenate(memory, axis=-1)

        # One slice of the grid after the other: what is in between stays small, whatever the map's size.
        values, memory = jax.lax.map(slice_at, (state.params[0], state.memory, x))
        return MapState((values,), memory)

    return lambda params: MapState(params, jnp.zeros((*params[0].shape[:3], 5))), update


def look_up(
    scene: SceneField, config: GridConfig, wide: bool, params: Params, memory: Any, point: Float[Array, "3"]
) -> Nearby:
    """A point in a map: by the wide distance in a fused map's memory, or by the scene's own."""
    distance, rgb = scene.query(params, point, jnp.zeros(3, point.dtype))
    reach = config.truncation
    known = jnp.ones_like(distance)
    if wide:
        position = (point - jnp.asarray(config.lower, point.dtype)) / config.voxel
        *_, distance, known = trilinear(memory, position)
        reach = _REACH * config.voxel
    measured = (known > 1 - 1e-3) & (jnp.abs(distance) < 0.98 * reach)
    return Nearby(distance, rgb, measured.astype(distance.dtype))


def make_descend(scene: SceneField, camera: Camera, config: MapConfig):
    """`init(params)` and the compiled step `update(state, images, T_world_cam, far, rate, iterations, key)`.

    `images` and `T_world_cam` are stacked over the window. The number of iterations is traced.
    """
    adam = optax.scale_by_adam(b2=0.99)
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
        worth = (depth_sigma(jnp.ones(())) / depth_sigma(depth)) ** 2
        loss = worth * jnp.sum(supervised * (distance - target) ** 2) + jnp.sum((seen.rgb - rgb) ** 2)
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
        def improve(i, carry):
            (params, opt_state), _ = carry
            loss, gradient = jax.value_and_grad(loss_fn)(
                params, images, T_world_cam, far, jax.random.fold_in(key, i)
            )
            with jax.numpy_dtype_promotion("standard"):
                direction, opt_state = adam.update(gradient, opt_state)
            params = jax.tree.map(lambda p, d: p - rate * d, params, direction)
            return MapState(params, opt_state), loss

        return jax.lax.fori_loop(0, iterations, improve, (state, jnp.zeros(())))

    def init(params: Params) -> MapState:
        return MapState(params, adam.init(params))

    return init, update
