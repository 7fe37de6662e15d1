"""The same training with many seeds, several at once: one table of medians and ranges, failures included.

`--commands` are the options of `jaxpose nerf` or `jaxpose events`, a row of the table each: `--commands ""
"--noise-translation 0.3"`, one alone `--commands="--noise-translation 0.3"`. Runs are processes of their own,
on this machine or, with `--scheduler tcp://HOST:PORT`, on a Dask cluster whose workers share the run folder;
`--resume` goes on where a study of the same folder was stopped, each run from its checkpoint.
"""

import json
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_least, check_positive, check_run_folder
from jaxpose.experiments.command import MODULE, Command, execute
from jaxpose.experiments.outcome import SMOKE, Outcome, cost, cost_text, markdown_table
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import atomic, run_folder

GROUPS = {
    "what": ("experiment", "commands", "seeds", "first_seed", "registered_deg", "smoke"),
    "run": ("out", "name", "resume", "processes", "scheduler", "json"),
}
# Options that are set here, or are not of one run.
_OWN = {"--seed", "--out", "--name", "--resume", "--smoke", "--json", "--study"}
_CONNECT_S = 10
_RUNNING: set[subprocess.Popen[str]] = set()  # in this process, to end them with it
_HEAD = ("options", "registered", "RE [deg]", "TE [%]", "PSNR [dB]", "train [s]")
_NUMBERS = ("rotation_error_deg", "translation_error_percent", "psnr", "train_s")


@dataclass(frozen=True)
class Config:
    """Which trainings, and how often."""

    experiment: Literal["nerf", "events"] = "nerf"
    commands: tuple[str, ...] = ("",)  # options of a row each, as one would type them
    seeds: int = 3
    first_seed: int = 0
    registered_deg: float = 1.0  # [deg] rotation error up to which a run counts as registered
    processes: int = 1  # at once; with --scheduler as many as it has workers
    scheduler: str | None = None  # of a Dask cluster (extra "cluster"); None: this machine
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    resume: bool = False  # keep the runs of the same folder that are finished, and go on with the others
    out: Path | None = None  # exactly this folder; None: outputs/seeds/<name or timestamp>
    name: str | None = None  # of the folder within outputs/seeds
    json: bool = False  # print the results as JSON and nothing else

    def __post_init__(self):
        check_least(self, seeds=1, first_seed=0, processes=1)
        check_positive(self, "registered_deg")
        check_run_folder(self)
        if len(set(self.commands)) < len(self.commands) or not self.commands:
            raise ValueError(f"--commands: expected at least one, each once, got {self.commands}")
        for command in self.commands:
            try:
                given = {word.split("=")[0] for word in shlex.split(command)} & _OWN
            except ValueError as error:
                raise ValueError(f"--commands: expected options, got {command!r}: {error}") from None
            if given:
                raise ValueError(f"--commands: expected no {min(given)}, it is set here, got {command!r}")


def run(config: Config, on_update: OnUpdate = silent) -> Outcome:
    """Run what is not yet done, and write the table of all.

    Args:
        config: which trainings, and how often.
        on_update: called with what the study is doing.

    Returns:
        The folder, and its results: of each row what its runs state.

    Raises:
        DataError, OSError: for a scheduler that does not answer, and folders that cannot be written.
    """
    started = time.perf_counter()
    path = run_folder.folder_path("seeds", name=config.name, out=config.out)
    on_update(Update(f"folder of the study {path}"))
    with run_folder.opened(path) as folder:
        found = _run_all(config, folder.resolve(), on_update)
        rows = [_stated(config, command, found) for command in config.commands]
        results = {
            "experiment": config.experiment,
            "seeds": config.seeds,
            "smoke": config.smoke,
            "rows": rows,
        }
        results |= cost(started)
        atomic.write_json(folder / "config.json", config)
        atomic.write_text(folder / "table.md", table(rows) + "\n")
        atomic.write_json(folder / "results.json", results)
        return Outcome(folder, results)


def one_run(command: list[str], out: str) -> dict[str, Any] | str:
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
def _pool(config: Config) -> Iterator[Executor]:
    """Threads that each wait for a process, or a cluster; what runs here ends with this process."""
    if config.scheduler is None:
        with ThreadPoolExecutor(config.processes) as pool:
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
        client = Client(config.scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        line = " ".join(str(error).split())
        raise DataError(f"--scheduler: expected one at {config.scheduler}, got {line}") from None
    with client:
        yield client.get_executor(pure=False)


def _run_all(config: Config, folder: Path, on_update: OnUpdate) -> dict[tuple[str, int], Any]:
    """What every run states, by its options and seed."""
    seeds = range(config.first_seed, config.first_seed + config.seeds)
    found: dict[tuple[str, int], Any] = {}
    with _pool(config) as pool:
        futures = {}
        for index, command in enumerate(config.commands):
            for seed in seeds:
                out = folder / "runs" / f"{index}-{seed}"
                words = [sys.executable, "-m", "jaxpose", config.experiment, *shlex.split(command)]
                words += ["--seed", str(seed), "--out", str(out), *(["--smoke"] if config.smoke else [])]
                words += ["--resume"] if config.resume and out.exists() else []
                futures[pool.submit(one_run, words, str(out))] = command, seed
        for future in as_completed(futures):
            command, seed = futures[future]
            found[command, seed] = future.result()
            last = {"last": f"{command} seed {seed}".strip()}
            on_update(Update("training", len(found), len(futures), "runs", last))
    return found


def _stated(config: Config, command: str, found: dict[tuple[str, int], Any]) -> dict[str, Any]:
    """A row of the results: medians and ranges over the seeds; None where no run states a number."""
    runs = {seed: run for (of, seed), run in sorted(found.items()) if of == command}
    good = {seed: run for seed, run in runs.items() if isinstance(run, dict)}
    numbers = {name: [run[name] for run in good.values() if run.get(name) is not None] for name in _NUMBERS}
    registered = [
        seed for seed, run in good.items() if run["rotation_error_deg"] is not None
        and run["rotation_error_deg"] <= config.registered_deg
    ]  # fmt: skip
    return {
        "options": command,
        "seeds": list(runs),
        "registered": registered,
        **{name: _spread(values) for name, values in numbers.items()},
        "failures": {seed: run for seed, run in runs.items() if isinstance(run, str)},
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"median": float(np.median(values)), "min": min(values), "max": max(values)}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows of the results as a table in Markdown: medians, and ranges where the seeds differ.

    Args:
        rows: of `results.json`.

    Returns:
        Its lines.
    """
    cells: list[Sequence[str]] = [_HEAD]
    for row in rows:
        failed = f", {len(row['failures'])} failed" if row["failures"] else ""
        cells.append((
            row["options"] or "(defaults)",
            f"{len(row['registered'])} of {len(row['seeds'])}{failed}",
            *(_cell(row[name], digits) for name, digits in zip(_NUMBERS, (3, 3, 2, 0), strict=True)),
        ))  # fmt: skip
    return markdown_table(cells)


def _cell(spread: dict[str, float] | None, digits: int) -> str:
    if spread is None:
        return "n/a"
    median, least, most = (f"{spread[name]:.{digits}f}" for name in ("median", "min", "max"))
    return median if least == most else f"{median} ({least} to {most})"


def report(outcome: Outcome) -> str:
    """What the command prints.

    Args:
        outcome: of `run`.

    Returns:
        The table, why runs failed, and where all is.
    """
    folder, results = outcome
    lines = [table(results["rows"]), ""]
    for row in results["rows"]:
        lines += [f"  failed       {row['options']} seed {k}: {line}" for k, line in row["failures"].items()]
    lines += [
        "  RE, TE       as `jaxpose nerf` and `jaxpose events` measure them; medians over the seeds (range)",
        f"  cost         {cost_text(results)}",
        f"  written to   {folder}",
    ]
    return "\n".join([*([SMOKE] if results["smoke"] else []), *lines])


def main(args: Sequence[str] | None = None) -> None:
    """The command `python -m jaxpose.experiments.seeds`."""
    execute(Command(MODULE + "seeds", Config, __doc__, run, report, GROUPS), args)


if __name__ == "__main__":
    main()
