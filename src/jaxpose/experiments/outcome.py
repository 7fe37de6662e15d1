"""What a run of an experiment ends with: its folder, its results, and the words they have in common."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxpose._memory import peak_rss_bytes
from jaxpose.files import run_folder
from jaxpose.files.schema import choice
from jaxpose.files.untrusted import read_json

SMOKE = "  SMOKE RUN, the numbers mean nothing"


class Outcome(NamedTuple):
    """Where a run was written, and what its `results.json` holds."""

    folder: Path
    results: dict[str, Any]


def read_results(path: Path, experiment: str) -> dict[str, Any]:
    """What a finished run has found.

    Args:
        path: its `results.json`.
        experiment: of which it is.

    Returns:
        The content.

    Raises:
        DataError: for a damaged file, and for that of another experiment.
    """
    content = read_json(path, "the results of a run")
    choice(path, content, "experiment", (experiment,))
    return content


def cost(started: float) -> dict[str, Any]:
    """What a run has cost and on what, for its results.

    Args:
        started: `time.perf_counter()` at its start [s].

    Returns:
        Versions, wall time and memory.
    """
    return {
        "versions": run_folder.versions(),
        "wall_s": time.perf_counter() - started,
        "peak_rss_bytes": peak_rss_bytes(),
    }


def cost_text(results: dict[str, Any]) -> str:
    """The same in words."""
    memory = results["peak_rss_bytes"] / 2**30
    return f"{results['wall_s']:.0f} s in all, {memory:.2f} GiB of memory at most"


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, columns as wide as they need to be.

    Args:
        rows: of cells, the first one the head.

    Returns:
        Its lines.

    >>> print(markdown_table([("field", "rmse"), ("PoseNet", "0.1")]))
    | field   | rmse |
    |---------|------|
    | PoseNet | 0.1  |
    """
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def number(value: float | None, digits: int) -> str:
    """A cell of a table; n/a where there is no number."""
    return "n/a" if value is None else f"{value:.{digits}f}"
