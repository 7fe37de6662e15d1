"""A recording written as a folder of image files: plain, TUM's or EuRoC's."""

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.datasets.images import INTRINSICS, image_size
from jaxpose.datasets.rgbd.rational import remapped, undistortion
from jaxpose.datasets.types import Frame, Recording, prefetch
from jaxpose.errors import DataError
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.files.atomic import write_json, write_text
from jaxpose.files.tables import format_rows
from jaxpose.files.timestamps import format_ns, whole_ns
from jaxpose.files.trajectories import Trajectory, write_euroc, write_tum
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import pinhole_matrix
from jaxpose.imu import ADIS16448, GRAVITY_WORLD

_MOST = 65534  # counts of depth; 65535 means none
_PER_METRE = {"plain": 1000.0, "tum": 5000.0, "euroc": 1000.0}
_IMU_HEAD = "#timestamp [ns]," + ",".join(
    f"{name}_RS_S_{axis} [{unit}]" for name, unit in (("w", "rad s^-1"), ("a", "m s^-2")) for axis in "xyz"
)


class _Copy(NamedTuple):
    """How the frames of a recording become files."""

    recording: Recording
    folder: Path  # that the names of its files are relative to
    ns: list[int]
    colors: list[Path]  # of the recording, which are copied as they are; empty: none
    depths: list[Path]  # likewise
    per_metre: float  # counts of depth in the copy
    notes: list[str]


def write_recording(
    out: Path, recording: Recording, source: Path, to: str, on_update: OnUpdate
) -> tuple[tuple[int, int, int], tuple[str, ...]]:
    """Write a recording as a folder.

    Args:
        out: The folder, which must not be there, or be empty.
        recording: With its poses and IMU.
        source: The path that it was read from.
        to: "plain", "tum" or "euroc".
        on_update: Called with what is being done.

    Returns:
        How many frames, poses and readings there are, and notes.

    Raises:
        DataError: For a folder that holds something, for frames that cannot be read, and for a recording
            without an IMU, which EuRoC's layout needs.
    """
    if to == "euroc" and recording.imu is None:
        raise DataError(f"{source}: expected a recording with an IMU for --to euroc, got none: --to plain")
    recording, notes = _upright(recording)
    if to == "tum" and recording.camera.distortion:
        recording = _without_distortion(recording)
        notes.append("the lens is undone in the images, as TUM's layout has none")
    copy = _plan(recording, source, to, notes)
    poses = 0 if recording.T_world_cam is None else int(np.isfinite(recording.T_world_cam).all((1, 2)).sum())
    with _unfinished(out) as folder:
        _WRITERS[to](folder, copy, on_update)
    readings = 0 if recording.imu is None else len(recording.imu.t)
    if readings and to != "euroc":
        notes.append(f"for the IMU: --imu-file {out / 'imu.csv'} --imu-extrinsics {out / 'sensor.yaml'}")
    return (len(copy.ns), poses, readings), tuple(notes)


@contextmanager
def _unfinished(out: Path) -> Iterator[Path]:
    """A folder that takes the place of `out` when the block ends, and is gone if it fails."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise DataError(f"{out}: expected a folder that is not there yet, or is empty, got one with files")
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = out.parent / f".{out.name}.unfinished"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        folder.mkdir()
        yield folder
        if out.exists():
            out.rmdir()
        folder.rename(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _upright(recording: Recording) -> tuple[Recording, list[str]]:
    """The recording in a world whose z is up, as the formats have it."""
    gravity = np.asarray(recording.gravity_world, np.float64)
    down = gravity / np.linalg.norm(gravity)
    if recording.T_world_cam is None or np.abs(down - [0, 0, -1]).max() < 1e-9:
        return recording, []
    turn = Rotation.align_vectors([0.0, 0.0, -1.0], down)[0].as_matrix()  # the shortest way
    T = rigid.make(turn, np.zeros(3)) @ recording.T_world_cam
    note = "the world of the poses is turned so that z points up"
    return recording._replace(T_world_cam=T, gravity_world=np.array(GRAVITY_WORLD)), [note]


def _without_distortion(recording: Recording) -> Recording:
    """The recording as a pinhole sees it."""
    camera = recording.camera._replace(distortion=())
    maps = undistortion(camera, np.array(recording.camera.distortion))

    def read(i: int) -> Frame:
        rgb, depth = recording.read(i)
        return Frame(remapped(rgb, maps), remapped(depth, maps))

    return recording._replace(camera=camera, read=read, files=(), depth_files=())


def _plan(recording: Recording, source: Path, to: str, notes: list[str]) -> _Copy:
    """Which images are copied, and in what unit depth is."""
    size = (recording.camera.width, recording.camera.height)
    colors = [source / name for name in recording.files]
    if colors and image_size(colors[0]) != size:
        colors = []
    depths, per_metre = [source / name for name in recording.depth_files], _PER_METRE[to]
    if depths and to == "plain":
        per_metre = recording.depth_per_metre
    if depths and per_metre != recording.depth_per_metre:
        depths = []
    ns = whole_ns(recording.t, recording.t0_ns)
    return _Copy(prefetch(recording), source, ns, colors, depths, per_metre, notes)


def _images(
    copy: _Copy, on_update: OnUpdate, stems: list[str], color: Path, depth: Path
) -> tuple[list[str], list[str]]:
    """Write or copy the images of all frames into two folders; the names of their files."""
    color.mkdir(parents=True)
    depth.mkdir(parents=True)
    suffixes = [file.suffix for file in copy.colors] or [".png"] * len(stems)
    names = [stem + suffix for stem, suffix in zip(stems, suffixes, strict=True)]
    depth_names = [f"{stem}.png" for stem in stems]
    lost = rounded = 0.0
    for i, (name, depth_name) in enumerate(zip(names, depth_names, strict=True)):
        on_update(Update(f"writing frame {i + 1} of {len(stems)}"))
        for files, place in ((copy.colors, color / name), (copy.depths, depth / depth_name)):
            if files:
                shutil.copyfile(files[i], place)
        if copy.colors and copy.depths:
            continue
        frame = copy.recording.read(i)
        if not copy.colors:
            Image.fromarray(frame.rgb).save(color / name, compress_level=1)
        if not copy.depths:
            exact = frame.depth.astype(np.float64) * copy.per_metre
            counts = np.rint(exact)
            beyond = counts > _MOST
            lost += int(beyond.sum())
            rounded = max(rounded, float(np.abs(counts - exact)[~beyond].max(initial=0)))
            pixels = np.where(beyond, 0, counts).astype(np.uint16)
            Image.fromarray(pixels).save(depth / depth_name, compress_level=1)
    if lost:
        copy.notes.append(
            f"{lost:.0f} pixels beyond {_MOST / copy.per_metre:.4g} m have no depth in the copy"
        )
    if rounded > 0.01:
        copy.notes.append(f"depth is rounded to {1000 / copy.per_metre:g} mm")
    return names, depth_names


def _list(file: Path, head: str, lines: Iterable[tuple[str, str]], mark: str) -> None:
    """A list of timestamps and files."""
    write_text(file, f"#{head}\n" + "".join(f"{stamp}{mark}{name}\n" for stamp, name in lines))


def _plain(folder: Path, copy: _Copy, on_update: OnUpdate) -> None:
    stems = [f"{i:06d}" for i in range(len(copy.ns))]
    _images(copy, on_update, stems, folder / "color", folder / "depth")
    camera, recording = copy.recording.camera, copy.recording
    content: dict[str, Any] = {
        key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")
    }
    content["depth_scale"] = copy.per_metre
    if camera.distortion:
        content["distortion"] = camera.distortion
    write_json(folder / "intrinsics.json", content)
    write_text(folder / "times.txt", "".join(f"{format_ns(ns)}\n" for ns in copy.ns))
    if recording.T_world_cam is not None:
        write_text(folder / "poses.txt", format_rows(recording.T_world_cam.reshape(-1, 16)))
    _imu(folder / "imu.csv", folder / "sensor.yaml", recording)


def _tum(folder: Path, copy: _Copy, on_update: OnUpdate) -> None:
    camera, recording = copy.recording.camera, copy.recording
    stamps = [format_ns(ns) for ns in copy.ns]
    names = _images(copy, on_update, stamps, folder / "rgb", folder / "depth")
    for kind, files in zip(("rgb", "depth"), names, strict=True):
        lines = ((stamp, f"{kind}/{file}") for stamp, file in zip(stamps, files, strict=True))
        _list(folder / f"{kind}.txt", " timestamp filename", lines, " ")
    write_text(folder / INTRINSICS, format_rows(pinhole_matrix(*camera[:4])))
    if (known := _known(recording)) is not None:
        write_tum(folder / "groundtruth.txt", known)
    _imu(folder / "imu.csv", folder / "sensor.yaml", recording)


def _euroc(folder: Path, copy: _Copy, on_update: OnUpdate) -> None:
    recording, mav0 = copy.recording, folder / "mav0"
    stamps = [str(ns) for ns in copy.ns]
    names = _images(copy, on_update, stamps, mav0 / "cam0/data", mav0 / "depth0/data")
    for name, files in zip(("cam0", "depth0"), names, strict=True):
        _list(mav0 / name / "data.csv", "timestamp [ns],filename", zip(stamps, files, strict=True), ",")
    camera = recording.camera
    lens = (*camera.distortion, *[0.0] * 4)[: max(4, len(camera.distortion))]
    sheet = [
        *_extrinsics(recording.T_body_cam),
        f"resolution: [{camera.width}, {camera.height}]",
        "camera_model: pinhole",
        f"intrinsics: [{camera.fx!r}, {camera.fy!r}, {camera.cx!r}, {camera.cy!r}]",
        "distortion_model: radial-tangential",
        f"distortion_coefficients: [{', '.join(map(repr, lens))}]",
    ]
    write_text(mav0 / "cam0/sensor.yaml", "\n".join(["sensor_type: camera", *sheet]) + "\n")
    (mav0 / "imu0").mkdir()
    _imu(mav0 / "imu0/data.csv", mav0 / "imu0/sensor.yaml", recording._replace(T_body_cam=np.eye(4)))
    copy.notes.append("imu0/sensor.yaml states the noise of an ADIS16448, as that of the IMU is not known")
    if (known := _known(recording)) is not None:
        (mav0 / "state_groundtruth_estimate0").mkdir()
        T_world_body = known.T @ rigid.inverse(recording.T_body_cam)
        write_euroc(mav0 / "state_groundtruth_estimate0/data.csv", known._replace(T=T_world_body))


def _known(recording: Recording) -> Trajectory | None:
    """The poses that are known, with their timestamps."""
    if recording.T_world_cam is None:
        return None
    finite = np.isfinite(recording.T_world_cam).all((1, 2))
    return Trajectory(recording.t[finite], recording.T_world_cam[finite], recording.t0_ns)


def _imu(table: Path, sheet: Path, recording: Recording) -> None:
    """The readings, and where the camera is on the IMU; nothing without one."""
    if recording.imu is None:
        return
    t, rate, force = (np.asarray(values, np.float64) for values in recording.imu[:3])
    rows = zip(whole_ns(t, recording.t0_ns), format_rows(np.hstack([rate, force])).splitlines(), strict=True)
    lines = [f"{ns},{','.join(row.split())}\n" for ns, row in rows]
    write_text(table, f"{_IMU_HEAD}\n" + "".join(lines))
    noise = ADIS16448
    content = [
        "sensor_type: imu",
        *_extrinsics(recording.T_body_cam),
        f"gyroscope_noise_density: {noise.gyro_density!r}",
        f"gyroscope_random_walk: {noise.gyro_walk!r}",
        f"accelerometer_noise_density: {noise.accelerometer_density!r}",
        f"accelerometer_random_walk: {noise.accelerometer_walk!r}",
    ]
    write_text(sheet, "\n".join(content) + "\n")


def _extrinsics(T: Float[np.ndarray, "4 4"]) -> list[str]:
    return ["T_BS:", "  cols: 4", "  rows: 4", f"  data: [{', '.join(map(repr, T.reshape(-1).tolist()))}]"]


_WRITERS = {"plain": _plain, "tum": _tum, "euroc": _euroc}
