"""EuRoC recordings in the ASL layout.

IMU, cameras and ground truth, with depth beside them or from a scan.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.datasets.ground_truth import poses_at
from jaxpose.datasets.images import (
    check_depth,
    common_size,
    found,
    read_color,
    read_depth,
    some,
    usable_poses,
    within,
)
from jaxpose.datasets.rgbd.cloud_depth import depth_from_cloud
from jaxpose.datasets.rgbd.euroc_files import (
    IMU_COLUMNS,
    existing,
    read_camera_sheet,
    read_csv,
    read_imu_sheet,
    read_listing,
    sensors,
)
from jaxpose.datasets.rgbd.frames import listed
from jaxpose.datasets.rgbd.imu_csv import read_imu
from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.files.ply import read_points
from jaxpose.files.tables import left_out_notes, seconds
from jaxpose.files.trajectories import Trajectory, read_trajectory, since
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera
from jaxpose.imu import Imu, ImuNoise

_TRUTH_COLUMNS = (
    "17 columns (timestamp, 3 position, 4 quaternion, 3 velocity, 3 gyro bias, 3 accelerometer bias)"
)


class ImuLog(NamedTuple):
    """Readings, the noise of `sensor.yaml`, and where the sensor sits."""

    imu: Imu  # [s] since `t0_ns`
    noise: ImuNoise
    t0_ns: int  # since 1970
    T_body_imu: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...] = ()  # what of the readings was left out, with counts


class GroundTruth(NamedTuple):
    """Motion capture fused with the IMU; SI units, body = IMU."""

    t: Float[np.ndarray, " n"]  # [s] since the first IMU timestamp
    T_world_body: Float[np.ndarray, "n 4 4"]
    velocity_world: Float[np.ndarray, "n 3"]
    gyro_bias: Float[np.ndarray, "n 3"]
    accelerometer_bias: Float[np.ndarray, "n 3"]
    notes: tuple[str, ...] = ()  # what was left out, with counts


class CameraLog(NamedTuple):
    """One camera: images with timestamps [ns since 1970], lens and intrinsics, and where it sits."""

    camera: Camera
    stamps_ns: list[int]
    files: list[Path]
    T_body_cam: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...] = ()  # on listed images that are not there


class _Depth(NamedTuple):
    """The frames that have depth, it in metres by frame, and what the user has to know about it."""

    rows: list[int]
    read: Callable[[int], np.ndarray]
    notes: tuple[str, ...]


def detect(path: Path) -> bool:
    """Whether a folder has one of the layout's folders.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return any((path / name).is_dir() for name in ("mav0", "cam0", "imu0"))


def load(path: Path | str) -> Recording:
    """Read a sequence as frames of cam0 with depth, ground truth and IMU.

    Depth is that of `mav0/depth0`, in the layout of a camera (`data.csv` with timestamp and file name,
    `data/`): 16-bit png in mm, registered to cam0 with its distortion, and of the same timestamps. Else it is
    that of the Vicon room's scan, `mav0/pointcloud0/data.ply` or `data.ply` in the sequence folder, points in
    the frame of the ground truth, projected into cam0 when a frame is read (`cloud_depth`). Images are grey:
    three equal channels. The ground truth is interpolated to the images' timestamps (cubic splines and slerp,
    within gaps of 0.1 s) and NaN beyond. The body is the IMU, whose readings are as recorded, biases
    included.

    Args:
        path: The sequence folder, or its `mav0`.

    Returns:
        The frames that have depth, on a clock that starts at the first of them; its notes say what was left
        out.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    mav0 = sensors(path)
    cam0 = load_camera(mav0)
    T_world_body, untrue, gaps = _truth_at(mav0, cam0.stamps_ns)
    T_world_cam = T_world_body @ cam0.T_body_cam
    depth = _find_depth(mav0, cam0, T_world_cam)
    rows = depth.rows
    t0_ns = cam0.stamps_ns[rows[0]]
    log = load_imu(mav0, t0_ns)
    names = [str(cam0.stamps_ns[row]) for row in rows]
    if untrue:
        poses, lacking = None, untrue
    else:
        poses, lacking = usable_poses(
            T_world_cam[rows], names, lambda i: names[i], "no ground truth near its timestamp"
        )
    read_color(cam0.files[rows[0]])
    return Recording(
        name=(mav0.resolve().parent if mav0.resolve().name == "mav0" else mav0.resolve()).name,
        camera=cam0.camera,
        t=seconds([cam0.stamps_ns[row] for row in rows], t0_ns),
        read=lambda i: Frame(read_color(cam0.files[rows[i]]), depth.read(rows[i])),
        T_world_cam=poses,
        imu=log.imu,
        T_body_cam=rigid.inverse(log.T_body_imu) @ cam0.T_body_cam,
        notes=(*depth.notes, *lacking, *gaps, *log.notes, *_unused(mav0)),
        t0_ns=t0_ns,
        files=within([cam0.files[row] for row in rows], path),
    )


def load_camera(path: Path | str, name: str = "cam0") -> CameraLog:
    """Read a camera of a sequence; images that are listed and not there are left out and counted.

    Args:
        path: The sequence folder, or its `mav0`.
        name: The camera's folder in it.

    Returns:
        Its images and data sheet.

    Raises:
        DataError: For files that cannot be used.
    """
    folder = sensors(path) / name
    timestamps, files, missing = _images(folder)
    camera, T_body_cam = read_camera_sheet(folder / "sensor.yaml")
    size = common_size(files)
    if size != (camera.width, camera.height):
        raise DataError(
            f"{folder / 'sensor.yaml'}: expected the images' resolution, {size[0]}x{size[1]}, "
            f"got {camera.width}x{camera.height}"
        )
    return CameraLog(camera, timestamps, files, T_body_cam, missing)


def _images(folder: Path) -> tuple[list[int], list[Path], tuple[str, ...]]:
    """Timestamps and files of the images that a camera lists and has, and a note on the others."""
    timestamps, files = read_listing(folder)
    names = [str(file.relative_to(folder / "data")) for file in files]
    rows, files, notes = listed(folder / "data.csv", folder / "data", names)
    return [timestamps[row] for row in rows], files, tuple(f"{folder.name}: {note}" for note in notes)


def load_imu(path: Path | str, t0_ns: int | None = None) -> ImuLog:
    """Read `mav0/imu0` of a sequence folder.

    Args:
        path: The sequence folder, or its `mav0`.
        t0_ns: Where time is 0 [ns since 1970]; by default at the first reading.

    Returns:
        The readings as recorded, and the sensor's data sheet.

    Raises:
        DataError: For files that cannot be used.
    """
    folder = sensors(path) / "imu0"
    file = read_imu(existing(folder / "data.csv"))
    noise, T_body_imu = read_imu_sheet(folder / "sensor.yaml")
    t0_ns = file.ns[0] if t0_ns is None else t0_ns
    return ImuLog(file.since(t0_ns), noise, t0_ns, T_body_imu, file.notes)


def load_truth(path: Path | str, t0_ns: int | None = None) -> GroundTruth:
    """Read `mav0/state_groundtruth_estimate0` of a sequence folder.

    Args:
        path: The sequence folder, or its `mav0`.
        t0_ns: Where time is 0 [ns since 1970]; by default at the first reading of the IMU, whose file has to
            be there then.

    Returns:
        The motion of the body, and the biases of its IMU.

    Raises:
        DataError: For files that cannot be used.
    """
    file = sensors(path) / "state_groundtruth_estimate0" / "data.csv"
    table = read_csv(file, _TRUTH_COLUMNS)
    lines, timestamps, values = table.lines, table.ns, table.values
    if t0_ns is None:
        t0_ns = read_csv(sensors(path) / "imu0" / "data.csv", IMU_COLUMNS, rows=1).ns[0]
    norm = np.linalg.norm(values[:, 3:7], axis=1)
    if abs(norm - 1).max() > 1e-2:
        row = int(abs(norm - 1).argmax())
        raise DataError(f"{file}:{lines[row]}: expected a unit quaternion, got norm {norm[row]:.4g}")
    T_world_body = rigid.make(Rotation.from_quat(values[:, [4, 5, 6, 3]]).as_matrix(), values[:, :3])
    return GroundTruth(
        seconds(timestamps, t0_ns),
        T_world_body,
        values[:, 7:10],
        values[:, 10:13],
        values[:, 13:16],
        left_out_notes(file, table),
    )


def common_start(path: Path | str) -> tuple[int, float]:
    """When both IMU and ground truth of a sequence begin.

    Args:
        path: The sequence folder, or its `mav0`.

    Returns:
        The later of their first timestamps [ns since 1970], and how long [s] after the IMU's that is.

    Raises:
        DataError: For files that cannot be used.
    """
    imu, ground_truth = (
        read_csv(sensors(path) / name / "data.csv", columns, rows=1).ns[0]
        for name, columns in (("imu0", IMU_COLUMNS), ("state_groundtruth_estimate0", _TRUTH_COLUMNS))
    )
    t0_ns = max(imu, ground_truth)
    return t0_ns, (t0_ns - imu) * 1e-9


def _truth_at(
    mav0: Path, stamps_ns: list[int]
) -> tuple[Float[np.ndarray, "n 4 4"], tuple[str, ...], tuple[str, ...]]:
    """T_world_body at timestamps, NaN where ground truth has a gap; notes: there is none; on its lines."""
    if not (mav0 / "state_groundtruth_estimate0").is_dir():
        none = np.full((len(stamps_ns), 4, 4), np.nan)
        return none, ("no state_groundtruth_estimate0: there is no ground truth to compare with",), ()
    found = read_trajectory(existing(mav0 / "state_groundtruth_estimate0" / "data.csv"))
    t0_ns = stamps_ns[0]
    trajectory = Trajectory(since(found.trajectory, t0_ns), found.trajectory.T)
    return poses_at(trajectory, seconds(stamps_ns, t0_ns)), (), found.notes


def _find_depth(mav0: Path, cam0: CameraLog, T_world_cam: Float[np.ndarray, "n 4 4"]) -> _Depth:
    """Depth of the frames that have it, from images or from the cloud."""
    if (mav0 / "depth0").is_dir():
        return _given_depth(mav0 / "depth0", cam0)
    clouds = (mav0 / "pointcloud0" / "data.ply", mav0.resolve().parent / "data.ply", mav0 / "data.ply")
    for file in clouds:
        if file.is_file():
            return _cloud_depth(file, cam0, T_world_cam)
    raise DataError(
        f"{mav0}: expected depth in depth0/data.csv, or a point cloud in pointcloud0/data.ply or as "
        f"data.ply in the sequence folder, got {found(mav0)}"
    )


def _given_depth(folder: Path, cam0: CameraLog) -> _Depth:
    timestamps, files, missing = _images(folder)
    by_stamp = dict(zip(timestamps, files, strict=True))
    rows = [row for row, timestamp in enumerate(cam0.stamps_ns) if timestamp in by_stamp]
    if not rows:
        raise DataError(
            f"{folder / 'data.csv'}: expected timestamps of cam0, got {timestamps[0]} and others without one"
        )
    chosen = {row: by_stamp[cam0.stamps_ns[row]] for row in rows}
    common_size([cam0.files[rows[0]], *chosen.values()])
    check_depth(folder, list(chosen.values()))
    notes = (*cam0.notes, *missing, *_left_out(cam0, rows, "no depth of their timestamp"))
    return _Depth(rows, lambda row: read_depth(chosen[row]), notes)


def _cloud_depth(file: Path, cam0: CameraLog, T_world_cam: Float[np.ndarray, "n 4 4"]) -> _Depth:
    points = read_points(file)
    usable = np.isfinite(points).all(axis=1)
    rows = [int(row) for row in np.flatnonzero(np.isfinite(T_world_cam).all((1, 2)))]
    if not rows:
        raise DataError(
            f"{file}: expected true poses to project the cloud with, got none at cam0's timestamps"
        )
    look = depth_from_cloud(cam0.camera, points[usable])
    if not any(look(T_world_cam[row]).any() for row in rows[:: max(1, len(rows) // 5)]):
        raise DataError(f"{file}: expected points in the view of cam0, got none")
    source = (
        f"depth from the {usable.sum()} points of {file.name}, taken to be in the frame of the ground truth"
    )
    ignored = (f"{(~usable).sum()} points with NaN or infinity ignored",) if not usable.all() else ()
    notes = (source, *ignored, *cam0.notes, *_left_out(cam0, rows, "no true pose to see the cloud from"))
    return _Depth(rows, lambda row: look(T_world_cam[row]), notes)


def _left_out(cam0: CameraLog, rows: list[int], reason: str) -> tuple[str, ...]:
    kept = set(rows)
    out = [str(timestamp) for row, timestamp in enumerate(cam0.stamps_ns) if row not in kept]
    return (f"{len(out)} of {len(cam0.files)} frames left out, {reason}: {some(out)}",) if out else ()


def _unused(mav0: Path) -> tuple[str, ...]:
    """A note on the second camera."""
    if not (mav0 / "cam1" / "data.csv").is_file():
        return ()
    return (f"cam1 with {len(read_listing(mav0 / 'cam1')[0])} images is not used",)
