"""Kill runs at random moments and resume them: `python tests/kill/run.py --kills 100`.

Each experiment (`--smoke`, a checkpoint after every step it can save, its bar on a terminal) is first left
alone. Then it is started again, killed by SIGKILL after a random share of that time, once or twice, and
resumed. It holds if the numbers of the files that it leaves are those of the run left alone, to the last
digit, and the files are the same. What was measured of time and memory is not compared.
"""

import argparse
import importlib
import json
import multiprocessing
import os
import pty
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path
from random import Random
from typing import Any

EXPERIMENTS = ("planar", "noisy_nerf", "event_nerf", "rgbd_slam")
OPTIONS = {"planar": ("--motions", "3"), "event_nerf": ("--image-width", "16")}
MEASURED = {"wall_s", "peak_rss_bytes", "train_s", "versions", "history_columns"}
CONTEXT = multiprocessing.get_context("forkserver")


def run(experiment: str, out: str, resume: bool, terminal: str, log: str) -> None:
    """A run, in a process of its own."""
    stream = os.open(terminal, os.O_RDWR)
    os.dup2(stream, 2)
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), 1)
    from jaxpose.experiments import training_loop
    from jaxpose.experiments.slam import checkpointing

    training_loop._SAVE_EVERY_S = checkpointing.SAVE_EVERY_S = 0.0
    module = importlib.import_module(f"jaxpose.experiments.{experiment}")
    if not hasattr(module, "main"):
        module = importlib.import_module(f"jaxpose.experiments.{experiment}.pipeline")
    args = ["--smoke", *OPTIONS.get(experiment, ()), "--out", out, *(["--resume"] if resume else [])]
    module.main(args)


class Started:
    """A run that was started on a terminal of its own, which is read away."""

    def __init__(self, experiment: str, out: Path, resume: bool):
        self.master, self.slave = pty.openpty()
        self.said = b""
        threading.Thread(target=self._drain, daemon=True).start()
        args = (experiment, str(out), resume, os.ttyname(self.slave), str(out.with_suffix(".log")))
        self.process = CONTEXT.Process(target=run, args=args)
        self.process.start()

    def _drain(self) -> None:
        try:
            while read := os.read(self.master, 4096):
                self.said = (self.said + read)[-2000:]
        except OSError:
            pass

    def ended(self, timeout: float | None = None) -> int | None:
        """Its exit code once it has ended; None where it has not after a time [s]."""
        self.process.join(timeout)
        if self.process.exitcode is not None:
            os.close(self.slave)
            os.close(self.master)
        return self.process.exitcode


def compared(value: Any) -> Any:
    """What is the same in every run, of results."""
    if isinstance(value, dict):
        columns = value.get("history_columns", ())
        kept = {k: v for k, v in value.items() if k not in MEASURED and not k.startswith("seconds")}
        if "history" in kept:
            kept["history"] = [
                [x for x, name in zip(row, columns, strict=True) if "second" not in name and name != "s"]
                for row in kept["history"]
            ]
        return {k: compared(v) for k, v in kept.items()}
    return [compared(entry) for entry in value] if isinstance(value, list) else value


def digits(folder: Path) -> dict[str, Any]:
    """The numbers of a run's files by their names; None for those of pictures and of what it was told."""
    import numpy as np

    found: dict[str, Any] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = str(path.relative_to(folder))
        found[name] = None
        if path.suffix == ".json" and path.name not in ("config.json", "camera.json"):
            found[name] = compared(json.loads(path.read_text()))
        elif path.suffix in (".txt", ".ply"):
            found[name] = path.read_bytes()
        elif path.suffix == ".npz" and path.name != "checkpoint.npz":
            with np.load(path) as arrays:
                found[name] = {key: arrays[key].tobytes() for key in arrays}
    return found


def difference(whole: dict[str, Any], killed: dict[str, Any]) -> str:
    """The first file that differs; empty where none does."""
    if whole.keys() != killed.keys():
        return f"files {sorted(whole.keys() ^ killed.keys())}"
    return next((f"numbers of {name}" for name in whole if whole[name] != killed[name]), "")


def trial(experiment: str, out: Path, seconds: float, random: Random) -> tuple[int, str]:
    """How often a run was killed before it ended, and what went wrong."""
    kills, planned = 0, random.choice((1, 1, 2, 3))
    while True:
        started = Started(experiment, out, resume=out.exists())
        code = started.ended(random.uniform(0, seconds) if kills < planned else None)
        if code is None:
            started.process.kill()
            started.ended()
            kills += 1
        elif code == 0:
            return kills, ""
        else:
            return kills, f"exit code {code}: {started.said[-300:].decode(errors='replace').strip()}"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--experiments", nargs="+", default=EXPERIMENTS, choices=EXPERIMENTS)
    options = parser.parse_args()
    random, kills, runs, faults = Random(options.seed), 0, 0, []
    with tempfile.TemporaryDirectory() as where:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", f"{where}/cache")
        modules = [f"jaxpose.experiments.{name}.pipeline" for name in ("planar", "noisy_nerf", "event_nerf")]
        CONTEXT.set_forkserver_preload([*modules, "jaxpose.experiments.rgbd_slam"])
        wholes: dict[str, tuple[float, dict[str, Any]]] = {}
        for name in options.experiments:
            for again in range(2):  # the first compiles
                out, began = Path(where) / f"{name}_whole_{again}", time.monotonic()
                started = Started(name, out, False)
                assert started.ended() == 0, started.said.decode(errors="replace")
                seconds, found = time.monotonic() - began, digits(out)
            wholes[name] = seconds, found
            if wrong := difference(found, digits(Path(where) / f"{name}_whole_0")):
                print(f"{name}: two runs left alone differ in {wrong}", flush=True)
            print(f"{name}: {seconds:.1f} s, {len(found)} files", flush=True)
        while kills < options.kills:
            name = options.experiments[runs % len(options.experiments)]
            out = Path(where) / f"{runs}"
            seconds, whole = wholes[name]
            count, wrong = trial(name, out, seconds, random)
            kills, runs = kills + count, runs + 1
            if wrong := wrong or difference(whole, digits(out)):
                faults.append(f"{name}, run {runs}, killed {count} times: {wrong}")
                print(faults[-1], flush=True)
            shutil.rmtree(out, ignore_errors=True)
            print(f"{runs} runs, {kills} kills, {len(faults)} faults", flush=True)
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
