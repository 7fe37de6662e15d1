"""Stray Scanner's recordings of a phone: `rgb.mp4`, `depth/`, `confidence/`, `odometry.csv`, `imu.csv`."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.datasets.images import check_intrinsics, found, name_of, read_depth
from jaxpose.datasets.rgbd.frames import Images, Listing, Poses, assembled, numbered
from jaxpose.datasets.rgbd.phones import R_CAM_PHONE, UNSURE, Y_UP, middle, sure_by_file
from jaxpose.datasets.types import Recording
from jaxpose.datasets.video import Video
from jaxpose.errors import DataError
from jaxpose.files.tables import numbered_lines, read_all_numbers
from jaxpose.files.timestamps import nanoseconds
from jaxpose.geometry import rigid
from jaxpose.imu import Imu

_LAYOUT = "rgb.mp4, depth/N.png, odometry.csv and camera_matrix.csv"
_STANDARD_GRAVITY = 9.80665  # [m/s^2] in a g of the phone's accelerometer
_IS_ONE = (0.7, 1.3)  # what is gravity's norm, of g
_MOST_FRAMES = 1e9


def detect(path: Path) -> bool:
    """Whether a folder has the layout's tables.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return (path / "odometry.csv").is_file() and (path / "camera_matrix.csv").is_file()


def load(path: Path | str) -> Recording:
    """Read a recording of Stray Scanner. Needs the package av (extra `video`) for its video.

    Frame N is the N-th of the video from the first of `odometry.csv` on, with `depth/N.png` (mm; 0 where
    `confidence/N.png` is 0) and a pose of ARKit's, camera-to-world in OpenCV's axes already, its world's
    y up. Colour is resized to depth, which is smaller. Intrinsics are the median of those that newer
    files have for each frame, else `camera_matrix.csv`. The IMU's accelerometer is the phone's raw one
    (g, pointing down) or in m/s^2; without gravity in it, as older versions wrote it, it is left out. It
    is turned to the camera, and taken to be where the camera is.

    Args:
        path: The recording's folder.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
    """
    folder = Path(path)
    ns, numbers, table, repeated = _odometry(folder / "odometry.csv")
    depth, video = numbered(folder / "depth"), Video(Listing(folder).find("rgb.mp4") or folder / "rgb.mp4")
    there = [i for i, n in enumerate(numbers) if n in depth and n - numbers[0] < len(video)]
    if not there:
        raise DataError(f"{folder}: expected {_LAYOUT}, got no depth of the frames of odometry.csv")
    lost = len(numbers) - len(there)
    depths, indices = [depth[numbers[i]] for i in there], [numbers[i] - numbers[0] for i in there]
    K = read_all_numbers(folder / "camera_matrix.csv", (9,), "9 numbers (a 3x3 matrix)").reshape(3, 3)
    pinhole, focus = check_intrinsics(folder / "camera_matrix.csv", K, video.size), ()
    if table.shape[1] >= 11:
        pinhole, focus = middle(table[there, 7:11])
    confidence = folder / "confidence"
    images = Images(
        video.size,
        lambda i, to: video.read(indices[i], to),
        lambda i: sure_by_file(read_depth(depths[i]), confidence / depths[i].name),
        lambda i: depths[i].name,
    )
    ns = [ns[i] for i in there]
    imu, sensed = _imu(folder / "imu.csv", ns[0])
    notes = [f"{lost} of {len(numbers)} frames left out, without depth or colour"] if lost else []
    notes += [UNSURE] if confidence.is_dir() else []
    return assembled(
        depths[0],
        images,
        lambda size, depth_size: (pinhole, focus),
        t=ns,
        names=[depth.stem for depth in depths],
        poses=Poses(_poses(table[there]), lambda i: str(folder / "odometry.csv"), "NaN or no quaternion"),
        first_color="rgb.mp4",
        notes=(*notes, *repeated, *sensed),
        imu=imu,
        T_body_cam=rigid.make(R_CAM_PHONE.T, np.zeros(3)),
        gravity_world=Y_UP,
    )._replace(name=name_of(folder))


def _read_csv(file: Path, least: int, columns: str) -> Float[np.ndarray, "n c"]:
    """The rows of a csv behind its header, NaN where there is no number; timestamps not decreasing."""
    if not file.is_file():
        raise DataError(f"{file}: expected lines of {columns}, got {found(file)}")
    rows = []
    for number, line in numbered_lines(file)[1:]:
        try:
            row = [float(word or "nan") for word in line.rstrip(", ").split(",")]
        except ValueError:
            row = []
        if len(row) < least or (rows and len(row) != len(rows[0])) or not np.isfinite(row[0]):
            raise DataError(f"{file}:{number}: expected {columns}, got {line[:60]!r}")
        rows.append(row)
    if not rows:
        raise DataError(f"{file}: expected lines of {columns}, got none")
    return np.array(rows)


def _odometry(file: Path) -> tuple[list[int], list[int], Float[np.ndarray, "n c"], tuple[str, ...]]:
    """Timestamps [ns], frame numbers, the columns behind them, and a note on rows that are left out."""
    table = _read_csv(file, 9, "timestamp, frame, x, y, z, qx, qy, qz, qw")
    later = np.append(True, table[1:, 0] > np.maximum.accumulate(table[:, 0])[:-1])
    note = f"{(~later).sum()} rows of odometry.csv left out, of a timestamp not after those before"
    table, notes = table[later], () if later.all() else (note,)
    if (odd := table[~(np.abs(table[:, 1]) < _MOST_FRAMES), 1]).size:
        raise DataError(f"{file}: expected numbers of frames, got {odd[0]:g}")
    return nanoseconds(file, table[:, 0]), table[:, 1].astype(int).tolist(), table[:, 2:], notes


def _poses(table: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n 4 4"]:
    T = np.full((len(table), 4, 4), np.nan)
    norm = np.linalg.norm(table[:, 3:7], axis=1)
    known = np.isfinite(table[:, :7]).all(axis=1) & (np.abs(norm - 1) < 1e-2)
    T[known] = rigid.make(Rotation.from_quat(table[known, 3:7]).as_matrix(), table[known, :3])
    return T


def _imu(file: Path, t0_ns: int) -> tuple[Imu | None, tuple[str, ...]]:
    """Readings in the phone's axes [rad/s, m/s^2, up at rest], and a note."""
    if not file.is_file():
        return None, ("no imu.csv",)
    table = _read_csv(file, 7, "timestamp, 3 accelerations, 3 rates")
    later = np.append(True, table[1:, 0] > np.maximum.accumulate(table[:, 0])[:-1])
    kept = np.isfinite(table).all(axis=1) & later
    table, lost = table[kept], int((~kept).sum())
    if len(table) < 2:
        return None, ("imu.csv has no readings",)
    notes = (f"{lost} readings of imu.csv left out: NaN, or not after the one before",) if lost else ()
    norm = float(np.linalg.norm(table[:, 1:4].mean(axis=0)))
    in_g = _IS_ONE[0] < norm < _IS_ONE[1]
    if not in_g and not _IS_ONE[0] < norm / _STANDARD_GRAVITY < _IS_ONE[1]:
        note = (
            f"imu.csv left out: its mean acceleration is {norm:.3g}, which is gravity in neither g nor m/s^2"
        )
        return None, (*notes, note)
    force = table[:, 1:4] * (-_STANDARD_GRAVITY if in_g else 1.0)
    at = table[:, 0] - t0_ns * 1e-9
    return Imu(at, table[:, 4:7], force), notes
