"""Checks that the configs of commands share: numbers, folders, options that would do nothing."""

import math
import os
from collections.abc import Collection, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

from jaxpose.errors import DataError
from jaxpose.files.untrusted import read_json

RUN_FILES = (
    "trajectory.txt",
    "reference.txt",
    "field.npz",
    "map.npz",
    "checkpoint.npz",
    "registration.npz",
    "points.ply",
    "mesh.ply",
)
RUN_FILES += tuple(f"{name}.json" for name in ("camera", "settings", "config", "results"))


def option_name(path: str) -> str:
    """A field of a config as its option: "slam.field.width" is --field.width."""
    return "--" + path.removeprefix("slam.").replace("_", "-")


def check_least(config: Any, **least: int | float) -> None:
    """Refuse numbers that are too small, infinite or NaN; None is free.

    Args:
        config: whose fields to check, tuples entry by entry.
        least: the least value of each field.

    Raises:
        ValueError: for a field out of its range.
    """
    for name, smallest in least.items():
        for value in _entries(config, name):
            if not smallest <= value < math.inf:
                raise ValueError(f"{option_name(name)}: expected at least {smallest}, got {value}")


def check_positive(config: Any, *names: str) -> None:
    """Refuse numbers that are not above 0, infinite or NaN; None is free.

    Args:
        config: whose fields to check, tuples entry by entry.
        names: the fields.

    Raises:
        ValueError: for a field out of its range.
    """
    for name in names:
        for value in _entries(config, name):
            if not 0 < value < math.inf:
                raise ValueError(f"{option_name(name)}: expected a positive number, got {value}")


def check_finite(config: Any, *names: str) -> None:
    """Refuse infinities and NaN.

    Args:
        config: whose fields to check, tuples entry by entry.
        names: the fields.

    Raises:
        ValueError: for a field that is not finite.
    """
    for name in names:
        for value in _entries(config, name):
            if not math.isfinite(value):
                raise ValueError(f"{option_name(name)}: expected a finite number, got {value}")


def check_run_folder(config: Any, *inputs: Path | None) -> None:
    """Refuse `out`, `name` and `resume` where they do not go together or name what is read.

    Args:
        config: the config of an experiment.
        inputs: files and folders that the run reads.

    Raises:
        ValueError: for two names of one folder, for none to resume, and for the folder of the input.
    """
    if config.out is not None and config.name is not None:
        raise ValueError(f"--name: expected no --out with it, as that names the folder, got {config.name}")
    if config.name is not None and (config.name in ("", ".", "..") or Path(config.name).name != config.name):
        raise ValueError(f"--name: expected the name of one folder, got {config.name!r}")
    if config.resume and config.out is None and config.name is None:
        raise ValueError("--resume: expected --out DIR or --name NAME with it")
    check_apart("--out", config.out, *inputs)


def check_apart(option: str, out: Path | None, *inputs: Path | None) -> None:
    """Refuse to write where is read from.

    Args:
        option: that names `out`.
        out: what is written.
        inputs: what is read.

    Raises:
        ValueError: if they are the same file or folder.
    """
    for path in inputs:
        if out is not None and path is not None and _same(out, path):
            raise ValueError(f"{option}: expected another place than the input, got {out}")
        if out is not None and path is not None and out.name in RUN_FILES and _same(out.parent, path):
            raise ValueError(f"{option}: expected no file of the run that is read, got {out}")


def _same(a: Path, b: Path) -> bool:
    """Whether two paths are one file or folder, by links too."""
    try:
        return a.samefile(b)
    except OSError:  # one of them is not there
        return os.path.realpath(a) == os.path.realpath(b)


def check_unused(config: Any, names: Collection[str], why: str) -> None:
    """Refuse options that a run would not read.

    Args:
        config: the config.
        names: paths of fields that have to keep their defaults.
        why: they have no effect.

    Raises:
        ValueError: for the first one that was changed.
    """
    for name in names:
        read = attrgetter(name)
        if read(config) != read(type(config)):  # a dataclass keeps its defaults as attributes
            raise ValueError(f"{option_name(name)}: has no effect {why}, got {read(config)}")


def own_folder(folder: Path, stored: Path, settings: Mapping[str, Any], resume: bool, *names: str) -> bool:
    """Make a run folder ready: earlier results stay only if they are of this run and to be kept.

    Args:
        folder: the folder of the run.
        stored: its file of settings, which marks the files `names` as a run's.
        settings: what the run's results depend on, in JSON's types.
        resume: whether to go on with what is there.
        names: files of a run, as patterns, which are deleted where the run starts anew.

    Returns:
        Whether the run goes on with what is there.

    Raises:
        DataError: where the files are of a run with other settings, or of no run at all.
    """
    there = [path for name in names for path in sorted(folder.glob(name)) if path != stored]
    for path in there:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise DataError(f"{path}: expected a file in the run folder, got a link out of it")
    if not stored.exists():
        if there:
            raise DataError(f"{there[0]}: expected a new folder or that of a run, got a file of no run")
        return False
    if not resume:
        for path in there:
            path.unlink()
        return False
    before = read_json(stored, "the settings of a run")
    for name, value in settings.items():
        if before.get(name) != value:
            option = option_name(name)
            raise DataError(f"{folder}: expected {option} {before.get(name)}, as it began, got {value}")
    return True


def _entries(config: Any, name: str) -> tuple[Any, ...]:
    value = attrgetter(name)(config)
    values = value if isinstance(value, tuple) else (value,)
    return tuple(entry for entry in values if entry is not None)
