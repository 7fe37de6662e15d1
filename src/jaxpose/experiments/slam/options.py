"""Options of the SLAM experiments, and which of them go together."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.datasets.synthetic import RoomConfig
from jaxpose.experiments.checks import (
    check_finite,
    check_least,
    check_positive,
    check_run_folder,
    check_unused,
)
from jaxpose.fields import PoseNetConfig
from jaxpose.files import atomic
from jaxpose.slam import LoopConfig, SlamConfig

SMOKE_FRAMES = 8
FEWEST_FRAMES = 3  # three camera centres are the fewest that an alignment can be wrong about

# The options of the first screen of help.
GROUPS = {
    "data": ("data", "recorded_hz", "rate_hz", "imu_file", "imu_extrinsics", "map"),
    "method": ("slam.imu", "compare", "slam.voxel", "slam.seed"),
    "run": ("out", "name", "resume", "smoke", "json"),
}
# What tracking sets by itself, or cannot use.
HIDDEN = {
    "slam.field.span": "as tracking sets it from the time between frames",
    "slam.field.window": "as tracking has no coarse-to-fine schedule",
    "slam.field.coupled": "as tracking has a rate for each of two networks",
    "slam.track.sample.band": "as the voxel sets it",
    "slam.track.sample.width": "as the voxel sets it",
    "slam.map.sample.band": "as the voxel sets it",
    "slam.map.sample.width": "as the voxel sets it",
    "room.rate_hz": "as --rate-hz sets it",
}
_SAMPLES = ("front", "surface", "behind")
_RENDERED_TRACKING = (
    "patience", "field_steps", "learning_rate", "rotation_rate", "decay",
    *(f"sample.{name}" for name in _SAMPLES),
)  # fmt: skip
_RENDERED_MAPPING = (
    "pixels", "edge", "window", "iterations", "first_iterations", "learning_rate", "first_rate",
    *(f"sample.{name}" for name in _SAMPLES),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Settings of a run; a recording and these are all that a result depends on."""

    data: Path | None = None  # folder of a recording; None: a synthetic room is made on the fly
    format: rgbd_registry.Format | None = None  # layout of --data; None: found by its files
    topics: tuple[str, ...] = ()  # of a ROS bag in --data, those to use before others of their kind
    recorded_hz: float | None = None  # [Hz] frame rate of --data where it has no timestamps; None: 30
    rate_hz: float | None = None  # [Hz] frames are thinned to this; None: the room's 5, or all frames
    start: int = 0  # first frame used, counted before thinning
    frames: int | None = None  # how many frames from there, counted before thinning; None: all
    # How rotations are interpolated between true poses where an IMU is simulated from them; None: slerp, as
    # in the paper.
    imu_rotation: Literal["slerp", "spline"] | None = None
    # IMU readings for --data: EuRoC's csv or lines of `t wx wy wz ax ay az`, on the clock of the images.
    imu_file: Path | None = None
    imu_extrinsics: Path | None = None  # of --imu-file: T_body_cam as T_BS of a sensor.yaml, or 16 numbers
    imu_offset_s: float = 0.0  # [s] added to the timestamps of a recording's own IMU
    imu_filter: bool = False  # subtract that IMU's biases, estimated with the true poses as in the paper
    # Run folder of a run in the same place, with features: go on in its map and its world, without --voxel.
    map: Path | None = None
    compare: bool = False  # run all IMU modes and put them side by side
    resume: bool = False  # go on where a run of the same folder and settings was stopped
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    out: Path | None = None  # exactly this folder; None: outputs/<experiment>/<name or timestamp>
    name: str | None = None  # of the folder within outputs/<experiment>
    json: bool = False  # print the results as JSON and nothing else
    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = SlamConfig()
    room: RoomConfig = RoomConfig()

    def __post_init__(self):
        check_positive(self, "recorded_hz", "rate_hz", "slam.voxel", "slam.map_every_s")
        check_finite(self, "imu_offset_s")
        check_least(self, start=0, frames=FEWEST_FRAMES)
        check_run_folder(self, self.data, self.imu_file, self.imu_extrinsics, self.room.along, self.map)
        self._check_data()
        self._check_imu()
        self._check_method()
        room_config(self)

    def _check_data(self):
        if self.data is None:
            check_unused(self, ("format", "topics", "recorded_hz"), "without --data")
        else:
            check_unused(self, [f"room.{name}" for name in RoomConfig.__dataclass_fields__], "with --data")
        if self.room.along is not None:
            walk = ("scene", "speed", "imu_rate_hz", "imu_noise", "gravity_world")
            check_unused(self, [f"room.{name}" for name in walk], "with --room.along")

    def _check_imu(self):
        if (self.imu_file is None) != (self.imu_extrinsics is None):
            given, other = ("file", "extrinsics") if self.imu_file else ("extrinsics", "file")
            raise ValueError(f"--imu-{given}: expected --imu-{other} FILE with it, got none")
        if self.imu_file is not None and self.data is None:
            raise ValueError("--imu-file: expected --data DIR with it, as the room has readings of its own")
        if self.data is None and self.room.along is None:
            check_unused(self, ("imu_filter", "imu_offset_s"), "without --data or --room.along")
        if self.data is None or self.imu_file is not None:
            check_unused(self, ("imu_rotation",), "where no IMU is simulated from true poses")
        if self.compare:
            check_unused(self, ("slam.imu",), "with --compare, which runs all modes")
        elif self.slam.imu == "none" and not self.imu_filter:
            noise = [f"slam.imu_noise.{name}" for name in self.slam.imu_noise._fields]
            check_unused(self, ("imu_rotation", *noise), "with --imu none")

    def _check_method(self):
        slam = self.slam
        for path, why in HIDDEN.items():
            check_unused(self, (path,), why)
        if not slam.uses_field:
            names = [f"slam.field.{name}" for name in PoseNetConfig.__dataclass_fields__]
            why = "with --track.method gauss_newton"
            check_unused(self, names, f"{why}, but in the frame intrinsic")
            if slam.frame != "anchored":
                raise ValueError(f"--frame {slam.frame}: expected --track.method gradient with it")
        if slam.track.method == "gradient":
            check_unused(self, ("slam.features",), "with --track.method gradient")
        if slam.track.method == "gauss_newton":
            check_unused(
                self, [f"slam.track.{n}" for n in _RENDERED_TRACKING], "with --track.method gauss_newton"
            )
        elif slam.field.activation == "relu" and (self.compare or slam.imu in ("accelerometer", "combined")):
            raise ValueError("--field.activation relu: expected softplus, as relu has no second derivative")
        if slam.track.method == "gauss_newton" or slam.frame != "intrinsic":
            why = "without --track.method gradient and --frame intrinsic"
            check_unused(self, ("slam.track.dof_weight",), why)
        if not slam.uses_loops:
            names = [f"slam.loop.{name}" for name in LoopConfig.__dataclass_fields__]
            check_unused(self, names, "where no loops are looked for")
        if not replace(slam, loops=True).uses_loops:
            check_unused(self, ("slam.loops",), "without features and a fused map")
        if not replace(slam, refine="all").uses_refinement:
            check_unused(self, ("slam.refine",), "with --track.method or --map.method gradient")
        if slam.map.method == "gradient":
            check_unused(self, ("slam.map_budget_gb",), "with --map.method gradient")
        if self.map is not None:
            check_unused(self, ("slam.voxel",), "with --map, whose voxels are as they are")
            if not replace(slam, loops=True).uses_loops:
                raise ValueError("--map: expected features and a fused map with it, as by default")
        if slam.map.method == "fused":
            check_unused(self, [f"slam.map.{n}" for n in _RENDERED_MAPPING], "with --map.method fused")


def resume_fingerprint(options: Options) -> dict[str, Any]:
    """The settings that a resumed run must share with the one it resumes.

    Args:
        options: the settings of the run.

    Returns:
        Values in JSON's types, by the names of the options.
    """
    incidental = ("out", "name", "resume", "compare", "json")
    found = _flat(json.loads(atomic.json_text(options)))
    return {name: value for name, value in found if name not in incidental}


def _flat(settings: dict[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, "" if name == "slam" else f"{within}{name}.")
        else:
            yield within + name, value


def slam_config(options: Options) -> SlamConfig:
    """How to track.

    Args:
        options: the settings of the run.

    Returns:
        The settings of SLAM; with `smoke` a field that compiles sooner, and a coarse map.
    """
    slam = options.slam
    if not options.smoke:
        return slam
    return replace(slam, field=replace(slam.field, layers=2, width=32), voxel=slam.voxel or 0.05)


def room_config(options: Options) -> RoomConfig:
    """The settings of the room that a run without `data` walks through.

    Args:
        options: the settings of the run.

    Returns:
        Frames at the rate asked for; with `smoke` few and small ones.

    Raises:
        ValueError: for settings that do not go together.
    """
    config = replace(options.room, rate_hz=options.rate_hz or options.room.rate_hz)
    if not options.smoke:
        return config
    duration_s = min(config.duration_s, (SMOKE_FRAMES - 1) / config.rate_hz)
    return replace(config, duration_s=duration_s, width=80, height=60)
