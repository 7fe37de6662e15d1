"""Settings of a SLAM run, all of them, each checked where it is made."""

import math
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

from jaxpose.fields import PoseNetConfig
from jaxpose.imu import ADIS16448, ImuNoise

MOST_LINE_DELAY_US = 1000.0  # half a second for an image of 500 rows: no camera is as slow
MOST_BUDGET_GB = 4.0  # 32 bits count as many numbers of 16 bits, rounded
ImuMode = Literal["none", "loose", "tight", "accelerometer", "combined"]
FrameName = Literal["anchored", "default", "world", "random", "intrinsic"]


class ImuWeights(NamedTuple):
    """Weights of the three inertial losses (Ma et al. 2024, section 3.4); 0 leaves one out."""

    loose: float = 0.0
    tight: float = 0.0
    accelerometer: float = 0.0


IMU_WEIGHTS: dict[ImuMode, ImuWeights] = {
    "none": ImuWeights(),
    "loose": ImuWeights(loose=1.0),
    "tight": ImuWeights(tight=1.0),
    "accelerometer": ImuWeights(accelerometer=1.0),
    "combined": ImuWeights(loose=1.0, tight=1.0, accelerometer=1.0),
}


def _check(config, name: str, *, at_least: dict[str, int] | None = None, positive: tuple[str, ...] = ()):
    for field, least in (at_least or {}).items():
        if getattr(config, field) < least:
            raise ValueError(f"{name}.{field}: expected {least} or more, got {getattr(config, field)}")
    for field in positive:
        if not 0 < getattr(config, field) < math.inf:
            raise ValueError(f"{name}.{field}: expected a positive number, got {getattr(config, field)}")


@dataclass(frozen=True)
class SampleConfig:
    """Samples along a ray: evenly up to the measured surface, denser through it, a few behind."""

    front: int = 6  # before the surface
    surface: int = 16  # through it
    behind: int = 2  # behind it
    band: float = 0.12  # [m] to either side of the measured depth that counts as the surface
    width: float = 0.015  # [m] thickness of a rendered surface (`render.sdf_weights`)

    def __post_init__(self):
        _check(self, "sample", at_least={"front": 0, "surface": 2, "behind": 0}, positive=("band", "width"))


@dataclass(frozen=True)
class TrackConfig:
    """How one frame is tracked.

    `gradient` is the paper's way: Adam on the field through the renderer, pixels drawn anew in each
    iteration. `gauss_newton` registers the frame to the map's surface by second-order steps on its pose.
    """

    # gauss_newton registers a frame to the surface; gradient is the paper's, through the renderer.
    method: Literal["gauss_newton", "gradient"] = "gauss_newton"
    pixels: int = 5000  # of a frame; 200 to 1000 for `gradient`, which draws new ones in each iteration
    edge: int = 8  # [px] border left out
    iterations: int = 25  # steps at most; 150 for `gradient`
    patience: int = 30  # of `gradient`: iterations without a lower loss after which to stop
    learning_rate: float = 1e-3  # of `gradient`: Adam, of TransNet [per translation_scale]
    rotation_rate: float = 2e-4  # of `gradient`: Adam, of RotsNet
    decay: float = 0.1  # of `gradient`: of both rates over the iterations
    field_steps: int = 60  # of `gradient`: Adam steps of fitting the field to the predicted motion
    colour_weight: float = 0.1  # of the colour residual against the depth residual, both in sigmas
    dof_weight: float = 0.1  # of L_dof, in the frame intrinsic under `gradient`
    minimum_valid: float = 0.2  # share of the pixels the map must explain
    sample: SampleConfig = SampleConfig()

    def __post_init__(self):
        least = {"pixels": 1, "iterations": 1, "field_steps": 1, "patience": 1, "edge": 0}
        _check(self, "track", at_least=least, positive=("learning_rate", "rotation_rate", "decay"))


@dataclass(frozen=True)
class MapConfig:
    """How the scene is mapped; all but the first is of the method `gradient`, the paper's way."""

    # fused integrates depth into signed distances; gradient is the paper's, through the renderer.
    method: Literal["fused", "gradient"] = "fused"
    pixels: int = 1000  # per iteration, shared by the frames of the window
    edge: int = 4  # [px] border left out
    window: int = 5  # frames: the current one, the last keyframe, and keyframes that overlap
    iterations: int = 20  # of Adam in a mapping step
    first_iterations: int = 200  # of Adam at the first frame
    learning_rate: float = 2e-3  # of Adam after that
    first_rate: float = 5e-3  # of Adam at the first frame
    sample: SampleConfig = SampleConfig(front=8, surface=14, behind=0)

    def __post_init__(self):
        least = {"pixels": 1, "window": 1, "iterations": 1, "first_iterations": 1, "edge": 0}
        _check(self, "map", at_least=least, positive=("learning_rate", "first_rate"))


@dataclass(frozen=True)
class RecoveryConfig:
    """When a registration is believed, doubted, or searched for: the policy of tracking, with its reasons.

    Records of the runs behind the numbers are in `experiments/README.md`.
    """

    held: float = 0.08  # [m, rad] a prediction from the IMU that cannot be off by more is as good as no loss
    held_by_features: float = 0.05  # [m, rad] a pose known so well by features is not lost
    farthest: float = 0.5  # [m, rad] a search reaches no farther around a prediction; then anywhere
    around_keyframes: float = 0.25  # [m, rad] a search reaches around keyframes where nothing else is known
    recognised_valid: float = 0.7  # after a loss, of a camera that could be anywhere: share explained,
    recognised_loss: float = 1.1  # and loss against the usual
    found_valid: float = 0.5  # the same of a camera that must be near
    found_loss: float = 1.3  # and loss against the usual
    lost_loss: float = 2.0  # against the usual: a registration that is worse has failed
    reckoned: float = 0.3  # [m, rad] a pose from the IMU alone is good enough to go on from
    weak: float = 0.02  # [m, rad] a pose known less well is weak
    least_depth: float = 0.01  # share of an image; with less there is nothing to register
    colour_pulls: float = 0.03  # [m, rad] as far off as colour still pulls
    worse_colour: float = 1.5  # against the usual error: search for a place with better colours
    better_colour: float = 0.9  # against the other pose's error,
    as_much: float = 0.7  # share explained
    as_well: float = 1.3  # and loss: then the pose that a search found is taken
    outlier_colour: float = 2.5  # against the usual; measured at most 2.2 at true poses, from 2.6 beside them
    least_colour: float = 0.008  # an error that images without noise stay below; less says nothing
    other_light_s: float = 2.0  # after which another colour everywhere is another light
    fading_s: float = 0.5  # in which a speed that nothing senses is forgotten

    def __post_init__(self):
        _check(self, "recovery", positive=tuple(field.name for field in fields(self)))


@dataclass(frozen=True)
class LoopConfig:
    """When two keyframes are believed to show the same place.

    Records of the pairs behind the numbers are in `experiments/README.md`.
    """

    drift: float = 1.0  # voxels that a surface may have drifted by, one sigma, for a loop to be looked for
    share: float = 0.05  # of what a frame sees that an earlier one may have seen, to be compared with it
    candidates: int = 3  # keyframes whose features are compared with a new one's
    overlap: float = 0.25  # share of the depth of one image where the other has depth too
    agreement: float = 0.75  # share of that which is on the other's surface
    conflict: float = 0.1  # share of that which is where the other has seen free space
    colour: float = 0.85  # correlation of grey values on the surface: 0.75 and 0.82 were 20 and 16 cm off
    sigma: float = 0.02  # [m, rad] of the relative pose along its worst axis

    def __post_init__(self):
        _check(self, "loop", positive=tuple(field.name for field in fields(self)))


@dataclass(frozen=True)
class SlamConfig:
    """Settings of a run; every random choice follows from `seed`."""

    # What of the IMU is used: gyroscope (loose, tight), and accelerometer too (accelerometer, combined).
    imu: ImuMode = "none"
    # What the output of the field is relative to; all but anchored, which is ours, are the paper's (table 9).
    frame: FrameName = "anchored"
    # Sparse features as a second opinion on the motion (`gauss_newton` only): ORB by OpenCV, or none.
    features: Literal["orb", "none"] = "orb"
    # Places that are seen again correct the trajectory and the map (with features and a fused map).
    loops: bool = True
    # What is done at the end (`gauss_newton` and a fused map): frames in doubt are looked for between their
    # neighbours (doubted), and keyframes then adjusted together by the points that they share, where colour
    # and depth belong together (bundle); or all frames are registered to the map of all (all).
    refine: Literal["bundle", "doubted", "all", "none"] = "bundle"
    # offset, extrinsics: by the final pass over a run with an IMU, beside biases and gravity; line-delay: by
    # three runs before it.
    estimate: tuple[Literal["offset", "extrinsics", "line-delay"], ...] = ()
    # From row to row of a rolling shutter [us]; a frame's time is its first row's.
    line_delay_us: float = 0.0
    seed: int = 0  # of the network's start, the pixels drawn, the noise of a simulated IMU
    field: PoseNetConfig = PoseNetConfig(layers=4, width=128, activation="softplus")
    track: TrackConfig = TrackConfig()
    map: MapConfig = MapConfig()
    recovery: RecoveryConfig = RecoveryConfig()
    loop: LoopConfig = LoopConfig()
    map_every_s: float = 0.15  # [s] between mapping steps
    voxel: float | None = None  # [m] size of the map's cells; None: from the size of the room
    # [GB] of memory for the blocks of the map, also while they grow; with more to hold, it is made anew of
    # voxels twice as wide.
    map_budget_gb: float = 2.0
    hold_out: int = 0  # every n-th frame is tracked but never mapped, to measure the map on; 0: none
    keyframe_overlap: float = 0.9  # a frame that shares less with every keyframe becomes one
    imu_noise: ImuNoise = ADIS16448

    def __post_init__(self):
        if self.hold_out == 1 or self.hold_out < 0:
            raise ValueError(f"hold_out: expected 0, or 2 or more, got {self.hold_out}")
        if not abs(self.line_delay_us) <= MOST_LINE_DELAY_US:
            raise ValueError(
                f"line_delay_us: expected at most {MOST_LINE_DELAY_US:g} us, got {self.line_delay_us}"
            )
        if not 0 < self.map_budget_gb <= MOST_BUDGET_GB:
            most, got = MOST_BUDGET_GB, self.map_budget_gb
            raise ValueError(f"map_budget_gb: expected a number above 0, at most {most:g}, got {got}")
        if self.voxel is not None and not 0 < self.voxel < math.inf:
            raise ValueError(f"voxel: expected a positive number, got {self.voxel}")

    @property
    def map_budget(self) -> float:
        """Memory for the map's blocks [bytes]."""
        return 1e9 * self.map_budget_gb

    @property
    def uses_gyroscope(self) -> bool:
        """Whether the gyroscope is used."""
        return self.imu != "none"

    @property
    def uses_accelerometer(self) -> bool:
        """Whether the accelerometer carries the speed from one frame to the next."""
        return self.imu in ("accelerometer", "combined")

    @property
    def uses_features(self) -> bool:
        """Whether poses are predicted by sparse features; the paper's own way of tracking has none."""
        return self.features != "none" and self.track.method == "gauss_newton"

    @property
    def uses_loops(self) -> bool:
        """Whether loops are looked for: by features, and corrected where a map can be integrated anew."""
        return self.loops and self.uses_features and self.map.method == "fused"

    @property
    def uses_refinement(self) -> bool:
        """Whether frames are registered again at the end: where a map can be integrated anew."""
        return self.refine != "none" and self.track.method == "gauss_newton" and self.map.method == "fused"

    @property
    def uses_bundle(self) -> bool:
        """Whether keyframes are adjusted together at the end, by their features."""
        return self.refine == "bundle" and self.uses_refinement and self.uses_features

    @property
    def uses_field(self) -> bool:
        """Whether a PoseNet is used: `gradient` tracks by it, and the intrinsic frame is made of two.

        Registration by Gauss-Newton finds poses; the trajectory is then fitted to them once, at the end.
        """
        return self.track.method == "gradient" or self.frame == "intrinsic"
