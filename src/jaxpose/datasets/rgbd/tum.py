"""The TUM RGB-D layout: `rgb.txt` and `depth.txt` list stamped images, `groundtruth.txt` the true poses."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import (
    INTRINSICS,
    Pinhole,
    check_intrinsics,
    check_positive,
    default_intrinsics,
    found,
    read_intrinsics,
    sidecar,
)
from jaxpose.datasets.rgbd.frames import Poses, listed, of_files
from jaxpose.datasets.rgbd.pairs import nearest_pairs, unpaired_note
from jaxpose.datasets.types import Accelerometer, Recording
from jaxpose.errors import DataError
from jaxpose.files.association import nearest
from jaxpose.files.tables import numbered_lines, read_all_numbers, read_numbers, read_stamped_names
from jaxpose.files.trajectories import read_trajectory, since
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, pinhole_matrix
from jaxpose.imu import GRAVITY_WORLD
from jaxpose.imu.gravity import gravity_note

_SIZE = (640, 480)
_NOMINAL = Pinhole(525.0, 525.0, 319.5, 239.5)
_R_CAM_KINECT = np.diag([-1.0, -1.0, 1.0])
# Bonn's marker and camera (Palazzolo et al. 2019, the data set's page): the world of its ground truth is
# turned by the first on both sides, and the second, which is no rotation to 6%, is the camera on the markers.
_BONN = (
    Pinhole(542.822841, 542.57687, 315.59352, 237.756098),
    (0.039903, -0.099343, -0.00073, -0.000144, 0.0),
)
_BONN_TURN = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_BONN_MARKER = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)
# By the data set's three cameras: the colour camera's intrinsics, and k1 k2 p1 p2 k3 of its lens.
_CAMERAS: dict[str, tuple[Pinhole, tuple[float, ...]]] = {
    "1": (Pinhole(517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": (Pinhole(520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": (Pinhole(535.4, 539.2, 320.1, 247.6), ()),
}


class Stamped(NamedTuple):
    """A list of images, those that are there."""

    ns: list[int]  # timestamps, increasing, on the file's own clock
    files: list[Path]
    notes: tuple[str, ...]  # on those that are not

    @property
    def t(self) -> Float[np.ndarray, " n"]:
        """The timestamps [s]."""
        return np.array(self.ns, np.float64) / 1e9

    @property
    def names(self) -> list[str]:
        """The files' own names."""
        return [file.name for file in self.files]


def detect(path: Path) -> bool:
    """Whether a folder has one of the layout's lists.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return (path / "rgb.txt").is_file() or (path / "depth.txt").is_file()


def load(path: Path | str, *, max_difference_s: float = 0.02, depth_per_metre: float = 5000.0) -> Recording:
    """Read a sequence of TUM RGB-D, or of Bonn or ETH3D, which have its files.

    Listed images that are not there are skipped and counted. Colour and depth are paired one to one, nearest
    first; frames have the timestamps of colour. The true pose is the one nearest in time, NaN where none
    is near enough; without `groundtruth.txt` there is no ground truth, and of lines with one timestamp
    (the published fr2_desk has two) the first counts. Intrinsics (3x3) are read from
    `camera-intrinsics.txt` in or beside the folder, else from ETH3D's `calibration.txt` (fx fy cx cy);
    else they and the distortion are the published ones of freiburg1, 2 or 3, or of Bonn's camera, by the
    folder's name. Bonn's poses are of its markers, and are brought to the camera as its page says. Depth
    is registered to colour. `accelerometer.txt` (m/s^2) is the Kinect's own, whose axes are left, up and
    forward (Microsoft's Kinect documentation, "Accelerometer"): without ground truth it says which way is
    up; a note says if it disagrees with the ground truth.

    Args:
        path: The sequence folder.
        max_difference_s: Less than this apart [s] are timestamps that belong together; 0.02 s is that of the
            data set's own tools.
        depth_per_metre: Counts of depth a metre.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a setting that is not positive.
    """
    check_positive("max_difference_s", max_difference_s)
    check_positive("depth_per_metre", depth_per_metre)
    folder = Path(path)
    if not folder.is_dir():
        raise DataError(f"{folder}: expected a folder with rgb.txt and depth.txt, got {found(folder)}")
    color, depth = read_list(folder / "rgb.txt"), read_list(folder / "depth.txt")
    rows, partners = nearest_pairs(str(folder), color.t, depth.t, max_difference_s)
    notes = [*color.notes, *depth.notes]
    notes += unpaired_note("colour", "depth", color.names, rows, max_difference_s)
    notes += unpaired_note("depth", "colour", depth.names, partners, max_difference_s)
    ns = [color.ns[row] for row in rows]
    poses, repeated = _truth(folder / "groundtruth.txt", color.t[rows], max_difference_s)
    if poses.T_world_cam is not None and _is_bonn(folder):
        poses = poses._replace(T_world_cam=poses.T_world_cam @ _bonn_camera())
    recording = of_files(
        path,
        [color.files[row] for row in rows],
        [depth.files[i] for i in partners],
        lambda size, depth_size: _camera(folder, size),
        t=ns,
        names=[f"{t:.6f}" for t in color.t[rows]],
        poses=poses,
        per_metre=depth_per_metre,
        notes=notes,
    )
    accelerometer, weighed = _accelerometer(
        folder / "accelerometer.txt", ns[0], recording.t, recording.T_world_cam
    )
    return recording._replace(accelerometer=accelerometer, notes=(*recording.notes, *repeated, *weighed))


def read_list(file: Path) -> Stamped:
    """Read a list of images: lines of `timestamp name`.

    Args:
        file: Names are relative to its folder, timestamps increase.

    Returns:
        Timestamps and image files of those that are there.

    Raises:
        DataError: Naming file and line for anything else, and where none is there.
    """
    if not file.is_file():
        raise DataError(f"{file}: expected lines of a timestamp and a file name, got {found(file)}")
    ns, names = read_stamped_names(file, unit="s")
    rows, files, notes = listed(file, file.parent, names)
    return Stamped([ns[row] for row in rows], files, notes)


def _is_bonn(folder: Path) -> bool:
    return "rgbd_bonn_" in folder.resolve().name.lower()


def _bonn_camera() -> Float[np.ndarray, "4 4"]:
    """The camera on Bonn's markers."""
    T = _BONN_TURN @ _BONN_MARKER
    return rigid.make(rigid.nearest_rotation(T[:3, :3]), T[:3, 3])


def _camera(folder: Path, size: tuple[int, int]) -> tuple[Camera, tuple[str, ...]]:
    """Intrinsics and lens, and a note where they are assumed."""
    file = sidecar(folder, INTRINSICS)
    if file is not None:
        return Camera(*read_intrinsics(file, size), *size), ()
    if (file := folder / "calibration.txt").is_file():
        fx, fy, cx, cy = read_all_numbers(file, (4,), "fx fy cx cy")
        K = pinhole_matrix(fx, fy, cx, cy)
        return Camera(*check_intrinsics(file, K, size), *size), ()
    if _is_bonn(folder):
        note = () if size == _SIZE else (default_intrinsics(_BONN[0], size, _SIZE, INTRINSICS),)
        return Camera(*_BONN[0], *size, _BONN[1]), note
    match = re.search(r"(?<![a-z])(?:freiburg|fr)([123])(?!\d)", folder.resolve().name.lower())
    pinhole, lens = _CAMERAS[match[1]] if match else (_NOMINAL, ())
    if match and size == _SIZE:
        return Camera(*pinhole, *size, lens), ()
    without = INTRINSICS if match else f"{INTRINSICS}, and no freiburg1, 2 or 3 in the folder's name"
    return Camera(*pinhole, *size, lens), (default_intrinsics(pinhole, size, _SIZE, without),)


def _truth(file: Path, timestamps: Float[np.ndarray, " n"], limit: float) -> tuple[Poses, tuple[str, ...]]:
    """The true poses nearest in time, and a note on lines that count for nothing."""
    if not file.is_file():
        return Poses(None, str, missing="no groundtruth.txt"), ()
    found = read_trajectory(file)
    if not found.has_timestamps:
        raise DataError(f"{file}: expected lines of t tx ty tz qx qy qz qw, got a {found.format} file")
    at = since(found.trajectory, 0)
    row = nearest(timestamps, at)
    near = np.abs(at[row] - timestamps) < limit
    poses = np.where(near[:, None, None], found.trajectory.T[row], np.nan)
    return Poses(poses, lambda i: str(file), f"none within {limit:g} s"), found.notes


def _accelerometer(
    file: Path, t0_ns: int, t: Float[np.ndarray, " n"], T_world_cam: Float[np.ndarray, "n 4 4"] | None
) -> tuple[Accelerometer | None, tuple[str, ...]]:
    """The readings on the frames' clock, in the camera's axes, and a note where ground truth disagrees."""
    if not file.is_file():
        return None, ()
    if not numbered_lines(file):
        return None, ("accelerometer.txt has no readings",)
    _, values = read_numbers(file, "4 numbers (t ax ay az)", (4,))
    values = values[np.argsort(values[:, 0], kind="stable")]
    read_at, force_cam = values[:, 0] - t0_ns / 1e9, values[:, 1:] @ _R_CAM_KINECT.T
    if T_world_cam is None:
        return Accelerometer(read_at, force_cam), ()
    notes = gravity_note(read_at, force_cam, t, T_world_cam, np.array(GRAVITY_WORLD), "accelerometer.txt")
    return Accelerometer(read_at, force_cam), notes
