"""The folder of a run, and what it states about machine and versions."""

import os
import platform
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import numpy as np

import jaxpose
from jaxpose.errors import DataError
from jaxpose.files.atomic import clear_temporary

LOCK = ".lock"  # of a run folder: host and process of the run that has it open


def folder_path(experiment: str, *, name: str | None = None, out: Path | str | None = None) -> Path:
    """The folder of a run, which is not made yet.

    Args:
        experiment: what makes the run.
        name: of its folder within `outputs/<experiment>`; None: a timestamp.
        out: exactly this folder instead.

    Returns:
        Its path.
    """
    timestamp = f"{datetime.now():%Y-%m-%d_%H-%M-%S.%f}"
    return Path(out) if out is not None else Path("outputs") / experiment / (name or timestamp)


@contextmanager
def opened(folder: Path) -> Iterator[Path]:
    """Make a run folder, and take it away again if what is done in it fails before anything is written.

    A folder that exists is written over or resumed; what a killed run was writing is deleted. Only folders
    that were made here are taken away, and only empty ones. While it is open no other run opens it.

    Args:
        folder: the run folder.

    Returns:
        The same, for the length of the `with` block.

    Raises:
        OSError: at once where nothing can be written.
        DataError: where another run has it open.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(folder):
            clear_temporary(folder)
            yield folder
    except BaseException:
        for path in made:
            if any(path.iterdir()):
                break
            path.rmdir()
        raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; the system lets go of it when the process ends, however it ends."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    path, me = folder / LOCK, socket.gethostname()
    while True:
        stream = path.open("a+", encoding="utf-8")
        stream.seek(0)
        held = stream.read(200).split()
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free = len(held) != 2 or held[0] == me  # of another host the lock may not be seen here
        except OSError:
            free = False
        if not free:
            stream.close()
            host, pid = held if len(held) == 2 else ("this host", "unknown")
            raise DataError(
                f"{folder}: expected no other run in it, got one of process {pid} on {host}"
                + ("" if host == me else f"; if that has ended, delete {path}")
            )
        if path.exists() and os.fstat(stream.fileno()).st_ino == path.stat().st_ino:
            break
        stream.close()  # a run that ended has deleted it in between
    try:
        stream.truncate(0)
        stream.write(f"{me} {os.getpid()}\n")
        stream.flush()
        yield
    finally:
        path.unlink(missing_ok=True)
        stream.close()


def versions() -> dict[str, str]:
    """What a result depends on besides its configuration: software and device.

    Returns:
        Versions and names by what they are of.
    """
    import jax  # slow to load, and files of trajectories are read without it

    return {
        "python": platform.python_version(),
        "jaxpose": jaxpose.__version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "platform": platform.platform(),
        "backend": jax.default_backend(),
        "device": jax.devices()[0].device_kind,
    }
