"""A run that goes on in the map of an earlier one: its first camera is found there; the world is the same."""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxpose.datasets.types import Frame, Recording, check_frame
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera
from jaxpose.scenes.voxel_blocks import BlockConfig, Blocks, packed
from jaxpose.slam.beginning import begin
from jaxpose.slam.config import RecoveryConfig, SlamConfig, TrackConfig
from jaxpose.slam.initial_pose import first_force, is_gravity
from jaxpose.slam.map.integrate import sample_map
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.map.texture import Texture
from jaxpose.slam.observation import Image, sample_pixels, to_device
from jaxpose.slam.tracking.features import FeaturePose, Features, detect, locate_camera
from jaxpose.slam.tracking.predict import FIRST_FEATURE_SCALE
from jaxpose.slam.tracking.register import register
from jaxpose.slam.types import EarlierMap, SlamResult, SlamState

_CANDIDATES = 3  # places by features that a frame is registered at
_HINTS = 4  # other frames that are looked for, where the first is not found


class SavedMap(NamedTuple):
    """The map of a run, and by what later runs find where they are in it.

    Attributes:
        config: how finely it resolves space.
        blocks: the map, with the weights that it was integrated with.
        texture: finer colour on its surface.
        keyframes: which frames of the run are (k,).
        T_world_cam: poses of keyframes (m, 4, 4), of runs before in the same map first.
        features: of these keyframes, m of them; none of a run without.
        usual: median loss [sigmas] and colour error of the run's frames.
    """

    config: BlockConfig
    blocks: Blocks
    texture: Texture
    keyframes: Int[np.ndarray, " k"]
    T_world_cam: Float[np.ndarray, "m 4 4"]
    features: tuple[Features, ...]
    usual: tuple[float, float]


class _Found(NamedTuple):
    """A frame registered to a map."""

    T_world_cam: Float[Array, "4 4"]
    loss: Float[Array, ""]
    colour_error: Float[Array, ""]
    valid: Float[Array, ""]
    exposure: Float[Array, "3"]


def saved_map(result: SlamResult) -> SavedMap:
    """What later runs in the same place need of a run.

    Args:
        result: of `run` or `finish`.

    Returns:
        Its map and its keyframes, to be given to `begin_in`.
    """
    frames, kept = result.frames, result.keyframes
    found = ~frames.doubted & np.isfinite(frames.loss)
    usual = [float(np.median(x[found])) if found.any() else 0.0 for x in (frames.loss, frames.colour_error)]
    poses, features = result.T_world_cam[kept], result.keyframe_features
    if result.earlier is not None:
        poses = np.concatenate([result.earlier.T_world_cam, poses])
        features = (*result.earlier.features, *features)
    return SavedMap(
        result.map_config,
        *result.scene_params,
        keyframes=kept,
        T_world_cam=poses,
        features=features,
        usual=(usual[0], usual[1]),
    )


def begin_in(earlier: SavedMap, recording: Recording, config: SlamConfig) -> SlamState:
    """The state of a recording's run before its first frame, in the world and the map of an earlier run.

    Keyframes of that run with features in common say where the first frame was taken, and registration to
    the map confirms it. The blocks of `earlier` are written over as the run goes.

    Args:
        earlier: the map of a run before.
        recording: frames that begin where the map is; its own true poses say nothing of that world.
        config: settings of the run; `voxel` is that of the map.

    Returns:
        The state to give to `run`.

    Raises:
        DataError: where the first frame shows nothing that was mapped, or the recording cannot be tracked.
    """
    state = begin(recording, config)
    if not (config.uses_features and config.map.method == "fused"):
        raise DataError(
            "map: expected features and a fused map to go on in an earlier one, got a run without"
        )
    if not any(len(features.depth) for features in earlier.features):
        raise DataError("map: expected one with the features of its keyframes, got a run without")
    find = partial(_found, earlier, recording, config)
    found = find(0)
    if found is None:
        places = np.unique(np.linspace(0, len(recording.t) - 1, _HINTS + 1).astype(int))[1:]
        later = next((i for i in places.tolist() if find(i) is not None), None)
        hint = "nor do others"
        if later is not None:
            hint = f"but the one {recording.t[later] - recording.t[0]:.2f} s later does: --start skips frames"
        raise DataError(
            f"{recording.name}: expected a first frame that shows what the map holds, it does not, {hint}"
        )
    T_world_cam = np.asarray(found.T_world_cam, np.float64)
    state = state._replace(
        T_world_cam_first=T_world_cam,
        gravity_world=_gravity(recording, T_world_cam, state.gravity_world),
        exposure=np.asarray(found.exposure),
        grid=earlier.config,
    )
    return with_earlier(state, earlier)._replace(map=MapState(earlier.blocks, ()))


def with_earlier(state: SlamState, earlier: SavedMap) -> SlamState:
    """The state of a run in an earlier one's map that knows what that map began with.

    Args:
        state: a run that `begin_in` has begun.
        earlier: the map of a run before.

    Returns:
        The state; a map that is made anew begins with the earlier one.
    """
    coords, values = (np.array(x) for x in packed(earlier.blocks))
    known = EarlierMap(coords, values, earlier.texture, earlier.T_world_cam, earlier.features)
    return state._replace(earlier=known)


def _found(earlier: SavedMap, recording: Recording, config: SlamConfig, index: int) -> _Found | None:
    """A frame registered to the map, from where features say that it was; None where nothing is sure."""
    camera = recording.camera
    frame = check_frame(recording.read(index), camera)
    image, register_at = to_device(frame), _registration(camera, earlier.config, config.track)
    best = None
    for seen in _seen(earlier, frame, camera):
        covariance = FIRST_FEATURE_SCALE * seen.covariance
        where = (jnp.asarray(x, jnp.float32) for x in (seen.T_world_cam, covariance))
        found = jax.device_get(register_at(earlier.blocks, image, *where))
        if _is_there(config.recovery, earlier, found) and (best is None or found.loss < best.loss):
            best = found
    return best


def _seen(earlier: SavedMap, frame: Frame, camera: Camera) -> list[FeaturePose]:
    """Where features of each keyframe and its neighbours say that a frame was taken, the surest ones."""
    now, count, found = detect(frame, camera), len(earlier.features), []
    for k in range(count):
        beside = [j for j in (k - 1, k, k + 1) if 0 <= j < count]
        known = [(earlier.features[j], earlier.T_world_cam[j]) for j in beside]
        seen = locate_camera(now, known, camera)
        if seen is not None:
            found.append(seen)
    return sorted(found, key=lambda seen: -seen.inliers)[:_CANDIDATES]


def _is_there(policy: RecoveryConfig, earlier: SavedMap, found: _Found) -> bool:
    """Whether a registration explains its frame about as well as frames of the earlier run were."""
    loss, colour = earlier.usual
    return bool(
        np.isfinite(found.T_world_cam).all()
        and found.valid > policy.found_valid
        and found.loss < policy.lost_loss * max(loss, 1.0)
        and found.colour_error < policy.outlier_colour * max(colour, policy.least_colour)
    )


@lru_cache(maxsize=1)
def _registration(camera: Camera, grid: BlockConfig, track: TrackConfig):
    @jax.jit
    def found(blocks: Blocks, image: Image, T: Float[Array, "4 4"], covariance: Float[Array, "6 6"]):
        pixels = sample_pixels(jax.random.key(0), image, camera, track.pixels, edge=track.edge)
        at = register(partial(sample_map, grid, blocks, ()), T, T, covariance, pixels, track)
        left = at.residuals
        return _Found(at.T_world_cam, at.loss, left.colour_error, left.valid, left.exposure)

    return found


def _gravity(
    recording: Recording, T_world_cam: Float[np.ndarray, "4 4"], known: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Gravity in the world of the map, by the readings around the first frame; as stated where none tell."""
    force_cam = first_force(recording)
    if force_cam is None or not is_gravity(force_cam, known):
        return known
    down = -T_world_cam[:3, :3] @ force_cam
    return np.linalg.norm(known) * down / np.linalg.norm(down)
