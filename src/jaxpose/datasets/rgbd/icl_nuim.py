"""ICL-NUIM's RGB-D layout: `associations.txt` lists numbered images, `groundtruth.txt` the true poses."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import (
    INTRINSICS,
    Pinhole,
    default_intrinsics,
    found,
    frame_times,
    only,
    read_intrinsics,
    sidecar,
    some,
)
from jaxpose.datasets.rgbd.frames import Listing, Poses, of_files
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.files.tables import numbered_lines
from jaxpose.files.trajectories import read_tum, since
from jaxpose.imu import GRAVITY_WORLD

_LIST, _TRUTH, _PUBLISHED_TRUTH = "associations.txt", "groundtruth.txt", "*.gt.freiburg"
_LINES = "N depth/N.png N rgb/N.png (or rgb before depth) with the frame number N"
_PUBLISHED, _PUBLISHED_SIZE = Pinhole(481.2, 480.0, 319.5, 239.5), (640, 480)  # fy is published as -480
_PER_METRE = 5000.0
# The published poses are of a camera and a world whose y points up, which makes both left-handed.
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


class _Pair(NamedTuple):
    """The names of a frame's images, as listed."""

    number: int
    color: str
    depth: str


def detect(path: Path) -> bool:
    """Whether a folder has the layout's list; a plain one, which may have a list too, has `color/`.

    Args:
        path: A folder.

    Returns:
        Whether `load` should read it.
    """
    return (path / _LIST).is_file() and not (path / "color").is_dir()


def load(path: Path | str, *, rate_hz: float = 30.0) -> Recording:
    """Read a sequence of ICL-NUIM (Handa et al. 2014), of its packages in TUM RGB-D's format.

    `associations.txt` pairs colour and depth by frame number; listed images that are not there are skipped.
    The true poses are those of `groundtruth.txt`, else of the one `*.gt.freiburg`, whose timestamps are frame
    numbers; a frame without one, as frame 0 of the published packages, is NaN. The published camera and world
    have y up (hence the published fy of -480) and are left-handed: poses are mirrored, diag(1, -1, 1) on both
    sides, so that the world's y points down, along gravity. Intrinsics (3x3) are read from
    `camera-intrinsics.txt` in or beside the folder, else the published ones. Depth is 1/5000 m.

    Args:
        path: The sequence folder.
        rate_hz: Frames a second, as there are no timestamps: frame N is (N - first) / rate_hz seconds after
            the first.

    Returns:
        The recording; its notes say what was left out or assumed.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    folder = Path(path)
    pairs, skipped = _existing(folder, _read_list(folder))
    numbers, colors, depths = (list(column) for column in zip(*pairs, strict=True))
    return of_files(
        path,
        colors,
        depths,
        lambda size, depth_size: _intrinsics(folder, size),
        t=frame_times(numbers, rate_hz),
        names=[str(number) for number in numbers],
        poses=_read_poses(folder, numbers),
        per_metre=_PER_METRE,
        notes=skipped,
        gravity_world=np.array([0.0, np.linalg.norm(GRAVITY_WORLD), 0.0]),
    )


def _read_list(folder: Path) -> list[_Pair]:
    """The listed frames, in order of their numbers."""
    file = folder / _LIST
    if not file.is_file():
        raise DataError(f"{folder}: expected a folder with {_LIST}, depth/ and rgb/, got {found(folder)}")
    pairs: list[_Pair] = []
    for number, line in numbered_lines(file):
        pair = _parse(line)
        if pair is None:
            raise DataError(f"{file}:{number}: expected {_LINES}, got {line[:60]!r}")
        if pairs and pair.number <= pairs[-1].number:
            raise DataError(
                f"{file}:{number}: expected a frame number after {pairs[-1].number}, got {pair.number}"
            )
        pairs.append(pair)
    if not pairs:
        raise DataError(f"{file}: expected lines of {_LINES}, got none")
    return pairs


def _parse(line: str) -> _Pair | None:
    """The images of a line of the list; None for what is no such line."""
    words = line.split()
    if len(words) != 4:
        return None
    frame, first, same, second = words
    is_depth = ["depth" in name.lower() for name in (first, second)]
    if not all(re.fullmatch("[0-9]{1,9}", x) for x in (frame, same)) or sum(is_depth) != 1:
        return None
    if int(frame) != int(same):
        return None
    depth, color = (first, second) if is_depth[0] else (second, first)
    return _Pair(int(frame), color, depth)


def _existing(folder: Path, pairs: list[_Pair]) -> tuple[list[tuple[int, Path, Path]], tuple[str, ...]]:
    """Number, colour and depth of the frames that have both, and a note on the others."""
    listing, there, lacking = Listing(folder), [], []
    for pair in pairs:
        color, depth = listing.find(pair.color), listing.find(pair.depth)
        if color is None or depth is None:
            lacking.append(pair)
        else:
            there.append((pair.number, color, depth))
    numbers = some([str(pair.number) for pair in lacking])
    if not there:
        raise DataError(
            f"{folder}: expected images that {_LIST} lists, got no frame with color and depth of {numbers}"
        )
    if not lacking:
        return there, ()
    note = f"{len(lacking)} of {len(pairs)} listed frames skipped, without color or depth: {numbers}"
    return there, (note,)


def _intrinsics(folder: Path, size: tuple[int, int]) -> tuple[Pinhole, tuple[str, ...]]:
    """Those of the file in or beside the sequence, else as published; a note for images of another size."""
    file = sidecar(folder, INTRINSICS)
    if file is not None:
        return read_intrinsics(file, size), ()
    if size == _PUBLISHED_SIZE:
        return _PUBLISHED, ()
    return _PUBLISHED, (default_intrinsics(_PUBLISHED, size, _PUBLISHED_SIZE, INTRINSICS),)


def _read_poses(folder: Path, numbers: list[int]) -> Poses:
    """Ground truth by frame number, in OpenCV's axes."""
    file, candidates = folder / _TRUTH, [f for f in sorted(folder.glob(_PUBLISHED_TRUTH)) if f.name[0] != "."]
    if not file.is_file():
        if not candidates:
            return Poses(None, str, missing=f"no {_TRUTH} or {_PUBLISHED_TRUTH}")
        file = only(candidates, folder, f"{_TRUTH} or one {_PUBLISHED_TRUTH}")
    ground_truth = read_tum(file)
    stated: dict[int, Float[np.ndarray, "4 4"]] = {}
    for frame, pose in zip(since(ground_truth, 0), ground_truth.T, strict=True):
        if frame != int(frame):
            raise DataError(f"{file}: expected frame numbers, got {frame}")
        stated[int(frame)] = _MIRROR @ pose @ _MIRROR
    none = np.full((4, 4), np.nan)
    poses = np.stack([stated.get(number, none) for number in numbers])
    return Poses(poses, lambda i: str(file), f"none in {file.name}")
