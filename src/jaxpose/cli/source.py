"""What a command is given: a trajectory file of any format, or the folder of a run."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files import trajectories
from jaxpose.files.schema import choice
from jaxpose.files.timestamps import format_ns
from jaxpose.files.untrusted import read_json

FIELD = "field.npz"
_DATA = (".bag", ".mcap", ".db3", ".r3d", ".mkv", ".json")  # suffixes of files that are no trajectories


class Source(NamedTuple):
    """Poses, and what they were read from."""

    path: Path
    what: str  # in words
    trajectory: trajectories.Trajectory
    stamped: bool  # False: the pose of line i is said to be at i seconds
    file: trajectories.TrajectoryFile | None = None  # None: a run
    names: tuple[str, ...] = ()  # of the image of each pose, where they are known

    @property
    def is_run(self) -> bool:
        return self.file is None

    @property
    def lines(self) -> int:
        """Poses that the source has, those left out among them."""
        return len(self.trajectory.t) if self.file is None else self.file.count

    def __str__(self) -> str:
        span = f", {self.span()}" if self.stamped else ", no timestamps"
        notes = "" if self.file is None else "".join(f" ({note})" for note in self.file.notes)
        return f"{self.path}  {self.what}, {len(self.trajectory.t)} poses{span}{notes}"

    def span(self) -> str:
        """From when to when the poses are, on the source's own clock."""
        first, last = (self.trajectory.t0_ns + round(s * 1e9) for s in self.trajectory.t[[0, -1]].tolist())
        return f"{_milliseconds(first)} to {_milliseconds(last)} s"


def read_source(path: Path, columns: str | None = None) -> Source:
    """Read a trajectory file, the trajectory of a run folder, or the poses of a recording or of photographs.

    DataError or OSError for what is none of them. `columns` names those of a file, as `read_trajectory` says.
    """
    if path.suffix.lower() in _DATA and path.is_file() and (found := _of_data(path)) is not None:
        return found
    if not path.is_dir():
        if not path.exists():
            raise DataError(f"{path}: expected a trajectory file or a run folder, got nothing")
        file = trajectories.read_trajectory(path, columns)
        return Source(path, f"{file.format} file", file.trajectory, file.has_timestamps, file)
    if columns is not None:
        raise DataError(f"{path}: expected a file for --columns {columns!r}, got a folder")
    file = path / "trajectory.txt"
    if not file.is_file():
        if (found := _of_data(path)) is not None:
            return found
        inner = sorted(folder.parent.name for folder in path.glob("*/trajectory.txt"))
        hint = f"runs in it: {', '.join(inner)}" if inner else "none"
        raise DataError(f"{path}: expected a run folder with trajectory.txt, got {hint}")
    trajectory = trajectories.read_tum(file)
    # A run's files are all on one clock, which its field takes as float64 seconds.
    trajectory = trajectories.Trajectory(trajectories.since(trajectory, 0), trajectory.T)
    what = f"{_experiment(path / 'results.json')} run".strip()
    return Source(path, what, trajectory, True, names=_names_of_run(path, len(trajectory.t)))


def _of_data(path: Path) -> Source | None:
    from jaxpose.cli.data_poses import read_data  # here, as it loads jax

    return read_data(path)


def _names_of_run(path: Path, count: int) -> tuple[str, ...]:
    """The images of a run, one a pose; none where it says less."""
    from jaxpose.files.camera_json import read_camera

    file = path / "camera.json"
    names = read_camera(file).images if file.is_file() else ()
    return names if len(names) == count else ()


def read_field(source: Source) -> Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 4 4"]]:
    """The continuous trajectory of a run; DataError where there is none, as motion is not made up."""
    if not source.is_run:
        raise DataError(
            f"{source.path}: expected a run folder with {FIELD}, got a {source.what}: how it moved between "
            "its timestamps is not known"
        )
    file = source.path / FIELD
    if not file.is_file():
        raise DataError(f"{file}: expected the continuous trajectory of the run, got nothing")
    from jaxpose.fields import _entries, numpy_evaluator  # here, as their room loads jax

    try:
        poses = numpy_evaluator.load(_entries.read_entries(file))
    except DataError as error:
        raise DataError(f"{error} (what older runs left needs a new run)") from None

    def finite(t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            T = poses(t)
        if not np.isfinite(T).all():
            raise DataError(f"{file}: expected finite poses, got NaN or infinity")
        return T

    return finite


def read_covariance(
    source: Source, trajectory: trajectories.Trajectory
) -> tuple[Float[np.ndarray, "n 6 6"] | None, str]:
    """Covariances of a run's poses, of increments on the right, or None; and which, in words."""
    file = source.path / FIELD
    if not source.is_run or not file.is_file():
        return None, "without covariances"
    from jaxpose.fields import _entries, numpy_evaluator  # here, as their room loads jax

    known = _entries.read_entries(file)
    if "covariance" not in known:
        return None, f"without covariances, which {FIELD} does not have"
    try:
        return numpy_evaluator.load_covariance(known)(trajectories.since(trajectory, 0)), "with covariances"
    except ValueError as error:  # of times beyond those that are known
        return None, f"without covariances: {str(error)[:80]}"


def images_on_disk(folder: Path, names: tuple[str, ...]) -> list[Path]:
    """The files of a run's images, whose names may lack a suffix; nothing unless all are there."""
    from jaxpose.datasets.images import SUFFIXES

    candidates = [[folder / name, *(folder / f"{name}{suffix}" for suffix in SUFFIXES)] for name in names]
    found = [next((file for file in files if file.is_file()), None) for files in candidates]
    return [] if None in found else [file for file in found if file is not None]


def _milliseconds(ns: int) -> str:
    whole, _, rest = format_ns(round(ns, -6)).partition(".")
    return f"{whole}.{rest:0<3}"


def _experiment(results: Path) -> str:
    """Which experiment a run is of, where it says so: a run that goes on has no results yet."""
    if not results.is_file():
        return ""
    return choice(results, read_json(results, "the results of a run"), "experiment")
