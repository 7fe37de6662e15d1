"""What lies beside a file of events: camera and true poses; and both with the events as a recording."""

from pathlib import Path
from typing import get_args

import numpy as np

from jaxpose.camera import Camera
from jaxpose.data.event_clean import clean
from jaxpose.data.event_stream import Stream, Unit, seconds
from jaxpose.data.images import check_intrinsics, name_of
from jaxpose.errors import DataError
from jaxpose.events import Mosaic
from jaxpose.io import Trajectory, read_numbers
from jaxpose.io_camera import read_camera
from jaxpose.io_trajectory import read_trajectory
from jaxpose.recording import EventRecording

# Width and height of event cameras: DVS128, DAVIS240, ATIS, DAVIS346, VGA (Prophesee, DSEC), 720p.
_SENSORS = ((128, 128), (240, 180), (304, 240), (346, 260), (640, 480), (1280, 720))
_CALIBRATION = "9 numbers (fx fy cx cy k1 k2 p1 p2 k3)"


def load_stream(
    stream: Stream,
    truth: Path,
    *,
    mosaic: Mosaic,
    size: tuple[int, int] | None,
    unit: Unit | None,
    span: tuple[float, float] | None,
) -> tuple[EventRecording, float]:
    """Events with the camera and the poses of their folder, and time 0 on the clock of the files [s].

    Time 0 is the first event's stamp; the poses are all those of the file `truth`, at their own stamps, none
    where there is no such file. Other arguments and errors as `clean`, `find_camera` and `check_mosaic` say.
    """
    check_mosaic(mosaic)
    camera, assumed = find_camera(stream, size)
    events, tally, told = clean(stream, (camera.width, camera.height), unit=unit, span=span)
    zero_s = seconds(tally)
    poses, lacking = _read_truth(truth, zero_s, (float(events.t[0]), float(events.t[-1])))
    recording = EventRecording(
        name=name_of(truth.parent),
        camera=camera,
        mosaic=mosaic,
        events=events,
        t=poses.t,
        T_world_cam=poses.T,
        notes=(*assumed, *told, *lacking),
    )
    return recording, zero_s


def check_mosaic(mosaic: str) -> None:
    """ValueError for a colour mosaic that is not known."""
    if mosaic not in get_args(Mosaic):
        raise ValueError(f"mosaic: expected {' or '.join(get_args(Mosaic))}, got {mosaic!r}")


def find_camera(stream: Stream, size: tuple[int, int] | None) -> tuple[Camera, tuple[str, ...]]:
    """The camera of `camera.json` or `calib.txt` beside a file of events, and notes on what is assumed.

    `camera.json` is a run's (`io_camera`). `calib.txt` is the event camera data set's, `fx fy cx cy k1 k2 p1
    p2 k3`, with the lens as OpenCV has it. It does not tell the size: that is `size` (width, height), else
    of the known sensors the one whose centre is nearest to cx, cy. Without both files it is the smallest
    sensor that holds the first events, and the focal length is taken to be as long as it is wide.

    DataError for files that cannot be used, and for a `size` that is not that of `camera.json`.
    """
    folder = stream.file.parent
    if (folder / "camera.json").is_file():
        camera = read_camera(folder / "camera.json").camera
        if size and size != (camera.width, camera.height):
            raise DataError(
                f"{folder / 'camera.json'}: expected a camera of {size[0]}x{size[1]}, "
                f"got {camera.width}x{camera.height}"
            )
        return camera, ()
    file = folder / "calib.txt"
    if file.is_file():
        numbers = read_numbers(file, _CALIBRATION, (9,))[1]
        if len(numbers) != 1:
            raise DataError(f"{file}: expected one line of {_CALIBRATION}, got {len(numbers)} lines")
        fx, fy, cx, cy, *lens = (float(number) for number in numbers[0])
        given = size
        if size is None:
            size = min(_SENSORS, key=lambda s: np.hypot(0.5 * (s[0] - 1) - cx, 0.5 * (s[1] - 1) - cy))
        pinhole = check_intrinsics(file, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), size)
        told = (
            f"size of the sensor taken as {size[0]}x{size[1]}, whose centre is nearest to that of {file.name}"
        )
        return Camera(*pinhole, *size, tuple(lens) if any(lens) else ()), () if given else (told,)
    notes = []
    if size is None:
        size = _smallest(stream)
        notes.append(
            f"size of the sensor taken as {size[0]}x{size[1]}, the smallest that holds the first events"
        )
    width, height = size
    notes.append(f"no calib.txt or camera.json: focal length taken as {width} px, no distortion")
    return Camera(width, width, 0.5 * (width - 1), 0.5 * (height - 1), width, height), tuple(notes)


def _smallest(stream: Stream) -> tuple[int, int]:
    """The smallest known sensor that holds the first events; if none does, one as large as they reach."""
    block = next((block for block in stream.blocks() if len(block.t)), None)
    if block is None:
        raise DataError(f"{stream.file}: expected events, got none")
    width, height = int(block.x.max()) + 1, int(block.y.max()) + 1
    holding = (s for s in _SENSORS if s[0] >= width and s[1] >= height)
    return next(holding, (max(width, 1), max(height, 1)))


def _read_truth(file: Path, zero_s: float, span: tuple[float, float]) -> tuple[Trajectory, tuple[str, ...]]:
    """All poses of a trajectory file on the clock of the events, and notes on it."""
    if not file.is_file():
        none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        return none, (f"no {file.name}: there is no truth to compare with",)
    truth, form, stamped, repeated = read_trajectory(file)
    if not stamped:
        raise DataError(f"{file}: expected poses with stamps (TUM or EuRoC), got a {form} file")
    t = truth.t - zero_s
    notes = []
    if repeated:
        notes.append(f"{repeated} lines of {file.name} repeat the stamp before them and are ignored")
    if t[-1] < span[0] or t[0] > span[1]:
        notes.append(
            f"no true pose in the time of the events, {span[0]:.4g} to {span[1]:.4g} s: those of {file.name} "
            f"are from {t[0]:.4g} to {t[-1]:.4g} s, so the clocks may differ"
        )
    return Trajectory(t, truth.T), tuple(notes)
