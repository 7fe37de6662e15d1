"""The map of a run: the steps compiled for its size, room for what a frame sees, and mapping it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose.datasets.types import Frame, Recording
from jaxpose.geometry.camera import pixel_grid, unproject_numpy
from jaxpose.scenes import GridConfig, SceneField, bounding_grid, grid, grow, merge
from jaxpose.scenes.types import Params
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.keyframes import choose, overlap, read_keyframes
from jaxpose.slam.map.integrate import make_integrate, sample_map
from jaxpose.slam.map.photometric import MapState, make_descend
from jaxpose.slam.observation import Image, sample_pixels
from jaxpose.slam.tracking.relocalise import relocalise as find
from jaxpose.slam.tracking.steps import FieldUpdate, Tracked, make_track
from jaxpose.slam.types import SlamState

_LOOKED_AT = 400  # pixels of a search


class World(NamedTuple):
    """A scene, and the steps compiled for the size of its grid."""

    scene: SceneField
    start: Callable[[], MapState]
    relocalise: Callable[..., Float[Array, "4 4"]]
    track: Callable[..., Tracked]
    update: Callable[..., MapState]


def make_world(
    recording: Recording, config: SlamConfig, field_update: FieldUpdate, size: GridConfig
) -> World:
    """The map's compiled steps for a grid."""
    scene = grid(size)
    scale = {"band": size.truncation, "width": size.truncation / 8}
    if config.map.method == "fused":
        init_map, update = make_integrate(size, recording.camera, size.truncation)
    else:
        map_config = replace(config.map, sample=replace(config.map.sample, **scale))
        init_map, update = make_descend(scene, recording.camera, map_config)
    track_config = replace(config.track, sample=replace(config.track.sample, **scale))
    T_body_cam = jnp.asarray(recording.T_body_cam, jnp.float32)
    look = partial(sample_map, scene, size, config.map.method == "fused")
    track = make_track(scene, look, recording.camera, T_body_cam, track_config, field_update)

    @jax.jit
    def relocalise(scene_params, fusion_state, T_world_cam, sigma, image, key):
        pixel_key, key = jax.random.split(key)
        pixels = sample_pixels(pixel_key, image, recording.camera, _LOOKED_AT, edge=config.track.edge)
        return find(partial(look, scene_params, fusion_state), T_world_cam, sigma, pixels, key)

    return World(scene, lambda: init_map(scene.init(jax.random.key(0))), relocalise, track, update)


def scene_params(state: MapState) -> Params:
    """The map as it is queried: one level."""
    return state.params if len(state.params) == 1 else _merge(state.params)


_merge = jax.jit(merge)


def seen_points(
    frame: Frame, recording: Recording, T_world_cam: Float[np.ndarray, "4 4"], *, step: int = 16
) -> Float[np.ndarray, "n 3"]:
    """World points of every `step`-th pixel in both directions that has depth, float64."""
    pixel = pixel_grid(recording.camera, step)
    depth = frame.depth[step // 2 :: step, step // 2 :: step]
    seen = depth > 0
    points = unproject_numpy(recording.camera, pixel[seen]) * depth[seen][:, None]
    return points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]


def initial_grid(points: Float[np.ndarray, "n 3"], config: SlamConfig) -> GridConfig:
    """A grid for what the first frame sees."""
    levels = 1 if config.map.method == "fused" else 2
    return bounding_grid(_bounds(points), voxel=config.voxel, levels=levels)


def grow_to_fit(points: Float[np.ndarray, "n 3"], state: SlamState) -> SlamState:
    """The state with a grid that holds the points; a few stray ones do not make it grow."""
    lower, upper = corners = _bounds(points)
    if (lower >= state.grid.lower).all() and (upper <= state.grid.upper).all():
        return state
    larger, grown = grow(state.grid, state.map, corners)
    return state._replace(grid=larger, map=grown)


def map_frame(
    world: World,
    recording: Recording,
    config: SlamConfig,
    state: SlamState,
    image: Image,
    points: Float[np.ndarray, "n 3"],
    generator: np.random.Generator,
    key: PRNGKeyArray,
) -> SlamState:
    """The state after mapping the last frame, which sees `points`, and keyframes that overlap it."""
    i, frames = state.done - 1, state.frames
    T_world_cam = frames.T_world_body[: i + 1] @ recording.T_body_cam
    kept = np.flatnonzero(frames.keyframe)
    shares = overlap(points, T_world_cam[kept], recording.camera) if len(kept) else np.zeros(0)
    if config.map.method == "fused":
        updated = world.update(state.map, image, jnp.asarray(T_world_cam[i], jnp.float32))
    else:
        image = image._replace(exposure=np.ones(3, np.float32))  # as that of keyframes
        images, poses = [image] * config.map.window, [T_world_cam[i]] * config.map.window
        if len(kept):
            others = kept[choose(shares, config.map.window - 1, generator)]
            others = list(read_keyframes(recording, others, T_world_cam))
            images = [image, *(k.image for k in others)]
            poses = [T_world_cam[i], *(k.T_world_cam for k in others)]
        first = not len(kept)
        updated, _ = world.update(
            state.map,
            jax.tree.map(lambda *x: jnp.stack(x), *images),
            jnp.asarray(np.stack(poses), jnp.float32),
            jnp.float32(state.far),
            jnp.float32(config.map.first_rate if first else config.map.learning_rate),
            jnp.int32(config.map.first_iterations if first else config.map.iterations),
            key,
        )
    is_new = not len(kept) or shares.max() < config.keyframe_overlap
    return state._replace(map=updated, frames=frames.put(i, mapped=True, keyframe=is_new))


def _bounds(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 3"]:
    return np.percentile(points, [1, 99], axis=0)
