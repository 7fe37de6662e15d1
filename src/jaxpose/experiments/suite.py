"""The tracker on many recordings at once: every change of a constant is judged on all of them.

Recordings x rates x seeds, and the synthetic room as each kind of depth sensor sees it, without an IMU; one
table and one picture of medians with their ranges, failures included. Runs are `jaxpose slam` in processes of
their own; `--resume` goes on where a suite of the same folder was stopped.
"""

import os
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args

from jaxpose.datasets.synthetic.depth_sensors import Sensor
from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_least, check_positive, check_run_folder
from jaxpose.experiments.command import MODULE, Command, execute
from jaxpose.experiments.many_runs import Job, run_all, spread, spread_text
from jaxpose.experiments.outcome import SMOKE, Outcome, cost, cost_text, markdown_table
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import atomic, run_folder
from jaxpose.plots import suite as suite_plots

GROUPS = {
    "what": ("data", "rates_hz", "sensors", "seeds", "smoke"),
    "run": ("out", "name", "resume", "processes", "json"),
}
_HEAD = ("recording", "rate", "ATE [cm]", "RPE [cm]", "lost", "uncertain", "wrong told", "s/frame", "MB")


@dataclass(frozen=True)
class Config:
    """Which recordings, and how often."""

    data: tuple[Path, ...] = ()  # folders of recordings, at all of their frames and at each of --rates-hz
    rates_hz: tuple[float, ...] = ()  # [Hz] that recordings are thinned to
    sensors: tuple[Sensor, ...] = get_args(Sensor)  # of the synthetic room's depth, each at 5 Hz
    seeds: int = 3
    processes: int = max((os.cpu_count() or 2) // 2, 1)  # at once
    smoke: bool = False  # everything shrunk to seconds; the numbers then mean nothing
    resume: bool = False  # keep the runs of the same folder that are finished, and go on with the others
    out: Path | None = None  # exactly this folder; None: outputs/suite/<name or timestamp>
    name: str | None = None  # of the folder within outputs/suite
    json: bool = False  # print the results as JSON and nothing else

    def __post_init__(self):
        check_least(self, seeds=1, processes=1)
        check_positive(self, "rates_hz")
        check_run_folder(self, *self.data)
        if not self.data and not self.sensors:
            raise ValueError("--data: expected recordings, or --sensors of the room, got neither")


class Case(NamedTuple):
    """What is run once a seed."""

    recording: str
    rate: str
    args: tuple[str, ...]  # of `jaxpose slam`


class Row(NamedTuple):
    """All seeds of a case: what each run stated, and why others ended without."""

    case: Case
    results: tuple[dict[str, Any], ...]
    failures: tuple[str, ...]  # one line each


def cases(config: Config) -> Iterator[Case]:
    """What there is to run, in order.

    Args:
        config: which recordings and sensors.

    Returns:
        Each recording at all frames and at each rate, then the room with each sensor.
    """
    names = [folder.resolve().name for folder in config.data]
    for folder, name in zip(config.data, names, strict=True):
        recording = name if names.count(name) == 1 else str(folder)
        yield Case(recording, "all", ("--data", str(folder)))
        for rate_hz in config.rates_hz:
            yield Case(recording, f"{rate_hz:g} Hz", ("--data", str(folder), "--rate-hz", f"{rate_hz:g}"))
    for sensor in config.sensors:
        yield Case(f"room, {sensor.replace('_', ' ')}", "5 Hz", ("--room.sensor", sensor))


def run(config: Config, on_update: OnUpdate = silent) -> Outcome:
    """Run what is not yet done, and write the table and the picture of all.

    Args:
        config: which recordings, and how often.
        on_update: called with what the suite is doing.

    Returns:
        The folder, and its results: of each case what its runs state.

    Raises:
        DataError, OSError: for folders that are not there, or cannot be written.
    """
    started = time.perf_counter()
    for folder in config.data:
        if not folder.is_dir():
            raise DataError(f"{folder}: expected a folder of a recording, got nothing")
    todo = list(cases(config))
    path = run_folder.folder_path("suite", name=config.name, out=config.out)
    on_update(Update(f"suite folder {path}"))
    with run_folder.opened(path) as folder:
        rows = _run_all(config, todo, folder, on_update)
        results = {"seeds": config.seeds, "smoke": config.smoke, "rows": [_stated(row) for row in rows]}
        results |= cost(started)
        atomic.write_json(folder / "config.json", config)
        atomic.write_text(folder / "table.md", table(results["rows"]) + "\n")
        suite_plots.accuracy(folder / "suite.png", results["rows"])
        atomic.write_json(folder / "results.json", results)
        return Outcome(folder, results)


def _run_all(config: Config, todo: list[Case], folder: Path, on_update: OnUpdate) -> list[Row]:
    """Every case with every seed."""
    jobs = {
        (case, seed): Job(
            ["slam", "--imu", "none", *case.args, "--seed", str(seed)],
            folder / "runs" / re.sub(r"[^\w.]+", "-", f"{case.recording}-{case.rate}-{seed}"),
        )
        for case in todo
        for seed in range(config.seeds)
    }

    def told(key: tuple[Case, int], done: int) -> None:
        last = {"last": f"{key[0].recording}, {key[0].rate}, seed {key[1]}"}
        on_update(Update("tracking", done, len(jobs), "runs", last))

    found = run_all(jobs, processes=config.processes, smoke=config.smoke, resume=config.resume, on_done=told)
    rows = []
    for case in todo:
        of_case = [found[case, seed] for seed in range(config.seeds)]
        good = tuple(x for x in of_case if isinstance(x, dict))
        rows.append(Row(case, good, tuple(x for x in of_case if isinstance(x, str))))
    return rows


def _stated(row: Row) -> dict[str, Any]:
    """A row of the results: medians and ranges over the seeds; None where no run states a number."""
    numbers = {
        "ate_m": [r.get("ate_rmse_m") for r in row.results],
        "rpe_m": [(r.get("rpe") or {}).get("translation_rmse_m") for r in row.results],
        "frames_lost": [r["frames_lost"] for r in row.results],
        "frames_uncertain": [r["frames_uncertain"] for r in row.results],
        "frames_wrong": [r.get("frames_wrong") for r in row.results],
        "frames_wrong_and_marked": [r.get("frames_wrong_and_marked") for r in row.results],
        "seconds_per_frame": [r["seconds_per_frame"] for r in row.results],
        "peak_rss_bytes": [r["peak_rss_bytes"] for r in row.results],
    }
    frames = row.results[0]["frames"] if row.results else None
    spreads = {name: spread(values) for name, values in numbers.items()}
    case = {"recording": row.case.recording, "rate": row.case.rate, "frames": frames}
    return {**case, **spreads, "failures": list(row.failures)}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows of the results as a table in Markdown: medians, and ranges where the seeds differ.

    Args:
        rows: of `results.json`.

    Returns:
        Its lines.
    """
    cells: list[Sequence[str]] = [_HEAD]
    for row in rows:
        wrong, told = row["frames_wrong"], row["frames_wrong_and_marked"]
        failed = f", {len(row['failures'])} failed" if row["failures"] else ""
        cells.append((
            row["recording"],
            row["rate"],
            spread_text(row["ate_m"], 2, 100) + failed,
            spread_text(row["rpe_m"], 2, 100),
            spread_text(row["frames_lost"], 0) + ("" if row["frames"] is None else f" of {row['frames']}"),
            spread_text(row["frames_uncertain"], 0),
            "n/a" if wrong is None else f"{told['median']:.0f} of {wrong['median']:.0f}",
            spread_text(row["seconds_per_frame"], 2),
            spread_text(row["peak_rss_bytes"], 0, 1 / 2**20),
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
        lines += [f"  failed       {row['recording']}, {row['rate']}: {line}" for line in row["failures"]]
    lines += [
        "  ATE          RMSE after SE(3) alignment; RPE from frame to frame; medians over the seeds (range)",
        "  wrong told   of the frames that are more than 10 cm or 5 degrees off, how many are marked",
        f"  cost         {cost_text(results)}",
        f"  written to   {folder}",
    ]
    return "\n".join([*([SMOKE] if results["smoke"] else []), *lines])


def main(args: Sequence[str] | None = None) -> None:
    """The command `python -m jaxpose.experiments.suite`."""
    execute(Command(MODULE + "suite", Config, __doc__, run, report, GROUPS), args)


if __name__ == "__main__":
    main()
