"""State of a SLAM run between two frames. A checkpoint stores exactly this."""

import enum
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8

from jaxpose.datasets.types import Frame
from jaxpose.estimate import Posterior
from jaxpose.fields import Covariances, Params, PoseField
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera
from jaxpose.imu import Imu
from jaxpose.scenes import GridConfig, SceneField
from jaxpose.scenes.voxel_blocks import BlockConfig, Blocks
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.loops.types import Loops, Proposal
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.map.texture import Texture
from jaxpose.slam.tracking.features import Features

# Settings are no leaves of a state: a state is a pytree of arrays and numbers.
jax.tree_util.register_static(SlamConfig)
jax.tree_util.register_static(GridConfig)
jax.tree_util.register_static(BlockConfig)


class TrackingStatus(enum.IntEnum):
    """How a frame's pose was found; the higher, the less it is worth."""

    TRACKED = 0  # registered to the map
    WEAK = 1  # registered, but the image says little of some direction
    DEAD_RECKONED = 2  # from the IMU alone, over too short a time to be far off
    APPEARANCE_OUTLIER = 3  # surfaces fit, colours do not: another place, or another light
    LOST = 4  # registration failed; the pose is the prediction


class Frames(NamedTuple):
    """What is known of every frame so far, a row each; NaN, False or 0 where nothing is."""

    t: Float[np.ndarray, " n"]  # [s] as given, increasing
    T_world_body: Float[np.ndarray, "n 4 4"]
    T_odometry: Float[np.ndarray, "n 4 4"]  # T_world_body as tracked: motions put together, without loops
    T_inner: Float[np.ndarray, "n 4 4"]  # motion since the last frame, in the frame `intrinsic`
    status: Int8[np.ndarray, " n"]  # TrackingStatus
    feature_nis: Float[np.ndarray, " n"]  # squared Mahalanobis distance from the pose by features
    line_delay: Float[np.ndarray, "n 2"]  # correction [s] by the image, and its information
    mapped: Bool[np.ndarray, " n"]  # the map was made from it
    keyframe: Bool[np.ndarray, " n"]
    exposure: Float[np.ndarray, "n 3"]  # what its colours were multiplied by where it was mapped
    iterations: Int[np.ndarray, " n"]
    loss: Float[np.ndarray, " n"]  # of the image, in sigmas
    depth_error: Float[np.ndarray, " n"]  # [m] median
    colour_error: Float[np.ndarray, " n"]  # median, of colours in [0, 1]
    valid: Float[np.ndarray, " n"]  # share of the pixels with depth that the map explains
    sigma: Float[np.ndarray, "n 2"]  # [m, rad] of the pose, by what the image says of it
    covariance: Float[np.ndarray, "n 6 6"]  # of the pose beside the map, over right increments of the camera
    seconds: Float[np.ndarray, " n"]  # wall time, compilation included

    @property
    def count(self) -> int:
        """How many frames there are."""
        return len(self.t)

    @property
    def lost(self) -> Bool[np.ndarray, " n"]:
        """Registration failed; the pose is the prediction."""
        return self.status == TrackingStatus.LOST

    @property
    def doubted(self) -> Bool[np.ndarray, " n"]:
        """Lost, or unlike the map in colour: nothing is mapped from such a frame."""
        return self.status >= TrackingStatus.APPEARANCE_OUTLIER

    @property
    def uncertain(self) -> Bool[np.ndarray, " n"]:
        """Anything but registered with every direction held by the image."""
        return self.status != TrackingStatus.TRACKED

    @property
    def last_found(self) -> int:
        """The last frame before the current one that is not in doubt."""
        return int(np.flatnonzero(~self.doubted[:-1])[-1])

    def put(self, i: int | Int[np.ndarray, " k"], **values) -> "Frames":
        """The same with other values at a frame, or at some."""
        changed = {name: getattr(self, name).copy() for name in values}
        for name, value in values.items():
            changed[name][i] = value
        return self._replace(**changed)

    def corrected(self, T_predicted_found: Float[np.ndarray, "4 4"]) -> "Frames":
        """The frames in doubt moved by their share of what the prediction at the current frame was off."""
        last, i, t = self.last_found, self.count - 1, self.t
        lost = np.arange(last + 1, i)
        share = (t[lost] - t[last]) / (t[i] - t[last])
        correction = rigid.exp(share[:, None] * rigid.log(T_predicted_found))
        return self.put(lost, T_world_body=self.T_world_body[lost] @ correction)

    def with_odometry(self) -> "Frames":
        """The same with the motions to the current frame, and to those in doubt before it, put together."""
        first, last = (self.last_found if self.count > 1 else 0), self.count - 1
        if last == 0:
            return self.put(0, T_odometry=self.T_world_body[0])
        since = rigid.inverse(self.T_world_body[first]) @ self.T_world_body[first + 1 :]
        return self.put(np.arange(first + 1, last + 1), T_odometry=self.T_odometry[first] @ since)

    def appended(self, t: float) -> "Frames":
        """One more frame at `t` [s], of which nothing is known yet."""
        row = no_frames(np.array([t]))
        return Frames(*(np.concatenate(pair) for pair in zip(self, row, strict=True)))


def no_frames(t: Float[np.ndarray, " n"]) -> Frames:
    """Frames at times [s] of which nothing is known yet."""
    count = len(t)
    unknown, no = np.full(count, np.nan), np.zeros(count, bool)
    return Frames(
        t=np.asarray(t, np.float64),
        T_world_body=np.full((count, 4, 4), np.nan),
        T_odometry=np.full((count, 4, 4), np.nan),
        T_inner=np.full((count, 4, 4), np.nan),
        status=np.zeros(count, np.int8),
        feature_nis=unknown,
        line_delay=np.full((count, 2), np.nan),
        mapped=no,
        keyframe=no,
        exposure=np.full((count, 3), np.nan),
        iterations=np.zeros(count, int),
        loss=unknown,
        depth_error=unknown,
        colour_error=unknown,
        valid=unknown,
        sigma=np.full((count, 2), np.nan),
        covariance=np.full((count, 6, 6), np.nan),
        seconds=unknown,
    )


class Motion(NamedTuple):
    """What carries the prediction from one frame to the next."""

    twist: Float[np.ndarray, "6"]  # of the body over the last interval, per second
    velocity_body: Float[np.ndarray, "3"]  # [m/s] at the last frame
    gyro_bias: Float[np.ndarray, "3"]  # [rad/s] in the body (`predict.observe_gyro_bias`)
    gyro_bias_sigma: Float[np.ndarray, ""] | float
    accelerometer_bias_world: Float[np.ndarray, "3"]  # [m/s^2] (`predict.observe_acceleration`)


class EarlierMap(NamedTuple):
    """The map of an earlier run, on the host: what this run's begins with, also where it is made anew."""

    coords: Int[np.ndarray, "n 3"]  # `voxel_blocks.packed`
    values: Int[np.ndarray, "n 9 9 9 8"]
    texture: Texture
    T_world_cam: Float[np.ndarray, "m 4 4"]  # of its keyframes, and of those of runs before it
    features: tuple[Features, ...]


class SlamState(NamedTuple):
    """A run after some frames: a pytree, whose settings (`config`, `grid`) are static.

    `init` makes it, `step` advances it, `finish` sums it up. The old state of a step stays usable unless the
    step was told to donate it.
    """

    camera: Camera
    config: SlamConfig
    T_body_cam: Float[np.ndarray, "4 4"]
    gravity_world: Float[np.ndarray, "3"]  # [m/s^2]
    T_world_cam_first: Float[np.ndarray, "4 4"] | None  # None: upright by the first readings
    duration_s: float  # of the sequence, for the paper's frames of reference; NaN: not known
    imu_offset_s: float  # t_imu - t_frame by an earlier pass over the same frames, as is T_body_cam
    passes: int  # over these frames before
    frames: Frames
    imu: Imu | None  # readings since a little before the last frame
    motion: Motion
    params: Params | None  # of the tracked field, where something reads it
    exposure: Float[np.ndarray | Array, "3"]  # of the last registered image (`observation.Image`)
    max_depth: float  # [m] how deep the map is
    thumbnails: Float[np.ndarray, "k 2 12 16"]  # of the keyframes (`keyframes.thumbnail`)
    keyframe_depths: Float[np.ndarray, "k 12 16"]  # (`keyframes.coarse_depth`)
    features: Features | None  # of the last frame; None: not used, or before the first
    keyframe_features: tuple[Features, ...]
    loops: Loops
    settled: int  # frame at which poses and loops last agreed, by a correction or without; 0: never
    pending: Int[np.ndarray, " p"]  # frames that a map made anew lacks yet, the most needed first
    coarser_at: Int[np.ndarray, " c"]  # frames at which voxels became twice as wide, for want of room
    images: tuple[Frame, ...]  # of the keyframes, where no recording can give them again
    readings: tuple[Imu, ...]  # all of them, as they came, where no recording can give them again
    grid: BlockConfig | GridConfig | None  # how finely the map resolves space; None: before the first frame
    map: MapState | None
    earlier: EarlierMap | None = None  # of a run that this one goes on in the map of (`sessions`)


class SlamResult(NamedTuple):
    """A tracked sequence: poses, the map, and one continuous trajectory."""

    T_world_cam: Float[np.ndarray, "n 4 4"]
    T_world_cam_odometry: Float[np.ndarray, "n 4 4"]  # motions as tracked, put together without loops
    frames: Frames
    loops: Loops
    bundle: Proposal | None  # of the keyframes at the end; taken if it agrees
    coarser_at: Int[np.ndarray, " c"]  # frames at which voxels became twice as wide (`config.map_budget_gb`)
    keyframe_features: tuple[Features, ...]  # by which a later run finds where it is
    T_body_cam: Float[np.ndarray, "4 4"]  # the camera on the IMU, as tracking had it
    earlier: EarlierMap | None  # which the first blocks of the map are of (`sessions.begin_in`)
    scene: SceneField
    map_config: BlockConfig
    scene_params: tuple[Blocks, Texture]
    field: PoseField  # camera in the world, over seconds since the first frame
    field_params: Params
    field_rmse_m: float  # of the field at the frames' times to the tracked poses
    field_rmse_deg: float
    posterior: Posterior | None  # of a run with an IMU: covariance at any time, and the sensors
    covariances: Covariances | None  # of the field

    @property
    def keyframes(self) -> Int[np.ndarray, " k"]:
        """Which frames are keyframes."""
        return np.flatnonzero(self.frames.keyframe)
