"""What a loader returns: a recording with depth, photographs, or events, and what is known about them."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxpose._checks import check_increasing, check_shapes
from jaxpose.datasets.lens import Lens
from jaxpose.errors import DataError
from jaxpose.events import Events, Mosaic
from jaxpose.geometry.camera import Camera
from jaxpose.imu import GRAVITY_WORLD, Imu

_FARTHEST_M = 1000.0  # no sensor's depth; the least of millimetres that is taken for metres


def _read_only(array: np.ndarray) -> np.ndarray:
    """A default that all share: none can change it for the others."""
    array.flags.writeable = False
    return array


class Frame(NamedTuple):
    """One image pair; depth is along the optical axis [m], 0 where there is none."""

    rgb: np.ndarray  # (height, width, 3) uint8
    depth: np.ndarray  # (height, width) float32


class Accelerometer(NamedTuple):
    """Readings of an accelerometer without a gyroscope: they say which way is up, but it is no IMU."""

    t: Float[np.ndarray, " m"]  # [s]
    force_cam: Float[np.ndarray, "m 3"]  # [m/s^2] specific force, gravity in it, in the camera's axes


class Recording(NamedTuple):
    """A sequence of RGB-D frames with what is known about them; all poses float64, camera axes OpenCV.

    There is one clock: `t`, the IMU and the accelerometer are float64 seconds since `t0_ns`, which the loader
    takes off timestamps once, as whole nanoseconds.
    """

    name: str
    camera: Camera
    t: np.ndarray  # (n,) [s] of the frames, increasing
    read: Callable[[int], Frame]
    T_world_cam: np.ndarray | None = None  # (n, 4, 4) ground truth, rows of NaN where it is missing
    imu: Imu | None = None  # on the clock of `t`
    T_body_cam: np.ndarray = _read_only(np.eye(4))  # body = IMU
    gravity_world: np.ndarray = _read_only(np.array(GRAVITY_WORLD))  # in the frame of `T_world_cam`
    notes: tuple[str, ...] = ()  # notes of the loader for the user
    files: tuple[str, ...] = ()  # each colour image, relative to the recording's folder; empty: on no disk
    depth_files: tuple[str, ...] = ()  # likewise those of depth, where they are PNG of counts and no more
    depth_per_metre: float = 1000.0  # their counts
    t0_ns: int = 0  # where `t` is 0 on the clock of the recording's files [ns]
    accelerometer: Accelerometer | None = None  # on the clock of `t`, of a recording without IMU


class Photographs(NamedTuple):
    """Images of a scene at rest, in memory, with the poses that their source states; camera axes OpenCV."""

    name: str
    camera: Camera
    t: Float[np.ndarray, " n"]  # [s], or the frame index where there are no timestamps, as `notes` then says
    rgb: UInt8[np.ndarray, "n h w 3"]  # on white where the file had alpha
    T_world_cam: Float[np.ndarray, "n 4 4"]  # float64, finite; all NaN where no pose is known
    near: float  # depth along the optical axis at which the scene begins and ends [scene units]
    far: float
    spacing: Literal["depth", "disparity"]  # what samples between near and far are equally spaced in
    files: tuple[str, ...]  # each image's name, as its source writes it
    notes: tuple[str, ...] = ()  # notes of the loader for the user
    mask: Bool[np.ndarray, "n h w"] | None = None  # which pixels count; None: all
    lenses: tuple[Lens, ...] = ()  # of the image files as they are on disk; empty: they are on none
    turns: Float[np.ndarray, "n 3 3"] | None = None  # camera to world, where a gyroscope alone tells them


class EventRecording(NamedTuple):
    """Events of a moving camera with the poses known at some instants; camera axes OpenCV."""

    name: str
    camera: Camera
    mosaic: Mosaic
    events: Events
    t: Float[np.ndarray, " k"]  # [s] of the poses, on the clock of `events`, increasing
    T_world_cam: Float[np.ndarray, "k 4 4"]  # float64, finite
    threshold: float | None = None  # change of log intensity per event; None: the source does not say
    cyclic: bool = False  # whether the motion returns to where it began, as on a turntable
    frames: Photographs | None = None  # the camera's own images on the same clock, where it takes any
    held_out: Photographs | None = None  # views to measure a reconstruction on
    notes: tuple[str, ...] = ()  # notes of the loader for the user


def from_arrays(
    camera: Camera,
    t: Float[np.ndarray, " n"],
    rgb: UInt8[np.ndarray, "n h w 3"],
    depth: Float[np.ndarray, "n h w"],
    *,
    name: str = "arrays",
    T_world_cam: Float[np.ndarray, "n 4 4"] | None = None,
    imu: Imu | None = None,
    T_body_cam: Float[np.ndarray, "4 4"] | None = None,
) -> Recording:
    """A recording of frames that are in memory.

    Args:
        camera: Intrinsics of colour and depth, which are registered to each other.
        t: Times of the frames [s], increasing, on any clock: the recording's begins at the first.
        rgb: Colours.
        depth: Depth along the optical axis [m]; 0 where there is none.
        name: What reports call it.
        T_world_cam: Ground truth, where it is known; rows of NaN where it is not.
        imu: Readings on the clock of `t`: body rate [rad/s] and specific force [m/s^2], gravity in it.
        T_body_cam: Camera to IMU; by default the IMU is where the camera is.

    Returns:
        A recording for `slam.run`.

    Raises:
        ValueError: For arrays of other shapes or types, and times that do not increase.
    """
    t, rgb, depth = np.asarray(t, np.float64), np.asarray(rgb), np.asarray(depth)
    size = f"{camera.height} {camera.width}"
    check_shapes(t=(t, "n"), rgb=(rgb, f"n {size} 3"), depth=(depth, f"n {size}"))
    check_increasing(t=t)
    if len(t) == 0:
        raise ValueError("t: expected at least 1 frame, got none")
    check_frame(Frame(rgb[0], depth[0]), camera)
    if T_world_cam is not None:
        check_shapes(t=(t, "n"), T_world_cam=(T_world_cam, "n 4 4"))
    if T_body_cam is not None:
        check_shapes(T_body_cam=(T_body_cam, "4 4"))
    return Recording(
        name,
        camera,
        t - t[0],
        lambda i: Frame(rgb[i], depth[i]),
        T_world_cam=T_world_cam,
        imu=None if imu is None else imu._replace(t=np.asarray(imu.t, np.float64) - t[0]),
        T_body_cam=np.eye(4) if T_body_cam is None else T_body_cam,
        t0_ns=round(float(t[0]) * 1e9),
    )


def check_frame(frame: Frame, camera: Camera) -> Frame:
    """A frame as the library works with it, whoever made it.

    Args:
        frame: Colour (h, w, 3) uint8; depth (h, w) [m], of any floating type, 0, NaN or infinity where there
            is none.
        camera: Says how large both are.

    Returns:
        The frame, its depth float32 and 0 where there is none.

    Raises:
        ValueError: Naming what is of another shape or type, and for depth that is not in metres.

    >>> camera = Camera(1.0, 1.0, 0.0, 0.0, 2, 1)
    >>> check_frame(Frame(np.zeros((1, 2, 3), np.uint8), np.array([[900, 2350]], np.uint16)), camera)
    Traceback (most recent call last):
    ValueError: depth: expected metres, floating point, got uint16 up to 2350: divide millimetres by 1000.0
    """
    size, (rgb, depth) = (camera.height, camera.width), map(np.asarray, frame)
    if rgb.shape != (*size, 3) or rgb.dtype != np.uint8:
        raise ValueError(f"rgb: expected shape {(*size, 3)} of uint8, got {rgb.shape} of {rgb.dtype}")
    if depth.shape != size:
        raise ValueError(f"depth: expected shape {size}, got {depth.shape}")
    known = np.where(np.isfinite(depth), depth, 0) if depth.dtype.kind in "fiu" else depth
    if depth.dtype.kind != "f" or known.max() > _FARTHEST_M:
        got = f"{depth.dtype} up to {known.max():g}" if depth.dtype.kind in "fiu" else f"{depth.dtype}"
        raise ValueError(f"depth: expected metres, floating point, got {got}: divide millimetres by 1000.0")
    if known.min() < 0:
        raise ValueError(f"depth: expected 0 or more, got {known.min():g}")
    return Frame(rgb, known.astype(np.float32))


def select(recording: Recording, indices: np.ndarray) -> Recording:
    """The recording reduced to some of its frames; the clock (and so the IMU) stays as it is.

    Args:
        recording: Of n frames.
        indices: Which of them (m,), in the order given.

    Returns:
        A recording of m frames.

    Raises:
        ValueError: For what are no indices of its frames.
    """
    _check_indices(indices, len(recording.t))
    poses = recording.T_world_cam
    return recording._replace(
        t=recording.t[indices],
        read=lambda i: recording.read(int(indices[i])),
        T_world_cam=None if poses is None else poses[indices],
        files=tuple(recording.files[i] for i in indices) if recording.files else (),
        depth_files=tuple(recording.depth_files[i] for i in indices) if recording.depth_files else (),
    )


def thin(recording: Recording, rate_hz: float) -> Recording:
    """Keep frames so that their rate is at most `rate_hz`, the first of each period.

    Args:
        recording: Of n frames.
        rate_hz: Frames a second.

    Returns:
        The recording reduced to them.

    Raises:
        ValueError: For a rate that is not positive.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
    period = np.floor((recording.t - recording.t[0]) * rate_hz + 1e-6).astype(int)
    return select(recording, np.flatnonzero(np.diff(period, prepend=-1) > 0))


def prefetch(recording: Recording) -> Recording:
    """The recording whose next frame is read in a thread while one is worked on.

    Args:
        recording: Of frames that are mostly read one after the other.

    Returns:
        The same; all of its frames are read in that one thread.
    """
    worker = ThreadPoolExecutor(1, "frames")
    ahead: dict[int, Future[Frame]] = {}

    def read(i: int) -> Frame:
        asked = ahead.pop(i, None) or worker.submit(recording.read, i)
        for other in ahead.values():
            other.cancel()
        ahead.clear()
        frame = asked.result()
        if i + 1 < len(recording.t):
            ahead[i + 1] = worker.submit(recording.read, i + 1)
        return frame

    return recording._replace(read=read)


def take(photographs: Photographs, indices: Int[np.ndarray, " m"]) -> Photographs:
    """Some of the photographs; the clock stays as it is.

    Args:
        photographs: n of them.
        indices: Which of them (m,), in the order given.

    Returns:
        m photographs.

    Raises:
        ValueError: For what are no indices of the photographs.
    """
    _check_indices(indices, len(photographs.t))
    return photographs._replace(
        t=photographs.t[indices],
        rgb=photographs.rgb[indices],
        T_world_cam=photographs.T_world_cam[indices],
        files=tuple(photographs.files[i] for i in indices),
        mask=None if photographs.mask is None else photographs.mask[indices],
        lenses=tuple(photographs.lenses[i] for i in indices) if photographs.lenses else (),
        turns=None if photographs.turns is None else photographs.turns[indices],
    )


def every(photographs: Photographs, n: int) -> Photographs:
    """Every n-th photograph, beginning with the first.

    Args:
        photographs: To choose from.
        n: 1 for all.

    Returns:
        At least two photographs.

    Raises:
        ValueError: For n below 1.
        DataError: Where fewer than two photographs would be left.
    """
    if n < 1:
        raise ValueError(f"every: expected a step of at least 1, got {n}")
    indices = np.arange(0, len(photographs.t), n)
    if len(indices) < 2:
        raise DataError(
            f"{photographs.name}: expected at least 2 images, got {len(indices)}"
            f" (every {n}. of {len(photographs.t)})"
        )
    return take(photographs, indices)


def _check_indices(indices: np.ndarray, count: int) -> None:
    check_shapes(indices=(indices, "m"))
    if len(indices) and (indices.dtype.kind not in "iu" or not 0 <= indices.min() <= indices.max() < count):
        got = indices.dtype if indices.dtype.kind not in "iu" else f"{indices.min()} to {indices.max()}"
        raise ValueError(f"indices: expected whole numbers from 0 to {count - 1}, got {got}")
