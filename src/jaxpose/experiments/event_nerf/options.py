"""Options of the event experiment, and the events and inexact poses that they name."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from jaxpose.datasets.events import registry as event_registry
from jaxpose.datasets.synthetic import event_orbit
from jaxpose.datasets.synthetic.orbit import DIAMETER, FAR, NEAR
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Events, Mosaic, dead_time_s, hot_pixels, threshold_spread
from jaxpose.events.contrast import find_displacement
from jaxpose.events.ray_contrast import LEAST, find_turn_deg
from jaxpose.experiments.checks import check_least, check_positive, check_run_folder, check_unused
from jaxpose.experiments.devices import DeviceConfig, Precision, check_devices
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.experiments.training_loop import CHUNK, NetConfig, pose_reader
from jaxpose.fields import piecewise_geodesic
from jaxpose.files.trajectories import Trajectory
from jaxpose.training.events import Loss
from jaxpose.training.photometric import Depths

Pose = Literal["posenet", "linear"]
Study = Literal["known", "offset"]
ORBIT = Path("orbit")
_WIDTH, _SMOKE_WIDTH, _SMOKE_POSES = 100, 16, 60
_KNOWN = 10
_STUDY_KNOWN = (20, 10, 6)  # table 4
_STUDY_OFFSETS_DEG = (1.0, 2.0, 2.85)  # EventNeRF reports up to 2.85 on real turntables

# The options of the first screen of help.
GROUPS = {
    "data": ("data", "threshold"),
    "poses": ("poses", "known", "axis_offset_deg", "pose"),
    "training": ("preset", "steps", "seed", "study"),
    "run": ("out", "name", "resume", "smoke", "json"),
}


@dataclass(frozen=True)
class Config:
    """Settings of a run; the events and these are all that a result depends on."""

    # A folder or file of events (EventNeRF, DAVIS text, HDF5, npz); "orbit": a turntable made on the fly.
    data: Path = ORBIT
    pose: Pose = "posenet"  # the trajectory is refined by a PoseNet, or stays as it starts
    loss: Loss = "asynchronous"  # each event at its own time, or EventNeRF's windows
    # A small network for CPUs, or the sizes of EventNeRF and the paper.
    preset: Literal["fast", "paper"] = "fast"
    # "unknown": nothing is known of the poses; the start is the steady slide along the image that makes the
    # events sharpest, so that the recording must be short, and lengths are in typical depths.
    poses: Literal["known", "unknown"] = "known"
    # Instants at which positions are known, straight lines between; orientations are kept. None: all that the
    # data have; the orbit's default is 10, unless its axis is wrong.
    known: int | None = None
    axis_offset_deg: float = 0.0  # the turntable's axis, as the camera sees it, is wrong by this
    threshold: float | None = None  # change of log intensity per event; None: what the data tell, or 0.25
    mosaic: Mosaic | None = None  # the sensor's colours; None: what the data tell
    image_width: int | None = None  # [px] of the orbit's sensor; None: 100
    seed: int = 0  # of the orbit's paint and noise, the network's start, the events drawn
    steps: int | None = None  # None: 3000, with preset paper 200,000
    events: int | None = None  # per step; None: 512, with preset paper 1024
    net: NetConfig = NetConfig()
    # Of products in the scene's network on a GPU; a CPU has float32 alone. Poses are float32 in any case.
    precision: Precision = "tensorfloat32"
    devices: DeviceConfig = DeviceConfig()
    study: Study | None = None  # table 4 (known: 20, 10 and 6 instants), or offsets, both fields side by side
    resume: bool = False  # go on where a killed run stopped
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    out: Path | None = None  # exactly this folder; None: outputs/event_nerf/<name or timestamp>
    name: str | None = None  # of the folder within outputs/event_nerf
    json: bool = False  # print the results as JSON and nothing else

    def __post_init__(self):
        check_least(self, known=2, axis_offset_deg=0, seed=0, image_width=8, steps=CHUNK, events=1)
        check_positive(self, "threshold")
        if self.axis_offset_deg >= 45:
            raise ValueError(f"--axis-offset-deg: expected less than 45, got {self.axis_offset_deg:g}")
        if self.steps is not None and self.steps % CHUNK:
            raise ValueError(f"--steps: expected a multiple of {CHUNK}, got {self.steps}")
        if self.poses == "unknown" and (self.known is not None or self.axis_offset_deg):
            raise ValueError("--poses unknown: expected neither --known nor --axis-offset-deg with it")
        if self.poses == "unknown" and self.data == ORBIT:
            raise ValueError("--poses unknown: expected --data with a short recording, got the orbit")
        check_run_folder(self, None if self.data == ORBIT else self.data)
        check_devices(self)
        if self.data != ORBIT:
            check_unused(self, ("image_width",), "with --data")
        if self.pose != "posenet" and self.study is None:
            check_unused(
                self, [f"net.{name}" for name in self.net.__dataclass_fields__], f"with --pose {self.pose}"
            )


# What a run's numbers do not depend on.
_INCIDENTAL = ("devices", "resume", "out", "name", "study", "json")


def resume_fingerprint(config: Config) -> dict[str, Any]:
    """The settings that a resumed run must share with the one it resumes."""
    return {f.name: getattr(config, f.name) for f in fields(config) if f.name not in _INCIDENTAL}


class Problem(NamedTuple):
    """Events, and stamped poses that the training starts from."""

    recording: EventRecording
    start: Trajectory
    span: tuple[float, float]  # [s] events are used, and poses asked for
    threshold: float
    depths: Depths
    background: float | None
    extent: float  # how far the camera moves [scene units]
    slides: bool  # whether nothing is known but that it slides
    turn_deg: float | None  # of all cameras about their own y axes, as events tell; None: not looked for
    metadata: dict[str, Any]  # the data and what is wrong with the poses, in words and numbers


def load(config: Config) -> Problem:
    """The events, and the poses to start from: `begin` with what `read` has read."""
    return begin(config, read(config))


def read(config: Config) -> EventRecording:
    """Read or make the events. DataError or OSError for what cannot be used."""
    if config.data == ORBIT:
        width = _SMOKE_WIDTH if config.smoke else config.image_width or _WIDTH
        poses = _SMOKE_POSES if config.smoke else 1000
        return event_orbit.event_orbit(width, config.seed, poses=poses, mosaic=config.mosaic or "rggb")
    return _without_hot_pixels(event_registry.load_events(config.data, mosaic=config.mosaic))


def _without_hot_pixels(recording: EventRecording) -> EventRecording:
    """The recording without events of pixels that never rest, which are counted."""
    events, camera = recording.events, recording.camera
    hot = hot_pixels(events, camera.height, camera.width)
    left_out = hot[events.y, events.x]
    if not left_out.any():
        return recording
    note = f"{int(hot.sum())} hot pixels, their {int(left_out.sum())} events are left out"
    kept = Events(*(column[~left_out] for column in events))
    return recording._replace(events=kept, notes=(*recording.notes, note))


def _sensor(recording: EventRecording) -> dict[str, float | None]:
    """What events tell of the sensor, in numbers."""
    camera, events = recording.camera, recording.events
    spread = threshold_spread(events, camera.height, camera.width) if recording.cyclic else None
    return {"dead_time_s": dead_time_s(events), "threshold_spread": spread}


def begin(config: Config, recording: EventRecording, on_update: OnUpdate = silent) -> Problem:
    """What of the recording's poses the training is told. DataError where it cannot be told."""
    orbiting = config.data == ORBIT
    if len(recording.events.t) == 0:
        raise DataError(f"{config.data}: expected events, got none")
    began = _unknown(recording) if config.poses == "unknown" else _known(config, recording, orbiting)
    t = recording.events.t
    span = float(max(t[0], began.start.t[0])), float(min(t[-1], began.start.t[-1]))
    if not span[0] < span[1]:
        raise DataError(
            f"{config.data}: expected poses during the events, 0 to {t[-1]:.4g} s, got some from "
            f"{began.start.t[0]:.4g} to {began.start.t[-1]:.4g} s"
        )
    camera = recording.camera
    turn_deg = None
    if _may_be_turned(config, recording):
        on_update(Update("looking for the turntable's axis"))
        turn_deg = _turn_deg(recording, began)
    metadata = {
        "data": "synthetic orbit with events" if orbiting else recording.name,
        "events": len(recording.events.t),
        "span_s": float(np.ptp(recording.events.t)),
        "size": (camera.width, camera.height),
        "mosaic": recording.mosaic,
        "extent": began.extent,
        "poses": began.words,
        "turned_by_deg": turn_deg,
        "sensor": _sensor(recording),
        "notes": recording.notes,
    }
    threshold = config.threshold or recording.threshold or 0.25
    background = event_orbit.BACKGROUND if recording.cyclic else None  # EventNeRF's, for its turntables
    return Problem(
        recording,
        began.start,
        span,
        threshold,
        began.depths,
        background,
        began.extent,
        config.poses == "unknown",
        turn_deg,
        metadata,
    )


def known_instants(config: Config) -> int | None:
    """At how many instants positions are known; None: at all of the data's."""
    if config.known is None and config.data == ORBIT and not config.axis_offset_deg:
        return _KNOWN
    return config.known


def on_turntable(config: Config, recording: EventRecording) -> bool:
    """Whether all positions are known, and the axis, as the camera sees it, may be wrong."""
    every = config.poses == "known" and known_instants(config) is None
    return every and (recording.cyclic or config.axis_offset_deg > 0)


def _may_be_turned(config: Config, recording: EventRecording) -> bool:
    """Whether a turn that all cameras share is looked for before poses are refined."""
    doubted = on_turntable(config, recording) or config.axis_offset_deg > 0
    return doubted and config.pose == "posenet" and len(recording.events.t) >= LEAST


def _turn_deg(recording: EventRecording, began: "_Began") -> float:
    """How far all cameras are to be turned about their own y axes, so that rays of events meet."""
    start = piecewise_geodesic(*(jnp.asarray(x, jnp.float32) for x in began.start[:2]))
    poses = lambda t: pose_reader(start, t)({})
    return find_turn_deg(recording.camera, recording.events, poses, began.depths[:2])


class _Began(NamedTuple):
    """Where a training starts, and how large the scene is."""

    start: Trajectory
    depths: Depths
    extent: float
    words: str


def _unknown(recording: EventRecording) -> _Began:
    """The slide that makes events sharpest, from the middle of the time at the world's origin."""
    slide = find_displacement(recording.camera, recording.events)
    ends = recording.events.t[[0, -1]]
    T_start = np.tile(np.eye(4), (2, 1, 1))
    T_start[:, :3, 3] = (ends - ends.mean())[:, None] * slide.velocity
    depths = 1 / slide.inverse_depth
    x, y, _ = slide.velocity
    words = (
        f"poses unknown: starts as a steady slide of ({x:.3g}, {y:.3g}) typical depths a second, by contrast"
    )
    return _Began(
        Trajectory(ends, T_start),
        Depths(0.6 * float(depths.min()), 2 * float(depths.max()), "disparity"),
        float(np.linalg.norm(T_start[1, :3, 3] - T_start[0, :3, 3])),
        words,
    )


def _known(config: Config, recording: EventRecording, orbiting: bool) -> _Began:
    """The recording's poses with what is said to be wrong with them."""
    if len(recording.t) < 2:
        raise DataError(
            f"{config.data}: expected poses at 2 instants or more, or --poses unknown, got {len(recording.t)}"
        )
    known = known_instants(config)
    if known is not None and known > len(recording.t):
        raise DataError(f"--known: expected at most the {len(recording.t)} poses of the data, got {known}")
    T_start, words = _inexact(recording, known, config.axis_offset_deg)
    centres = recording.T_world_cam[:, :3, 3]
    extent = DIAMETER if orbiting else float(pdist(centres[:: max(1, len(centres) // 200)]).max())
    if orbiting:
        depths = Depths(NEAR, FAR)
    elif recording.held_out is not None:
        depths = Depths(recording.held_out.near, recording.held_out.far)
    else:  # EventNeRF's rule: the scene lies in the unit sphere about the world's origin
        distance = np.linalg.norm(centres, axis=1)
        depths = Depths(max(distance.min() - 1, 0.05 * distance.min()), distance.max() + 1)
    return _Began(Trajectory(recording.t, T_start), depths, extent, words)


def _inexact(
    recording: EventRecording, known: int | None, offset_deg: float
) -> tuple[Float[np.ndarray, "k 4 4"], str]:
    """The recording's poses with positions on straight lines between known ones, about a wrong axis."""
    ground_truth, t = recording.T_world_cam, recording.t
    T_start, words = ground_truth.copy(), [f"known at all {len(t)} instants"]
    if known is not None:
        at = np.round(np.linspace(0, len(t) - 1, known + recording.cyclic)).astype(int)
        for axis in range(3):
            T_start[:, axis, 3] = np.interp(t, t[at], ground_truth[at, axis, 3])
        words = [f"positions known at {known} instants, linear between, orientations kept"]
    if offset_deg:
        # All that a camera knows of a turntable is where it sees the axis: turned about its own y axis.
        T_start[:, :3, :3] = (
            T_start[:, :3, :3] @ Rotation.from_euler("y", offset_deg, degrees=True).as_matrix()
        )
        words.append(f"axis wrong by {offset_deg:g} degrees about the camera's y axis")
    return T_start, ", ".join(words)


def studies(config: Config, study: Study) -> dict[str, Config]:
    """Runs side by side, each with a PoseNet and with the trajectory left as it starts.

    Args:
        config: what they share.
        study: "known": 20, 10 and 6 known instants (table 4); "offset": axes that are wrong.

    Returns:
        The config of each run, by its label.
    """
    if study == "known":
        changes = {f"known{known}": {"known": known} for known in _STUDY_KNOWN}
    else:
        changes = {
            f"offset{offset:.2f}".replace(".", "_"): {"axis_offset_deg": offset}
            for offset in _STUDY_OFFSETS_DEG
        }
    return {
        f"{label}_{pose}": replace(config, study=None, pose=pose, **change)
        for label, change in changes.items()
        for pose in ("linear", "posenet")
    }
