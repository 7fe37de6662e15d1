"""What every command does: options to a config, known errors to one line, progress, help."""

import importlib
import io
import os
import re
import sys
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext, redirect_stderr
from pathlib import Path
from typing import Any, NamedTuple

import platformdirs
import tyro

from jaxpose._terminal import ended_by_interrupt, fail, interruptible, prepare, say
from jaxpose.errors import DataError
from jaxpose.experiments import progress
from jaxpose.experiments.option_help import Groups, help_text
from jaxpose.experiments.outcome import Outcome
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.experiments.ranges import check_ranges
from jaxpose.files.atomic import json_text
from jaxpose.files.untrusted import reading

CACHE_BYTES = 2 << 30  # of compiled steps, at most, when a command starts
MODULE = "python -m jaxpose.experiments."


class Command(NamedTuple):
    """A command: its options, what it does with them, and what it prints then."""

    prog: str  # as it is typed
    config: type
    description: str | None
    run: Callable[[Any, OnUpdate], Any]
    report: Callable[[Any], str]
    groups: Groups = {}  # noqa: RUF012 - never written to
    hidden: Collection[str] = ()  # paths of fields that are no options

    @property
    def name(self) -> str:
        """What its errors begin with."""
        return self.prog.removeprefix(MODULE)


def start(module: str, args: Sequence[str] | None = None, **given: Any) -> None:
    """Load the module of a command and call its `main`; a line on stderr says so if that takes long.

    Args:
        module: where `main(args, **given)` is.
        args: the command line; None is that of this process.
        given: what else `main` takes.
    """
    prepare()
    name = given.get("prog", "jaxpose")
    with interruptible(name):
        with ended_by_interrupt(name), progress.shown() as on_update:
            on_update(Update("loading jaxpose", quiet=True))
            main = importlib.import_module(module).main
        main(args, **given)


def execute(command: Command, args: Sequence[str] | None = None) -> Any:
    """Parse the command line, run the command and print its report, or with `--json` its result.

    Exits with one line on stderr and code 1 for what the user can mend.

    Args:
        command: the command.
        args: the command line; None is that of this process.

    Returns:
        What the command's `run` returns.
    """
    config = parse(command, args)
    result = guarded(command.name, lambda on_update: command.run(config, on_update))
    results = result.folder / "results.json" if isinstance(result, Outcome) else None
    resumed = results is not None and getattr(config, "resume", False)
    try:
        with reading(results, "the results of this run") if resumed and results else nullcontext():
            said = json_text(result) if getattr(config, "json", False) else command.report(result)
    except DataError as error:
        fail(command.name, str(error))
    say(command.name, said)
    return result


def parse(command: Command, args: Sequence[str] | None = None) -> Any:
    """The config that the command line asks for.

    Exits with one line and code 1 for options that mean nothing; `--help` and `--help-all` exit with 0.

    Args:
        command: the command.
        args: the command line; None is that of this process.

    Returns:
        The config.
    """
    args = sys.argv[1:] if args is None else list(args)
    for asked, everything in (("--help", False), ("-h", False), ("--help-all", True)):
        if asked in args:
            about = command.description or ""
            what = command.prog, command.config, about, command.groups, command.hidden
            say(command.name, help_text(*what, everything=everything))
            sys.exit(0)
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            config = tyro.cli(
                command.config, prog=command.prog, args=args, config=(tyro.conf.FlagCreatePairsOff,)
            )
        check_ranges(config)
        return config
    except SystemExit as stop:
        if not stop.code:
            raise
        fail(command.name, _one_line(complaint.getvalue()))
    except ValueError as error:  # a config that does not allow its values
        fail(command.name, str(error))


def guarded(name: str, action: Callable[[OnUpdate], Any]) -> Any:
    """Do what may fail, with its progress on stderr.

    What the user can mend ends in one line on stderr and code 1.

    Args:
        name: what that line begins with.
        action: what to do; it is given the function to call with each `Update`.

    Returns:
        What `action` returns.
    """
    _keep_compiled()
    try:
        with interruptible(name), progress.shown() as on_update:
            return action(on_update)
    except (DataError, OSError) as error:
        fail(name, str(error))


def _keep_compiled() -> None:
    """Keep what is compiled in the user's cache folder, so that the next start does not compile it again.

    What the user has set for JAX goes first: JAX_COMPILATION_CACHE_DIR names another folder, and
    JAX_ENABLE_COMPILATION_CACHE=false keeps nothing.
    """
    settings: dict[str, Any] = {"jax_persistent_cache_min_compile_time_secs": 0.0}
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = Path(platformdirs.user_cache_dir("jaxpose"))
        if not _is_own(folder):
            print(f"  compiled steps are not kept: {folder} is not this user's alone", file=sys.stderr)
            return
        _shrink(folder)
        settings["jax_compilation_cache_dir"] = str(folder)
    for name, value in settings.items():
        if name.upper() in os.environ:
            continue
        os.environ[name.upper()] = str(value)  # for JAX, if a command loads it later, and for its children
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)


def _is_own(folder: Path) -> bool:
    """Make a folder for this user alone, as it is to hold programs; False where it is somebody else's."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = folder.stat()
        if hasattr(os, "getuid") and found.st_uid != os.getuid():
            return False
        if found.st_mode & 0o022:
            folder.chmod(found.st_mode & 0o755)
    except OSError:
        return False
    return True


def _shrink(folder: Path) -> None:
    """Delete the oldest files of a folder until the others are within the limit, and some more."""
    try:
        files = [(entry.stat(), entry.path) for entry in os.scandir(folder) if entry.is_file()]
    except OSError:  # another command deletes too
        return
    size = sum(found.st_size for found, _ in files)
    if size <= CACHE_BYTES:
        return
    for found, path in sorted(files, key=lambda file: file[0].st_mtime):
        if size <= 0.75 * CACHE_BYTES:
            return
        size -= found.st_size
        Path(path).unlink(missing_ok=True)


def _one_line(boxed: str) -> str:
    """Tyro's message without its frame, its title and what it says about --help."""
    lines = [re.sub(r"[─│╭╮╰╯-]{3,}|[│╭╮╰╯]", " ", line).strip() for line in boxed.splitlines()]
    lines = [line for line in lines if line][1:]
    ends = [k for k, line in enumerate(lines) if line.startswith(("For full helptext", "Argument helptext"))]
    message = " ".join(" ".join(lines[: ends[0]] if ends else lines).split())
    message = re.sub(r"^Error parsing \w+: ", "", message)
    return re.sub(r" (Perhaps you meant: --[\w.-]+).*", r"; \1", message)
