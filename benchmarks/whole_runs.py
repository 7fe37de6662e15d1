"""Whole runs of this tree and of another commit, side by side: the default SLAM run, cold and warm.

Cold is with an empty compilation cache, warm right after. The two trees take turns, so that a machine whose
speed drifts is fair to both. Seconds of processor time and of the clock, the memory of each.
The other commit is checked out in a temporary folder; both run with this Python and its packages.

    python benchmarks/whole_runs.py --help
"""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from timing import machine

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Config:
    """What to run, against which commit, how often."""

    commit: str = "92f55ee"
    command: str = "-m jaxpose.experiments.imu_slam"  # arguments of Python
    repeats: int = 3


class Run(NamedTuple):
    """What one process took."""

    wall_s: float
    cpu_s: float
    peak_gib: float


def measured(tree: Path, command: str, cache: Path, out: Path) -> Run:
    """One run of a tree's package in a process of its own."""
    environment = os.environ | {
        "PYTHONPATH": str(tree / "src"),
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
    began = time.perf_counter()
    arguments = [sys.executable, *command.split(), "--out", str(out)]
    process = subprocess.Popen(
        arguments, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{tree}: {command} ended with {os.waitstatus_to_exitcode(status)}")
    return Run(time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20)


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    print(machine())
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        other = folder / config.commit
        subprocess.run(["git", "-C", ROOT, "worktree", "add", "--detach", other, config.commit], check=True)
        try:
            runs: dict[tuple[str, str], list[Run]] = {}
            for k in range(config.repeats):
                for name, tree in ((config.commit, other), ("this tree", ROOT)):
                    for kind in ("cold", "warm"):
                        run = measured(
                            tree, config.command, folder / f"{name}-{k}", folder / f"{name}-{k}-{kind}"
                        )
                        runs.setdefault((kind, name), []).append(run)
                        took = f"{run.wall_s:.0f} s, {run.cpu_s:.0f} CPU s, {run.peak_gib:.2f} GiB"
                        print(f"  {kind} {name}: {took}", flush=True)
        finally:
            subprocess.run(["git", "-C", ROOT, "worktree", "remove", "--force", other], check=True)
    for kind in ("cold", "warm"):
        before, now = (np.array(runs[kind, name]) for name in (config.commit, "this tree"))
        ratio = now / before
        print(
            f"{kind}: ratios to {config.commit}, median (range) of {config.repeats}: clock "
            f"{np.median(ratio[:, 0]):.2f} ({ratio[:, 0].min():.2f} to {ratio[:, 0].max():.2f}), processor "
            f"{np.median(ratio[:, 1]):.2f} ({ratio[:, 1].min():.2f} to {ratio[:, 1].max():.2f})"
        )


if __name__ == "__main__":
    main()
