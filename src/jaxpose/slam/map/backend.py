"""The map of a run behind one interface: compiled steps for its size, growth, and mapping a frame."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose.datasets.types import Frame
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, angle_of_view, pixel_grid, unproject_numpy
from jaxpose.scenes import GridConfig, SceneField, bounding_grid, grid, grow, merge
from jaxpose.scenes.types import Params
from jaxpose.scenes.voxel_blocks import BlockConfig, Blocks, blocks_of_grid, empty_blocks, voxel_blocks
from jaxpose.slam.config import IMU_WEIGHTS, ImuWeights, MapConfig, SlamConfig, TrackConfig
from jaxpose.slam.keyframes import FrameReader, choose, keyframe_images, overlap
from jaxpose.slam.loops.drift import drift_to_last, may_be_doubled
from jaxpose.slam.map.integrate import MapSample, grown_map, make_integrate, sample_map
from jaxpose.slam.map.photometric import MapState, make_descend
from jaxpose.slam.observation import Image, is_blank, sample_pixels
from jaxpose.slam.tracking.gradient import make_gradient
from jaxpose.slam.tracking.reference_frames import FramedField, make_field
from jaxpose.slam.tracking.register import TrackStep, make_register
from jaxpose.slam.tracking.relocalise import relocalise
from jaxpose.slam.types import SlamState

_SEARCHED_WITH = 400  # pixels
_VIEW_CHANGE = 0.1  # of the angle of view, after which a frame is mapped
_ALLOCATION_COLUMNS = 160  # of an image, by whose depth blocks are made: closer than a block is wide


@runtime_checkable
class RelocaliseStep(Protocol):
    """A compiled search from poses `T_world_cam` (k, 4, 4), `sigma` [m, rad] around each, to the best one."""

    def __call__(
        self,
        scene_params: Params,
        fusion_state: Any,
        T_world_cam: Float[Array, "k 4 4"],
        sigma: Float[Array, "2"],
        image: Image,
        key: PRNGKeyArray,
    ) -> Float[Array, "4 4"]: ...

    def lower(self, *shapes: Any) -> jax.stages.Lowered: ...


class MapBackend(NamedTuple):
    """A scene, and the steps compiled for the size of its grid."""

    scene: SceneField
    start: Callable[[], MapState]
    update: Callable[..., Any]
    track: TrackStep
    relocalise: RelocaliseStep


def map_backend(state: SlamState) -> MapBackend:
    """The steps for the state's camera, settings and grid, compiled once for all runs that share them."""
    config, size = state.config, state.grid
    assert size is not None
    framed = framed_field(config)
    weights = IMU_WEIGHTS[config.imu] if config.track.method == "gradient" else IMU_WEIGHTS["none"]
    line_delay = "line-delay" in config.estimate
    budget = config.map_budget
    return _map_backend(state.camera, config.track, config.map, framed, weights, size, line_delay, budget)


def framed_field(config: SlamConfig) -> FramedField | None:
    """The PoseNet in its frame of reference; None where nothing reads it."""
    return _framed_field(config.frame, config.field) if config.uses_field else None


_framed_field = lru_cache(maxsize=4)(make_field)


@lru_cache(maxsize=2)
def _map_backend(
    camera: Camera,
    track: TrackConfig,
    config: MapConfig,
    framed: FramedField | None,
    weights: ImuWeights,
    size: BlockConfig | GridConfig,
    line_delay: bool,
    budget: float,
) -> MapBackend:
    scale = {"band": size.truncation, "width": size.truncation / 8}
    if isinstance(size, BlockConfig):
        scene, update = voxel_blocks(size), make_integrate(size, camera)
        start, sample = (
            lambda: MapState(empty_blocks(size, budget=budget), ()),
            partial(sample_map, size),
        )
    else:
        config = replace(config, sample=replace(config.sample, **scale))
        scene = grid(size)
        init_map, update = make_descend(scene, camera, config)
        start = lambda: init_map(scene.init(jax.random.key(0)))
        sample = partial(_sample_grid, scene, size)
    track = replace(track, sample=replace(track.sample, **scale))
    if track.method == "gauss_newton":
        step = make_register(sample, camera, track, line_delay=line_delay)
    else:
        assert framed is not None
        step = make_gradient(scene, framed, camera, track, weights)

    @jax.jit
    def search(scene_params, fusion_state, T_world_cam, sigma, image, key):
        pixel_key, key = jax.random.split(key)
        pixels = sample_pixels(pixel_key, image, camera, _SEARCHED_WITH, edge=track.edge)
        return relocalise(partial(sample, scene_params, fusion_state), T_world_cam, sigma, pixels, key)

    return MapBackend(scene, start, update, step, search)


def _sample_grid(
    scene: SceneField, size: GridConfig, params: Params, fusion_state: Any, point: Float[Array, "3"]
) -> MapSample:
    """A point in a map of the method `gradient`, which knows the distance in a narrow band only."""
    del fusion_state
    distance, rgb = scene.query(params, point, jnp.zeros(3, point.dtype))
    return MapSample(distance, rgb, (jnp.abs(distance) < 0.98 * size.truncation).astype(distance.dtype))


def scene_params(state: MapState) -> Params:
    """The map as it is queried: blocks, or a grid of one level."""
    return _merge(state.params) if type(state.params) is tuple and len(state.params) > 1 else state.params


_merge = jax.jit(merge)


def pool_size(state: SlamState) -> tuple[int, int]:
    """How many rows of the map's pool of blocks are in use, and how many there are; none of a grid."""
    if state.map is None or not isinstance(state.map.params, Blocks):
        return 0, 0
    return int(state.map.params.count), state.map.params.coords.shape[0]


def seen_points(
    frame: Frame, camera: Camera, T_world_cam: Float[np.ndarray, "4 4"], *, step: int = 16
) -> Float[np.ndarray, "n 3"]:
    """World points of every `step`-th pixel in both directions that has depth, float64."""
    pixel = pixel_grid(camera, step)
    depth = frame.depth[step // 2 :: step, step // 2 :: step]
    seen = depth > 0
    points = unproject_numpy(camera, pixel[seen]) * depth[seen][:, None]
    return rigid.apply(T_world_cam, points)


def grow_to_fit(frame: Frame, points: Float[np.ndarray, "n 3"], state: SlamState) -> SlamState:
    """The state with a map that holds what its last frame has measured; `points` are some of it.

    A grid does not grow for a few stray points. PoolFull where blocks need more than the budget.
    """
    bounds = np.percentile(points, [1, 99], axis=0)
    fused = state.config.map.method == "fused"
    if state.grid is None:
        size = bounding_grid(bounds, voxel=state.config.voxel, levels=1 if fused else 2)
        state = state._replace(grid=BlockConfig(size.voxel, size.truncation) if fused else size)
        state = state._replace(map=map_backend(state).start())
    assert state.map is not None
    if isinstance(state.grid, BlockConfig):
        T_world_cam = state.frames.T_world_body[-1] @ state.T_body_cam
        measured = allocation_points(frame, state.camera, T_world_cam)
        return state._replace(map=grown_map(state.grid, state.map, measured, state.config.map_budget))
    assert state.grid is not None
    lower, upper = bounds
    if (lower >= state.grid.lower).all() and (upper <= state.grid.upper).all():
        return state
    larger, grown = grow(state.grid, state.map, bounds)
    return state._replace(grid=larger, map=grown)


def allocation_points(
    frame: Frame, camera: Camera, T_world_cam: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "n 3"]:
    """World points of a frame, as many as it takes to touch all blocks that integrating it will change."""
    return seen_points(frame, camera, T_world_cam, step=max(camera.width // _ALLOCATION_COLUMNS, 1))


def is_mapped(state: SlamState, frame: Frame) -> bool:
    """Whether the last frame is to be mapped: not where its pose or its colour is in doubt."""
    config, frames, i = state.config, state.frames, state.frames.count - 1
    held_out = config.hold_out > 0 and i % config.hold_out == config.hold_out - 1
    mapped = np.flatnonzero(frames.mapped)
    if held_out or frames.doubted[i] or not len(mapped):
        return not held_out and not frames.doubted[i]
    unconfirmed = frames.lost[i - 1] and not config.uses_accelerometer
    last = int(mapped[-1])
    due = frames.t[i] - frames.t[last] >= config.map_every_s or _view_changed(state, frame, last)
    return bool(not unconfirmed and not is_blank(frame) and due)


def _view_changed(state: SlamState, frame: Frame, since: int) -> bool:
    """Whether the image has moved by a tenth of its view since a frame, whatever the clock says."""
    away = rigid.inverse(state.frames.T_world_body[since]) @ state.frames.T_world_body[-1]
    near = float(np.median(frame.depth[frame.depth > 0]))
    moved = np.linalg.norm(away[:3, 3]) / near + rigid.rotation_angle(np.eye(3), away[:3, :3])
    return bool(moved > _VIEW_CHANGE * angle_of_view(state.camera)[0])


def map_frame(
    state: SlamState,
    image: Image,
    points: Float[np.ndarray, "n 3"],
    read: FrameReader,
    generator: np.random.Generator,
    key: PRNGKeyArray,
) -> SlamState:
    """The state after mapping its last frame, which sees `points`, and keyframes that overlap it."""
    config, frames, i = state.config, state.frames, state.frames.count - 1
    backend, T_world_cam = map_backend(state), frames.T_world_body @ state.T_body_cam
    kept = np.flatnonzero(frames.keyframe)
    farthest = state.max_depth
    shares = overlap(points, T_world_cam[kept], state.camera, farthest) if len(kept) else np.zeros(0)
    if config.map.method == "fused":
        updated = backend.update(state.map, image, jnp.asarray(T_world_cam[i], jnp.float32))
    else:
        image = image._replace(exposure=np.ones(3, np.float32))  # as that of keyframes
        images, poses = [image] * config.map.window, [T_world_cam[i]] * config.map.window
        if len(kept):
            others = kept[choose(shares, config.map.window - 1, generator)]
            images = [image, *(k.image for k in keyframe_images(read, others, T_world_cam))]
            poses = [T_world_cam[i], *T_world_cam[others]]
        first = not len(kept)
        updated, _ = backend.update(
            state.map,
            jax.tree.map(lambda *x: jnp.stack(x), *images),
            jnp.asarray(np.stack(poses), jnp.float32),
            jnp.float32(state.max_depth),
            jnp.float32(config.map.first_rate if first else config.map.learning_rate),
            jnp.int32(config.map.first_iterations if first else config.map.iterations),
            key,
        )
    is_new = not len(kept) or shares.max() < config.keyframe_overlap
    if config.uses_loops and not is_new:  # keyframes from before a loop that is still open do not count
        assert state.features is not None
        chosen, depth = np.append(kept, i), state.features.usual_depth
        doubled = may_be_doubled(state, chosen, drift_to_last(state, chosen), depth)[:-1]
        is_new = bool(shares[~doubled].max(initial=0) < config.keyframe_overlap)
    frames = frames.put(i, mapped=True, keyframe=is_new, exposure=np.asarray(image.exposure))
    return state._replace(map=updated, frames=frames)


def as_blocks(state: SlamState) -> tuple[BlockConfig, Blocks]:
    """The map as blocks, which is what the method `fused` keeps anyway."""
    assert state.grid is not None and state.map is not None
    params = scene_params(state.map)
    if isinstance(state.grid, BlockConfig):
        return state.grid, params
    (values,) = params
    return blocks_of_grid(state.grid, np.asarray(values))
