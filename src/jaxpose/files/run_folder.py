"""The folder of a run, and what it states about machine and versions."""

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import numpy as np

import jaxpose


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

    A folder that exists is written over or resumed. Only folders that were made here are taken away, and only
    empty ones.

    Args:
        folder: the run folder.

    Returns:
        The same, for the length of the `with` block.

    Raises:
        OSError: at once where nothing can be written.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        probe = folder / f".writable.{os.getpid()}"
        probe.touch()
        probe.unlink()
        yield folder
    except BaseException:
        for path in made:
            if any(path.iterdir()):
                break
            path.rmdir()
        raise


def peak_rss_bytes() -> int:
    """The most memory that this process has held.

    Returns:
        [bytes].
    """
    status = Path("/proc/self/status")
    for line in status.read_text().splitlines() if status.exists() else ():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    import resource  # not on Windows

    # Also counts the parent up to the fork, hence the second choice; macOS gives bytes, others kilobytes.
    unit = 1 if platform.system() == "Darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


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
