"""Many runs of `jaxpose`, several at once, each in a process of its own: what they state, and its spread."""

import json
import subprocess
import sys
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from jaxpose.errors import DataError

_CONNECT_S = 10
_RUNNING: set[subprocess.Popen[str]] = set()  # in this process, to end them with it

Key = TypeVar("Key", bound=Hashable)
Stated = dict[str, Any] | str  # the results of a run; one line where it ended without


class Job(NamedTuple):
    """One run."""

    words: Sequence[str]  # of `jaxpose`, but for those of `run_all`
    out: Path  # its run folder


def run_all(
    jobs: Mapping[Key, Job],
    *,
    processes: int,
    smoke: bool,
    resume: bool,
    scheduler: str | None = None,
    on_done: Callable[[Key, int], None],
) -> dict[Key, Stated]:
    """Run all jobs; none goes on without this process, but for those on a cluster.

    Args:
        jobs: what is run, by any names.
        processes: how many at once.
        smoke: everything shrunk to seconds.
        resume: go on in the run folders that are there.
        scheduler: HOST:PORT of a Dask cluster (extra `cluster`) whose workers run them; None: this machine.
        on_done: called with the name of each that has ended, and how many have.

    Returns:
        What every run states, by the jobs' names.

    Raises:
        DataError: for a scheduler that does not answer.
    """
    found: dict[Key, Stated] = {}
    with _pool(processes, scheduler) as pool:
        futures = {}
        for key, (words, out) in jobs.items():
            command = [sys.executable, "-m", "jaxpose", *words, "--out", str(out)]
            command += ["--smoke"] if smoke else []
            command += ["--resume"] if resume and out.exists() else []
            futures[pool.submit(one_run, command, str(out))] = key
        for future in as_completed(futures):
            key = futures[future]
            found[key] = future.result()
            on_done(key, len(found))
    return found


def one_run(command: list[str], out: str) -> Stated:
    """Run a command in a process of its own, here or on a worker of a cluster.

    Args:
        command: its words.
        out: its run folder.

    Returns:
        What its `results.json` holds; one line where it ended without.
    """
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, encoding="utf-8", errors="replace"
    )
    _RUNNING.add(process)
    lines = process.communicate()[1].strip().splitlines()
    _RUNNING.discard(process)
    if process.returncode:
        return lines[-1] if lines else f"ended with {process.returncode}"
    return json.loads((Path(out) / "results.json").read_text("utf-8"))


@contextmanager
def _pool(processes: int, scheduler: str | None) -> Iterator[Executor]:
    """Threads that each wait for a process, or a cluster; what runs here ends with this process."""
    if scheduler is None:
        with ThreadPoolExecutor(processes) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for process in tuple(_RUNNING):
                    process.kill()
                raise
        return
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DataError('--scheduler: expected Dask, pip install -e ".[cluster]", got none') from None
    try:
        client = Client(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        line = " ".join(str(error).split())
        raise DataError(f"--scheduler: expected one at {scheduler}, got {line}") from None
    with client:
        yield client.get_executor(pure=False)


def spread(values: Sequence[float | None]) -> dict[str, float] | None:
    """Median and range over runs.

    Args:
        values: what they state; None where one states nothing.

    Returns:
        `median`, `min` and `max`; None where no run states a number.
    """
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"median": float(np.median(known)), "min": min(known), "max": max(known)}


def spread_text(spread: Mapping[str, float] | None, digits: int, scale: float | int = 1) -> str:
    """A cell of a table: the median, and the range where runs differ.

    Args:
        spread: of `spread`.
        digits: behind the point.
        scale: what numbers are multiplied by.

    Returns:
        The text; n/a where no run states a number.
    """
    if spread is None:
        return "n/a"
    median, least, most = (f"{scale * spread[name]:.{digits}f}" for name in ("median", "min", "max"))
    return median if least == most else f"{median} ({least} to {most})"
