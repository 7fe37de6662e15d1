"""What lies beside a file of events: camera and true poses; and both with the events as a recording."""

from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.events.stream import Stream, Unit, check_numbers, inside, seconds
from jaxpose.datasets.events.validate import clean
from jaxpose.datasets.images import check_intrinsics, name_of
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.files.camera_json import read_camera
from jaxpose.files.tables import read_numbers
from jaxpose.files.trajectories import Trajectory, read_trajectory, since
from jaxpose.geometry.camera import Camera, pinhole_matrix

# Width and height of event cameras: DVS128, DAVIS240, ATIS, DAVIS346, VGA (Prophesee, DSEC), 720p.
_SENSORS = ((128, 128), (240, 180), (304, 240), (346, 260), (640, 480), (1280, 720))
_HELD = 0.99  # share of the events: a few may be false
_OFF_CENTRE = 0.15  # of the width or height
_CALIBRATION = "9 numbers (fx fy cx cy k1 k2 p1 p2 k3)"


class Source(NamedTuple):
    """Where the events of a recording are and the camera that saw them, before any event is read."""

    stream: Stream
    camera: Camera
    notes: tuple[str, ...] = ()  # what is assumed of the camera


def load_source(
    source: Source, ground_truth: Path, *, mosaic: Mosaic, unit: Unit | None, span: tuple[float, float] | None
) -> tuple[EventRecording, float]:
    """The events with their camera and the poses of a file, and time 0 on the clock of the files [s].

    Time 0 is the first event's timestamp; the poses are all those of `ground truth`, at their own timestamps,
    or none where there is no such file. Other arguments and errors as `clean` and `check_mosaic` say.
    """
    check_mosaic(mosaic)
    stream, camera, assumed = source
    events, stats, notes_on_events = clean(stream, (camera.width, camera.height), unit=unit, span=span)
    zero_s = seconds(stats)
    poses, lacking = _read_truth(ground_truth, zero_s, (float(events.t[0]), float(events.t[-1])))
    recording = EventRecording(
        name=name_of(ground_truth.parent),
        camera=camera,
        mosaic=mosaic,
        events=events,
        t=poses.t,
        T_world_cam=poses.T,
        notes=(*assumed, *notes_on_events, *lacking),
    )
    return recording, zero_s


def load_beside(
    source: Source, *, mosaic: Mosaic, unit: Unit | None, span: tuple[float, float] | None
) -> EventRecording:
    """What `load_source` makes of events with `poses.txt` in the folder of their file."""
    truth = source.stream.file.parent / "poses.txt"
    return load_source(source, truth, mosaic=mosaic, unit=unit, span=span)[0]


def check_mosaic(mosaic: str) -> None:
    """ValueError for a colour mosaic that is not known."""
    if mosaic not in get_args(Mosaic):
        raise ValueError(f"mosaic: expected {' or '.join(get_args(Mosaic))}, got {mosaic!r}")


def with_camera(stream: Stream, size: tuple[int, int] | None) -> Source:
    """A stream and the camera of `camera.json` or `calib.txt` in its folder.

    `camera.json` is a run's (`files.camera_json`). `calib.txt` is the event camera data set's, `fx fy cx
    cy k1 k2 p1 p2 k3`, with OpenCV's distortion. It does not have the size: that is what the file of
    events states, else `size` (width, height), else the smallest of the known sensors that holds 99% of
    the first events and has cx, cy within 15% of its middle. Without both files the focal length is taken
    to be as long as the sensor is wide.

    DataError for files that cannot be used, and for a `size` other than that of `camera.json` or the file's.
    """
    if size and stream.size and size != stream.size:
        got = f"{stream.size[0]}x{stream.size[1]}"
        raise DataError(f"{stream.file}: expected a sensor of {size[0]}x{size[1]}, got {got}")
    size = size or stream.size
    file, calibration = stream.file.parent / "camera.json", stream.file.parent / "calib.txt"
    if file.is_file():
        camera = read_camera(file).camera
        if size and size != (camera.width, camera.height):
            got = f"{camera.width}x{camera.height}"
            raise DataError(f"{file}: expected a camera of {size[0]}x{size[1]}, got {got}")
        return Source(stream, camera)
    K, lens = _read_calibration(calibration) if calibration.is_file() else (None, ())
    notes = []
    if size is None:
        size = _guess_size(stream, None if K is None else (K[0, 2], K[1, 2]))
        notes.append(f"size of the sensor taken as {size[0]}x{size[1]}, the smallest known that fits")
    width, height = size
    if K is None:
        notes.append(f"no calib.txt or camera.json: focal length taken as {width} px, no distortion")
        camera = Camera(width, width, 0.5 * (width - 1), 0.5 * (height - 1), width, height)
    else:
        camera = Camera(*check_intrinsics(calibration, K, size), width, height, lens)
    return Source(stream, camera, tuple(notes))


def _read_calibration(file: Path) -> tuple[Float[np.ndarray, "3 3"], tuple[float, ...]]:
    """Intrinsics, and the lens if it distorts."""
    numbers = read_numbers(file, _CALIBRATION, (9,))[1]
    if len(numbers) != 1:
        raise DataError(f"{file}: expected one line of {_CALIBRATION}, got {len(numbers)} lines")
    fx, fy, cx, cy, *lens = (float(number) for number in numbers[0])
    return pinhole_matrix(fx, fy, cx, cy), tuple(lens) if any(lens) else ()


def _guess_size(stream: Stream, centre: tuple[float, float] | None) -> tuple[int, int]:
    """The smallest known sensor that holds the first events and the centre; else as far as they reach."""
    block = next((block for block in stream.blocks() if len(block.t)), None)
    if block is None:
        raise DataError(f"{stream.file}: expected events, got none")
    check_numbers(stream, block, 0)
    for size in _SENSORS:
        off = [abs((c + 0.5) / s - 0.5) for c, s in zip(centre or (), size, strict=False)]
        if inside(block, size).mean() >= _HELD and max(off, default=0.0) <= _OFF_CENTRE:
            return size
    return max(int(block.x.max()), 0) + 1, max(int(block.y.max()), 0) + 1


def _read_truth(file: Path, zero_s: float, span: tuple[float, float]) -> tuple[Trajectory, tuple[str, ...]]:
    """All poses of a trajectory file on the clock of the events, and notes on it."""
    if not file.is_file():
        none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        return none, (f"no {file.name}: there is no ground truth to compare with",)
    found = read_trajectory(file)
    if not found.has_timestamps:
        raise DataError(f"{file}: expected poses with timestamps (TUM or EuRoC), got a {found.format} file")
    ground_truth, notes = found.trajectory, list(found.notes)
    t = since(ground_truth, round(zero_s * 1e9))
    if t[-1] < span[0] or t[0] > span[1]:
        notes.append(
            f"no true pose in the time of the events, {span[0]:.4g} to {span[1]:.4g} s: those of {file.name} "
            f"are from {t[0]:.4g} to {t[-1]:.4g} s, so the clocks may differ"
        )
    return Trajectory(t, ground_truth.T), tuple(notes)
