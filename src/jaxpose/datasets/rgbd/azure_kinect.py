"""Recordings of Azure Kinect (`.mkv` of k4arecorder): colour, depth, calibration and IMU in one file."""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import check_some_depth, found
from jaxpose.datasets.rgbd.azure_calibration import Calibration, read_calibration
from jaxpose.datasets.rgbd.pairs import nearest_pairs, unpaired_note
from jaxpose.datasets.rgbd.rational import pixel_rays, remapped, undistortion
from jaxpose.datasets.rgbd.registration import register_depth
from jaxpose.datasets.types import Frame, Recording
from jaxpose.datasets.video import Video, opened
from jaxpose.errors import DataError
from jaxpose.files.opening import open_file
from jaxpose.files.tables import seconds
from jaxpose.geometry.camera import Camera, resized
from jaxpose.imu import Imu

_HEAD_BYTES = 1 << 20  # of the file, in which k4arecorder writes its tags
_MATROSKA = b"\x1aE\xdf\xa3"
_SAMPLE = struct.Struct("<Q3fQ3f")  # k4arecord: accelerometer's time [ns] and reading, gyroscope's
_MOST_APART_S = 0.02  # between the timestamps of colour and depth
_SUFFIXES = (".mkv", ".mka")
_COARSER = 1.5  # times as wide as depth, from where on colour is made smaller


class _Tracks(NamedTuple):
    """Where the tracks are among those of a file, and what one pass over it finds."""

    numbers: dict[str, int]  # of the video tracks COLOR and DEPTH
    stamps: dict[str, list[int]]  # of their frames, in the file's units
    readings: list[tuple[int, bytes]]  # of the IMU: timestamps [ns], samples
    calibration: bytes


def detect(path: Path) -> bool:
    """Whether a path is a recording of Azure Kinect, or a folder with a single one.

    Args:
        path: A file or folder.

    Returns:
        Whether `load` should read it.
    """
    return len(_files(path)) == 1


def load(path: Path | str) -> Recording:
    """Read a recording of Azure Kinect's recorder. Needs the package av (extra `video`).

    Depth (mm) is registered to colour, which is made as wide as depth is, by the calibration in the file; the
    lenses are undone, so that the camera is a pinhole. Frames have the timestamps of colour. The IMU has the
    accelerometer's axes; the gyroscope is turned to them, and interpolated to its times. There is no ground
    truth. Modes and lens model are those of Microsoft's Azure-Kinect-Sensor-SDK.

    Args:
        path: The file, or a folder with a single one.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    files = _files(Path(path))
    if len(files) != 1:
        raise DataError(f"{path}: expected one recording of Azure Kinect (.mkv), got {found(Path(path))}")
    file = files[0]
    tracks = _pass_over(file)
    videos = {name: Video(file, tracks.numbers[name], tracks.stamps[name]) for name in ("COLOR", "DEPTH")}
    color, depth = videos["COLOR"], videos["DEPTH"]
    calibration = read_calibration(file, tracks.calibration, color.size, depth.size)
    of_color, of_depth = (seconds(video.ns, color.ns[0]) for video in (color, depth))
    rows, partners = nearest_pairs(str(file), of_color, of_depth, _MOST_APART_S)
    notes = unpaired_note("colour", "depth", [str(ns) for ns in color.ns], rows, _MOST_APART_S)
    notes += unpaired_note("depth", "colour", [str(ns) for ns in depth.ns], partners, _MOST_APART_S)
    check_some_depth(file, len(rows), lambda i: depth.counts(partners[i]), lambda i: f"frame {i}")
    camera, frame, seen = _view(calibration, color, depth)
    ns = [color.ns[row] for row in rows]
    imu, T_body_cam, sensed = _inertial(file, tracks.readings, calibration, ns[0])
    return Recording(
        name=file.stem,
        camera=camera,
        t=seconds(ns, ns[0]),
        read=lambda i: frame(rows[i], partners[i]),
        imu=imu,
        T_body_cam=T_body_cam,
        notes=(*notes, seen, *sensed, "no poses: there is no ground truth to compare with"),
        t0_ns=ns[0],
    )


def _files(path: Path) -> list[Path]:
    inner = sorted(path.glob("[!.]*")) if path.is_dir() else [path]
    return [file for file in inner if file.suffix.lower() in _SUFFIXES and file.is_file() and _is_ours(file)]


def _is_ours(file: Path) -> bool:
    with open_file(file) as stream:
        head = stream.read(_HEAD_BYTES)
    return head.startswith(_MATROSKA) and (b"K4A_" in head or b"k4arecord" in head)


def _pass_over(file: Path) -> _Tracks:
    with opened(file) as container:
        videos = {_title(stream): stream for stream in container.streams.video}
        others = {_title(stream): stream for stream in container.streams}
        attached = [s for s in container.streams if s.type == "attachment" and s.name == "calibration.json"]
        if not {"COLOR", "DEPTH"} <= videos.keys():
            got = ", ".join(filter(None, others)) or "tracks without names"
            raise DataError(f"{file}: expected tracks COLOR and DEPTH, got {got}")
        if not attached:
            raise DataError(f"{file}: expected calibration.json attached, got none")
        wanted = {name: videos[name] for name in ("COLOR", "DEPTH")}
        wanted |= {"IMU": others["IMU"]} if "IMU" in others else {}
        names = {stream.index: name for name, stream in wanted.items()}
        stamps: dict[str, list[int]] = {"COLOR": [], "DEPTH": []}
        readings = []
        for packet in container.demux(*wanted.values()):
            if packet.pts is None:
                continue
            name = names[packet.stream.index]
            if name == "IMU":
                readings.append((round(packet.pts * packet.time_base * 10**9), bytes(packet)))
            else:
                stamps[name].append(packet.pts)
        every = list(container.streams.video)
        numbers = {name: every.index(videos[name]) for name in stamps}
        return _Tracks(numbers, stamps, readings, bytes(attached[0].data))


def _title(stream: Any) -> str:
    return stream.metadata.get("title", "").upper()


def _view(calibration: Calibration, color: Video, depth: Video) -> tuple[Camera, Any, str]:
    """The camera of the frames, how one is made of colour i and depth j, and a note."""
    lens, of_depth = calibration.color, calibration.depth
    maps = undistortion(lens.camera, lens.coefficients)
    (width, height), (w, h) = color.size, depth.size
    camera = lens.camera
    if width > _COARSER * w:  # else most pixels of colour would stay without depth
        camera = resized(camera, w, round(w * height / width))
    rays = pixel_rays(of_depth.camera, of_depth.coefficients)
    register = register_depth(of_depth.camera, camera, calibration.T_color_depth, rays=rays)

    def frame(i: int, j: int) -> Frame:
        import cv2

        rgb, metres = remapped(color.read(i), maps), depth.counts(j).astype(np.float32) / np.float32(1000)
        if camera.width != width:
            size = (camera.width, camera.height)
            rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
        return Frame(rgb, register(metres))

    note = f"depth ({w}x{h}) registered to colour ({width}x{height}), both lenses undone"
    note += f", colour resized to {camera.width}x{camera.height}" if camera.width != width else ""
    return camera, frame, note


def _inertial(
    file: Path, readings: list[tuple[int, bytes]], calibration: Calibration, t0_ns: int
) -> tuple[Imu | None, Float[np.ndarray, "4 4"], tuple[str, ...]]:
    """Readings in the accelerometer's axes, T_body_cam, and notes."""
    if not readings:
        return None, np.eye(4), ("no IMU in the file",)
    if calibration.T_accelerometer_color is None:
        return None, np.eye(4), ("IMU left out: the calibration does not say where it is",)
    samples = []
    for _, data in readings:
        if len(data) != _SAMPLE.size:
            raise DataError(f"{file}: expected IMU samples of {_SAMPLE.size} bytes, got {len(data)}")
        samples.append(_SAMPLE.unpack(data))
    # Samples have the device's clock, of which the file's tracks take off when it began.
    began = int(np.median([sample[0] - at for (at, _), sample in zip(readings, samples, strict=True)]))
    kept = sorted({sample[0]: sample for sample in samples}.values())
    force = np.array([sample[1:4] for sample in kept], np.float64)
    t = seconds([sample[0] - began for sample in kept], t0_ns)
    gyro = sorted({sample[4]: sample for sample in samples}.values(), key=lambda sample: sample[4])
    rate = np.array([sample[5:] for sample in gyro], np.float64) @ calibration.R_accelerometer_gyro.T
    of_gyro = seconds([sample[4] - began for sample in gyro], t0_ns)
    if not (np.isfinite(force).all() and np.isfinite(rate).all()) or len(kept) < 2:
        raise DataError(f"{file}: expected finite readings of the IMU, got NaN, infinity or none")
    rate = np.stack([np.interp(t, of_gyro, axis) for axis in rate.T], axis=-1)
    lost = len(samples) - len(kept)
    notes = (f"{lost} readings of the IMU left out, of the timestamp of another",) if lost else ()
    return Imu(t, rate, force), calibration.T_accelerometer_color, notes
