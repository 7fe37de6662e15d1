"""A plain folder: images in `color/` and `depth/`, intrinsics, and optional `poses.txt` and `times.txt`."""

from collections.abc import Sequence
from pathlib import Path

from jaxpose.datasets.images import (
    SUFFIXES,
    check_positive,
    found,
    frame_times,
    image_size,
    natural_order,
    some,
)
from jaxpose.datasets.rgbd.frames import Poses, of_files, subfolder, visible
from jaxpose.datasets.rgbd.plain_files import LOGS, check_count, read_camera, read_poses
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.tables import numbered_lines
from jaxpose.files.trajectories import read_timestamps

_COLORS = ("color", "rgb", "image", "images")


def detect(path: Path) -> bool:
    """Whether a folder has the layout's two folders.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return all(subfolder(path, names) is not None for names in (("depth",), _COLORS))


def has_timestamps(path: Path) -> bool:
    """Whether a file of the folder states when each frame was taken.

    Args:
        path: The folder.

    Returns:
        True for a `times.txt`, and for poses of TUM's lines without one.
    """
    times, poses = path / "times.txt", path / "poses.txt"
    if times.is_file() or not poses.is_file():
        return times.is_file()
    return next((len(line.split()) == 8 for _, line in numbered_lines(poses)), False)


def load(path: Path | str, *, rate_hz: float = 30.0, depth_per_metre: float | None = None) -> Recording:
    """Read a plain folder: `color/` (`rgb/`, `image/`) and `depth/` with png or jpg, in the order of numbers.

    Captures of Open3D and of its recorders for RealSense and Azure Kinect, and Redwood's, are such folders.
    Images are paired by equal names or numbers, or in order if none are equal and there are as many of both.
    Intrinsics are those of `camera-intrinsics.txt` (3x3), `intrinsics.json` (fx fy cx cy, and optional width
    height depth_scale distortion), or Open3D's `camera_intrinsic.json` or `intrinsic.json`, in the folder or
    one up.
    Depth is registered to colour, 16 bits; where it is smaller, colour is resized to it.

    `times.txt` has a timestamp [s] for each colour image. `poses.txt` has a camera-to-world pose for each
    colour image, of 16 numbers (4x4, NaN where there is none) or KITTI's 12, or TUM's lines of 8: these go by
    their timestamps, within 0.02 s, if there is a `times.txt`, and state the times of as many images if there
    is none. Without it, Open3D's `trajectory.log` (here or in `scene/`) has them by frame.

    Args:
        path: The folder.
        rate_hz: Frames a second where no file has times.
        depth_per_metre: Counts of depth a metre; by default the file's depth_scale, else 1000.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a setting that is not positive.
    """
    if depth_per_metre is not None:
        check_positive("depth_per_metre", depth_per_metre)
    folder = Path(path)
    all_colors, all_depths = _images(folder, _COLORS), _images(folder, ("depth",))
    rows, partners, paired = _pairs(folder, all_colors, all_depths)
    camera, stated_per_metre = read_camera(folder, image_size(all_colors[rows[0]]))
    assumed = () if depth_per_metre or stated_per_metre else ("no depth_scale: took depth as mm",)
    count = len(all_colors)
    ns = _read_times(folder / "times.txt", count)
    file = next((folder / name for name in ("poses.txt", *LOGS) if (folder / name).is_file()), None)
    poses = None
    if file is not None:
        of_poses, poses = read_poses(file, ns, count)
        ns = ns or of_poses
    if ns is None:
        ns = [round(s * 1e9) for s in frame_times(range(count), rate_hz).tolist()]
    return of_files(
        path,
        [all_colors[i] for i in rows],
        [all_depths[i] for i in partners],
        lambda size, depth_size: (camera, ()),
        t=[ns[row] for row in rows],
        names=[all_colors[row].stem for row in rows],
        poses=Poses(
            None if poses is None else poses[rows],
            lambda i: f"{file}: pose {rows[i]}",
            missing="no poses.txt",
        ),
        per_metre=depth_per_metre or stated_per_metre or 1000.0,
        notes=(*paired, *assumed),
    )


def _images(folder: Path, names: Sequence[str]) -> list[Path]:
    """Image files of the first of some folders that is there, r_2 before r_10."""
    inner = subfolder(folder, names)
    if inner is None:
        raise DataError(f"{folder}: expected folders color/ and depth/, got {found(folder)}")
    files = [file for file in visible(inner) if file.suffix.lower() in SUFFIXES]
    if not files:
        raise DataError(f"{inner}: expected images, got {found(inner)}")
    return sorted(files, key=lambda file: natural_order(file.name))


def _pairs(
    folder: Path, colors: Sequence[Path], depths: Sequence[Path]
) -> tuple[list[int], list[int], tuple[str, ...]]:
    """Indices of colour and depth images that belong together, and a note on how or what is left out."""
    for key in (lambda file: file.stem, _number):
        by_name = {key(depth): j for j, depth in enumerate(depths)}
        rows = [i for i, color in enumerate(colors) if key(color) in by_name]
        if rows:
            alone = sorted({key(file) for file in colors} ^ by_name.keys(), key=natural_order)
            notes = (f"{len(alone)} images without a partner left out: {some(alone)}",) if alone else ()
            return rows, [by_name[key(colors[i])] for i in rows], notes
    if len(colors) != len(depths):
        raise DataError(
            f"{folder}: expected colour and depth of equal names or equal number, got {len(colors)} as "
            f"{colors[0].name} and {len(depths)} as {depths[0].name}"
        )
    note = f"colour and depth paired in order: {colors[0].name} with {depths[0].name} and so on"
    return list(range(len(colors))), list(range(len(colors))), (note,)


def _number(file: Path) -> str:
    """The number that a name is, without zeros before it; else the name."""
    return str(int(file.stem)) if file.stem.isdecimal() else file.stem


def _read_times(file: Path, count: int) -> list[int] | None:
    """Increasing timestamps [ns], one for each colour image; None without a file."""
    if not file.is_file():
        return None
    ns = read_timestamps(file)
    check_count(file, len(ns), count)
    return ns
