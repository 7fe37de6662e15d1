"""The same training with many seeds, several at once: one table of medians and ranges, failures included.

`--commands` are the options of `jaxpose nerf` or `jaxpose events`, a row of the table each: `--commands ""
"--noise-translation 0.3"`, one alone `--commands="--noise-translation 0.3"`. Runs are processes of their own,
on this machine or, with `--scheduler tcp://HOST:PORT`, on a Dask cluster whose workers share the run folder;
`--resume` goes on where a study of the same folder was stopped, each run from its checkpoint.
"""

import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxpose.experiments.checks import check_least, check_positive, check_run_folder
from jaxpose.experiments.command import MODULE, Command, execute
from jaxpose.experiments.many_runs import Job, Stated, run_all, spread, spread_text
from jaxpose.experiments.outcome import SMOKE, Outcome, cost, cost_text, markdown_table
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import atomic, run_folder

GROUPS = {
    "what": ("experiment", "commands", "seeds", "first_seed", "registered_deg", "smoke"),
    "run": ("out", "name", "resume", "processes", "scheduler", "json"),
}
# Options that are set here, or are not of one run.
_OWN = {"--seed", "--out", "--name", "--resume", "--smoke", "--json", "--study"}
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


def _run_all(config: Config, folder: Path, on_update: OnUpdate) -> dict[tuple[str, int], Stated]:
    """What every run states, by its options and seed."""
    jobs = {
        (command, seed): Job(
            [config.experiment, *shlex.split(command), "--seed", str(seed)],
            folder / "runs" / f"{index}-{seed}",
        )
        for index, command in enumerate(config.commands)
        for seed in range(config.first_seed, config.first_seed + config.seeds)
    }

    def told(key: tuple[str, int], done: int) -> None:
        last = {"last": f"{key[0]} seed {key[1]}".strip()}
        on_update(Update("training", done, len(jobs), "runs", last))

    return run_all(
        jobs,
        processes=config.processes,
        smoke=config.smoke,
        resume=config.resume,
        scheduler=config.scheduler,
        on_done=told,
    )


def _stated(config: Config, command: str, found: dict[tuple[str, int], Any]) -> dict[str, Any]:
    """A row of the results: medians and ranges over the seeds; None where no run states a number."""
    runs = {seed: run for (of, seed), run in sorted(found.items()) if of == command}
    good = {seed: run for seed, run in runs.items() if isinstance(run, dict)}
    numbers = {name: spread([run.get(name) for run in good.values()]) for name in _NUMBERS}
    registered = [
        seed for seed, run in good.items() if run["rotation_error_deg"] is not None
        and run["rotation_error_deg"] <= config.registered_deg
    ]  # fmt: skip
    return {
        "options": command,
        "seeds": list(runs),
        "registered": registered,
        **numbers,
        "failures": {seed: run for seed, run in runs.items() if isinstance(run, str)},
    }


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
            *(spread_text(row[name], digits) for name, digits in zip(_NUMBERS, (3, 3, 2, 0), strict=True)),
        ))  # fmt: skip
    return markdown_table(cells)


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
