"""Options that the SLAM experiments share, and the recording they name."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import tyro

from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.datasets.rgbd.imu_csv import imu_notes, with_imu
from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.types import Recording, select, thin
from jaxpose.errors import DataError
from jaxpose.files import atomic
from jaxpose.geometry import rigid
from jaxpose.imu import ADIS16448, QUIET, Imu, ImuNoise
from jaxpose.imu.eskf import PoseNoise
from jaxpose.imu.filtering import filter_imu
from jaxpose.imu.simulation import simulate_from_poses
from jaxpose.slam.initial_pose import first_force, is_gravity
from jaxpose.slam.pipeline import SlamConfig

SIMULATED_HZ = 200.0  # of the IMU made for recordings that have none (METHOD section 5)
SMOKE_FRAMES = 8
_POSE_NOISE = PoseNoise(1e-3, 2e-3)  # [m, rad] what motion capture is good for
FEWEST_FRAMES = 3  # three camera centres are the fewest that an alignment can be wrong about


@dataclass(frozen=True)
class Options:
    """Settings of a run; a recording and these are all that a result depends on."""

    data: Path | None = None  # folder of a recording; without one a synthetic room is made on the fly
    format: rgbd_registry.Format | Literal["room"] | None = None  # None: found by the files of --data
    recorded_hz: float = 30.0  # frame rate of a recording whose layout has no timestamps
    rate_hz: float | None = None  # frames are thinned to this; None: the room's, or all frames
    start: int = 0  # first frame used, counted before thinning
    frames: int | None = None  # how many frames from there, counted before thinning; None: all
    # How rotations pass through the true poses where an IMU is simulated from them: slerp is the paper's.
    imu_rotation: Literal["slerp", "spline"] = "slerp"
    # A real IMU for --data: readings, EuRoC's csv or `t wx wy wz ax ay az`, by the clock of the images,
    imu_file: Path | None = None
    # and where its camera sits on it, T_body_cam: T_BS of a sensor.yaml, or 16 numbers.
    imu_extrinsics: Path | None = None
    imu_offset_s: float = 0.0  # added to the timestamps of a recording's own IMU [s]
    imu_filter: bool = False  # take off that IMU's biases with the help of the true poses, as the paper does
    compare: bool = False  # run all IMU modes and put them side by side
    resume: bool = False  # go on where a run of the same folder and settings was stopped
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    out: Path | None = None  # exactly this folder; None: outputs/<experiment>/<name or timestamp>
    name: str | None = None  # of the run folder
    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = SlamConfig()
    room: RoomConfig = RoomConfig()

    def __post_init__(self):
        for option in ("recorded_hz", "rate_hz"):
            value = getattr(self, option)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"--{option.replace('_', '-')}: expected a positive number, got {value}")
        if not math.isfinite(self.imu_offset_s):
            raise ValueError(f"--imu-offset-s: expected a finite number, got {self.imu_offset_s}")
        if (self.imu_filter or self.imu_offset_s) and self.data is None and self.room.along is None:
            option = "--imu-filter" if self.imu_filter else "--imu-offset-s"
            raise ValueError(
                f"{option}: expected --data or --room.along DIR with an IMU of its own, got neither"
            )
        if (self.imu_file is None) != (self.imu_extrinsics is None):
            given, other = ("file", "extrinsics") if self.imu_file else ("extrinsics", "file")
            raise ValueError(f"--imu-{given}: expected --imu-{other} FILE with it, got none")
        if self.imu_file is not None and self.data is None:
            raise ValueError("--imu-file: expected --data DIR with it, as the room has readings of its own")
        if self.start < 0:
            raise ValueError(f"--start: expected 0 or more, got {self.start}")
        if self.frames is not None and self.frames < FEWEST_FRAMES:
            raise ValueError(f"--frames: expected at least {FEWEST_FRAMES}, got {self.frames}")
        if self.slam.voxel is not None and not 0 < self.slam.voxel < math.inf:
            raise ValueError(f"--voxel: expected a positive number, got {self.slam.voxel}")
        if self.format not in ("room", None) and self.data is None:
            raise ValueError(f"--format {self.format}: expected --data DIR with it")
        if self.format == "room" and self.data is not None:
            raise ValueError(f"--format room: expected no --data, as the room is made; got {self.data}")
        if self.room.along is not None and self.data is not None:
            raise ValueError(f"--room.along: expected no --data with it, got {self.data}")
        _room_config(self)


def resume_fingerprint(options: Options) -> dict[str, Any]:
    """The settings that a resumed run must share with the one it resumes, by the names of the options."""
    return {
        name: value
        for name, value in _flat(json.loads(atomic.json_text(options)))
        if name not in ("out", "name", "resume", "compare")
    }


def _flat(settings: dict[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, "" if name == "slam" else f"{within}{name}.")
        else:
            yield within + name, value


def slam_config(options: Options) -> SlamConfig:
    """How to track; with `--smoke` a field that compiles sooner, and a coarse map."""
    slam = options.slam
    if not options.smoke:
        return slam
    return replace(slam, field=replace(slam.field, layers=2, width=32), voxel=slam.voxel or 0.05)


class Source(NamedTuple):
    """A recording ready to be tracked, and where it comes from in words and numbers."""

    recording: Recording
    about: dict[str, Any]
    imu: str  # where the inertial readings come from


def load(options: Options) -> Source:
    """The recording that the options name: loaded or made, given an IMU if one is needed, cut and thinned.

    An IMU is simulated from the ground truth before frames are thinned, unless the recording has its own.
    Time starts at the first frame used. Raises DataError or OSError for what cannot be used.
    """
    if options.data is None:
        name, recording, own_imu = "room", room(_room_config(options)), options.room.along is not None
        noise = options.room.imu_noise
        imu = f"{options.room.imu_rate_hz:g} Hz, exact derivatives of the room's path, {_sheet(noise)}"
    else:
        name = rgbd_registry.find_format(options.data) if options.format in ("room", None) else options.format
        recording = rgbd_registry.load_recording(options.data, name, rate_hz=options.recorded_hz)
        if options.imu_file is not None and options.imu_extrinsics is not None:
            recording = with_imu(recording, options.imu_file, options.imu_extrinsics)
        imu, own_imu = "none", recording.imu is not None
        if not own_imu and (options.compare or options.slam.imu != "none"):
            recording = recording._replace(imu=_simulated(recording, options))
            imu = (
                f"simulated at {SIMULATED_HZ:g} Hz from ground truth before thinning (cubic spline "
                f"positions, "
                f"{options.imu_rotation} rotations, gravity along -z of the ground truth's frame), "
                f"{_sheet(options.slam.imu_noise)}, seed {options.slam.seed}"
            )
    if own_imu:
        recording, imu = _own_readings(recording, options)
    elif options.imu_filter or options.imu_offset_s:
        option = "--imu-filter" if options.imu_filter else "--imu-offset-s"
        raise DataError(f"{recording.name}: {option} expected a recording with its own IMU, got none")
    recorded = len(recording.t)
    recording = _cut(recording, options)
    if own_imu:
        _check_gravity(recording, options)
    about = {
        "name": recording.name,
        "format": name,
        "path": options.data,
        "frames_recorded": recorded,
        "start": options.start,
        "rate_hz": 1 / float(np.median(np.diff(recording.t))),
        "size": (recording.camera.width, recording.camera.height),
    }
    return Source(recording, about, imu)


def _room_config(options: Options) -> RoomConfig:
    """The room's settings, frames at the rate asked for; ValueError for settings that do not go together."""
    config = replace(options.room, rate_hz=options.rate_hz or options.room.rate_hz)
    if not options.smoke:
        return config
    duration_s = min(config.duration_s, (SMOKE_FRAMES - 1) / config.rate_hz)
    return replace(config, duration_s=duration_s, width=80, height=60)


def _sheet(noise: ImuNoise) -> str:
    """A data sheet in words."""
    if noise == QUIET:
        return "no noise"
    return "ADIS16448's noise" if noise == ADIS16448 else f"noise {noise}"


def _own_readings(recording: Recording, options: Options) -> tuple[Recording, str]:
    """The recording with its own readings as they are to be used, and what they are in words."""
    imu = recording.imu
    assert imu is not None
    imu = imu._replace(t=np.asarray(imu.t) + options.imu_offset_s)
    recording = recording._replace(imu=imu)
    if options.compare or options.slam.imu != "none":
        notes = imu_notes(recording, options.imu_file or recording.name)
        recording = recording._replace(notes=(*recording.notes, *notes))
    source = "the recording's own" if options.imu_file is None else f"of {options.imu_file.name}"
    what = f"{1 / float(np.median(np.diff(imu.t))):.3g} Hz, {source}, as read"
    if options.imu_offset_s:
        what += f", {options.imu_offset_s:+g} s"
    if options.imu_filter:
        imu = _unbiased(recording, imu, options)
        what += ", less the biases that a Kalman filter finds on the true poses"
    return recording._replace(imu=imu), what


def _unbiased(recording: Recording, imu: Imu, options: Options) -> Imu:
    """Readings less their biases by the error-state filter on the true poses (paper section 4.3)."""
    if recording.T_world_cam is None:
        raise DataError(f"{recording.name}: --imu-filter expected true poses, got none")
    ground_truth = recording.T_world_cam @ rigid.inverse(recording.T_body_cam)
    with jax.enable_x64(True):
        found = filter_imu(
            imu,
            recording.t,
            ground_truth,
            options.slam.imu_noise,
            _POSE_NOISE,
            gravity_world=tuple(recording.gravity_world.tolist()),
        )
    known = np.isfinite(found.gyro_bias).all(axis=1)
    return Imu(
        found.t[known],
        np.asarray(imu.omega_body)[known] - found.gyro_bias[known],
        np.asarray(imu.acceleration_body)[known] - found.accelerometer_bias[known],
    )


def _simulated(recording: Recording, options: Options) -> Imu:
    """Readings of an IMU at the camera, from the true poses."""
    ground_truth = recording.T_world_cam
    if ground_truth is None or np.isfinite(ground_truth).all(axis=(1, 2)).sum() < FEWEST_FRAMES:
        mode = "--compare" if options.compare else f"--imu {options.slam.imu}"
        raise DataError(
            f"{recording.name}: {mode} expected true poses to simulate an IMU from, got none; "
            "--imu none goes without"
        )
    return simulate_from_poses(
        recording.t,
        ground_truth @ rigid.inverse(recording.T_body_cam),
        SIMULATED_HZ,
        rotation=options.imu_rotation,
        noise=options.slam.imu_noise,
        key=jax.random.fold_in(jax.random.key(options.slam.seed), 200),
        gravity_world=recording.gravity_world,
    )


def _check_gravity(recording: Recording, options: Options) -> None:
    """Refuse real readings where nothing says which way is down: no true pose, and no gravity in them."""
    ground_truth = recording.T_world_cam
    if options.slam.imu == "none" and not options.compare:
        return
    if ground_truth is not None and np.isfinite(ground_truth[0]).all():
        return
    force, gravity = first_force(recording), np.linalg.norm(recording.gravity_world)
    if force is None or not is_gravity(force, recording.gravity_world):
        mode = "--compare" if options.compare else f"--imu {options.slam.imu}"
        got = "none there" if force is None else f"{np.linalg.norm(force):.3g}: check the units"
        raise DataError(
            f"{recording.name}: {mode} expected readings around frame {options.start}, which has no true "
            f"pose, whose mean is gravity's {gravity:.3g} m/s^2, got {got}; --imu none goes without"
        )


def _cut(recording: Recording, options: Options) -> Recording:
    """The frames asked for, thinned, on a clock that starts at the first of them."""
    count = len(recording.t)
    if options.start >= count:
        raise DataError(
            f"{recording.name}: expected --start below {count}, the frames it has, got {options.start}"
        )
    stop = count if options.frames is None else options.start + options.frames
    if stop > count:
        raise DataError(
            f"{recording.name}: expected --frames of at most {count - options.start}, those from --start "
            f"{options.start} on, got {options.frames}"
        )
    recording = select(recording, np.arange(options.start, stop))
    if options.rate_hz is not None:
        recording = thin(recording, options.rate_hz)
    if options.smoke:
        recording = select(recording, np.arange(min(len(recording.t), SMOKE_FRAMES)))
    if len(recording.t) < FEWEST_FRAMES:
        raise DataError(
            f"{recording.name}: expected at least {FEWEST_FRAMES} frames to track, got {len(recording.t)} "
            f"from frame {options.start} at {options.rate_hz or options.recorded_hz:g} Hz"
        )
    first, imu, ground_truth = recording.t[0], recording.imu, recording.T_world_cam
    accelerometer = recording.accelerometer
    notes = recording.notes
    if ground_truth is not None and np.isfinite(ground_truth).all(axis=(1, 2)).sum() < FEWEST_FRAMES:
        ground_truth, notes = (
            None,
            (*notes, "too few true poses among the frames used: there is no ground truth to compare with"),
        )
    return recording._replace(
        t=recording.t - first,
        imu=None if imu is None else imu._replace(t=np.asarray(imu.t) - first),
        accelerometer=None if accelerometer is None else accelerometer._replace(t=accelerometer.t - first),
        t0=recording.t0 + float(first),
        T_world_cam=ground_truth,
        notes=notes,
    )
