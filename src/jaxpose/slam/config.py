"""Settings of a SLAM run."""

from dataclasses import dataclass
from typing import Literal

from jaxpose.fields import PoseNetConfig
from jaxpose.imu import ADIS16448, ImuNoise
from jaxpose.slam.map.photometric import MapConfig
from jaxpose.slam.tracking.objective import ImuWeights, TrackConfig
from jaxpose.slam.tracking.reference_frames import FrameName

ImuMode = Literal["none", "loose", "tight", "accelerometer", "combined"]

IMU_WEIGHTS: dict[ImuMode, ImuWeights] = {
    "none": ImuWeights(),
    "loose": ImuWeights(loose=1.0),
    "tight": ImuWeights(tight=1.0),
    "accelerometer": ImuWeights(accelerometer=1.0),
    "combined": ImuWeights(loose=1.0, tight=1.0, accelerometer=1.0),
}


@dataclass(frozen=True)
class SlamConfig:
    """Settings of a run; every random choice follows from `seed`."""

    imu: ImuMode = "none"
    frame: FrameName = "anchored"
    seed: int = 0
    field: PoseNetConfig = PoseNetConfig(layers=4, width=128, activation="softplus")
    track: TrackConfig = TrackConfig()
    map: MapConfig = MapConfig()
    map_every_s: float = 0.15  # [s] between mapping steps
    voxel: float | None = None  # [m]; None: from the size of the room
    hold_out: int = 0  # every n-th frame is tracked but never mapped, to measure the map on; 0: none
    keyframe_overlap: float = 0.9  # a frame that shares less with every keyframe becomes one
    imu_noise: ImuNoise = ADIS16448

    def __post_init__(self):
        positive = {
            "track.pixels": self.track.pixels,
            "track.iterations": self.track.iterations,
            "track.field_steps": self.track.field_steps,
            "map.window": self.map.window,
            "map.iterations": self.map.iterations,
            "map.first_iterations": self.map.first_iterations,
            "field.layers": self.field.layers,
            "field.width": self.field.width,
        }
        for name, value in positive.items():
            if value < 1:
                raise ValueError(f"{name}: expected 1 or more, got {value}")
        if self.hold_out == 1 or self.hold_out < 0:
            raise ValueError(f"hold_out: expected 0, or 2 or more, got {self.hold_out}")

    @property
    def uses_gyroscope(self) -> bool:
        """Whether the gyroscope is used."""
        return self.imu != "none"

    @property
    def uses_accelerometer(self) -> bool:
        """Whether the accelerometer carries the speed from one frame to the next."""
        return self.imu in ("accelerometer", "combined")
