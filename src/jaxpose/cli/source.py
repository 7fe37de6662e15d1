"""What a command is given: a trajectory file of any format, or the folder of a run."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.errors import DataError
from jaxpose.files import trajectories
from jaxpose.files.schema import choice
from jaxpose.files.untrusted import read_json

FIELD = "field.npz"


class Source(NamedTuple):
    """Poses, and what they were read from."""

    path: Path
    what: str  # in words
    trajectory: trajectories.Trajectory
    stamped: bool  # False: pose i is said to be at i seconds
    is_run: bool

    def __str__(self) -> str:
        t = self.trajectory.t
        span = f", {t[0]:.3f} to {t[-1]:.3f} s" if self.stamped else ", no timestamps"
        return f"{self.path}  {self.what}, {len(t)} poses{span}"


def read_source(path: Path) -> Source:
    """Read a trajectory file or the trajectory of a run folder; DataError or OSError for what is neither."""
    if not path.is_dir():
        if not path.exists():
            raise DataError(f"{path}: expected a trajectory file or a run folder, got nothing")
        trajectory, name, stamped, repeated = trajectories.read_trajectory(path)
        what = f"{name} file" + (f" ({repeated} left out: same timestamp as before)" if repeated else "")
        return Source(path, what, trajectory, stamped, False)
    file = path / "trajectory.txt"
    if not file.is_file():
        inner = sorted(folder.parent.name for folder in path.glob("*/trajectory.txt"))
        hint = f"runs in it: {', '.join(inner)}" if inner else "none"
        raise DataError(f"{path}: expected a run folder with trajectory.txt, got {hint}")
    return Source(
        path, f"{_experiment(path / 'results.json')} run".strip(), trajectories.read_tum(file), True, True
    )


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


def images_on_disk(folder: Path, names: tuple[str, ...]) -> list[Path]:
    """The files of a run's images, whose names may lack a suffix; nothing unless all are there."""
    from jaxpose.datasets.images import SUFFIXES

    candidates = [[folder / name, *(folder / f"{name}{suffix}" for suffix in SUFFIXES)] for name in names]
    found = [next((file for file in files if file.is_file()), None) for files in candidates]
    return [] if None in found else [file for file in found if file is not None]


def _experiment(results: Path) -> str:
    """Which experiment a run is of, where it says so: a run that goes on has no results yet."""
    if not results.is_file():
        return ""
    return choice(results, read_json(results, "the results of a run"), "experiment")
