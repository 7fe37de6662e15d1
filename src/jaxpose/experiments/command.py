"""What every command does: options to a config, known errors to one line, bars, tables."""

import io
import json
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any, TypeVar

import platformdirs
import tyro
from tqdm import tqdm

from jaxpose.errors import DataError

Config = TypeVar("Config")


def parse(
    name: str,
    config_type: Callable[..., Config],
    description: str | None,
    args: Sequence[str] | None = None,
    *,
    prog: str | None = None,
) -> Config:
    """The config that the command line asks for; exits with one line and code 1 if it asks for what is not.

    `--help` prints and exits with 0, as usual; there the command is called `prog`, by default that of an
    experiment.
    """
    prog = prog or f"python -m jaxpose.experiments.{name}"
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(config_type, prog=prog, description=description, args=args)
    except SystemExit as stop:
        if not stop.code:
            raise
        sys.exit(f"{name}: {_one_line(complaint.getvalue())}")
    except ValueError as error:  # a config that does not allow its values
        sys.exit(f"{name}: {error}")


def check_least(config: Any, **least: int | float) -> None:
    """ValueError for an option (or an entry of one) below its least value, infinite or NaN; None is free."""
    for name, smallest in least.items():
        values = getattr(config, name)
        for value in values if isinstance(values, tuple) else (values,):
            if value is not None and not smallest <= value < math.inf:
                option = name.replace("_", "-")
                raise ValueError(f"--{option}: expected at least {smallest}, got {value}")


def check_resume(config: Any) -> None:
    """ValueError for `resume` without the folder of the run to go on with."""
    if config.resume and config.out is None and config.name is None:
        raise ValueError("--resume: expected --out DIR or --name NAME with it")


def guarded(name: str, action: Callable[[], str]) -> None:
    """Print what `action` returns; what the user can mend ends in one line on stderr and code 1."""
    _keep_compiled()
    try:
        print(action())
    except (DataError, OSError) as error:
        sys.exit(f"{name}: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit(f"{name}: interrupted")


def _keep_compiled() -> None:
    """Keep what is compiled in the user's cache folder, so that the next start does not compile it again.

    What the user has told JAX goes first: JAX_COMPILATION_CACHE_DIR names another folder, and
    JAX_ENABLE_COMPILATION_CACHE=false keeps nothing.
    """
    settings = {
        "jax_compilation_cache_dir": platformdirs.user_cache_dir("jaxpose"),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    for name, value in settings.items():
        if name.upper() in os.environ:
            continue
        os.environ[name.upper()] = str(value)  # for JAX, if a command loads it later, and for its children
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)


def step_bar() -> Callable[[str, int, int, dict[str, str]], None]:
    """Draws a bar on stderr for each optimisation: call it with name, steps done, steps in all, and state."""
    bar: tqdm | None = None
    done = 0

    def on_step(name: str, step: int, steps: int, state: dict[str, str]) -> None:
        nonlocal bar, done
        if bar is None:
            bar, done = tqdm(total=steps, desc=name, unit="step", file=sys.stderr), 0
        bar.set_postfix(state, refresh=False)
        bar.update(step - done)
        done = step
        if step == steps:
            bar.close()
            bar = None

    return on_step


def resumes(folder: Path, stored: Path, settings: dict[str, Any], resume: bool) -> bool:
    """Whether what a run folder holds is to be kept: on `resume`, if `stored` says that it is a run's.

    DataError where it is that of a run with other settings (in JSON's types).
    """
    if not (resume and stored.exists()):
        return False
    before = json.loads(stored.read_text())
    for name, value in settings.items():
        if before.get(name) != value:
            option = name.replace("_", "-")
            raise DataError(f"{folder}: expected --{option} {before.get(name)}, as it began, got {value}")
    return True


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as a table in Markdown, the first its head, columns as wide as they need to be."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def number(value: float | None, digits: int) -> str:
    """A cell of a table; n/a where there is nothing to tell."""
    return "n/a" if value is None else f"{value:.{digits}f}"


def _one_line(boxed: str) -> str:
    """Tyro's message without its frame, its title and what it says about --help."""
    lines = [re.sub(r"[─│╭╮╰╯-]{3,}|[│╭╮╰╯]", " ", line).strip() for line in boxed.splitlines()]
    lines = [line for line in lines if line][1:]
    ends = [k for k, line in enumerate(lines) if line.startswith(("For full helptext", "Argument helptext"))]
    return " ".join(" ".join(lines[: ends[0]] if ends else lines).split())
