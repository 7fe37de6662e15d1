"""What every command does: options to a config, known errors to one line, progress, help."""

import importlib
import io
import os
import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import redirect_stderr
from typing import Any, NamedTuple, NoReturn

import platformdirs
import tyro

from jaxpose.errors import DataError
from jaxpose.experiments import progress
from jaxpose.experiments.option_help import Groups, help_text
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.files.atomic import json_text

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
    with progress.shown() as on_update:
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
    _say(json_text(result) if getattr(config, "json", False) else command.report(result))
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
            _say(help_text(*what, everything=everything))
            sys.exit(0)
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(
                command.config, prog=command.prog, args=args, config=(tyro.conf.FlagCreatePairsOff,)
            )
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
        with progress.shown() as on_update:
            return action(on_update)
    except (DataError, OSError) as error:
        fail(name, str(error))
    except KeyboardInterrupt:
        fail(name, "interrupted")


def fail(name: str, message: str) -> NoReturn:
    """Exit with code 1 and one line on stderr."""
    sys.exit(f"{name}: {' '.join(message.split())}")


def _say(text: str) -> None:
    """Print to a reader that may have gone, as `head` does."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # what Python flushes at its end


def _keep_compiled() -> None:
    """Keep what is compiled in the user's cache folder, so that the next start does not compile it again.

    What the user has set for JAX goes first: JAX_COMPILATION_CACHE_DIR names another folder, and
    JAX_ENABLE_COMPILATION_CACHE=false keeps nothing.
    """
    settings: Mapping[str, Any] = {
        "jax_compilation_cache_dir": platformdirs.user_cache_dir("jaxpose"),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    for name, value in settings.items():
        if name.upper() in os.environ:
            continue
        os.environ[name.upper()] = str(value)  # for JAX, if a command loads it later, and for its children
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)


def _one_line(boxed: str) -> str:
    """Tyro's message without its frame, its title and what it says about --help."""
    lines = [re.sub(r"[─│╭╮╰╯-]{3,}|[│╭╮╰╯]", " ", line).strip() for line in boxed.splitlines()]
    lines = [line for line in lines if line][1:]
    ends = [k for k, line in enumerate(lines) if line.startswith(("For full helptext", "Argument helptext"))]
    message = " ".join(" ".join(lines[: ends[0]] if ends else lines).split())
    message = re.sub(r"^Error parsing \w+: ", "", message)
    return re.sub(r" (Perhaps you meant: --[\w.-]+).*", r"; \1", message)
