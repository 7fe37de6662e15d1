"""The command `jaxpose`: its subcommands, each loaded only when it is asked for."""

import difflib
import sys
from collections.abc import Sequence
from typing import NamedTuple

import jaxpose
from jaxpose._terminal import ended_by_interrupt, fail, interruptible, prepare, say


class _Subcommand(NamedTuple):
    module: str  # with `main(args, prog=...)`
    summary: str


_GROUPS = {
    "make runs": {
        "slam": _Subcommand(
            "jaxpose.experiments.slam.command", "track an RGB-D camera, with or without an IMU"
        ),
        "nerf": _Subcommand(
            "jaxpose.experiments.noisy_nerf.pipeline", "NeRF from photographs with noisy or unknown poses"
        ),
        "events": _Subcommand(
            "jaxpose.experiments.event_nerf.pipeline", "NeRF from the events of an event camera"
        ),
        "planar": _Subcommand(
            "jaxpose.experiments.planar.pipeline", "align patches of one photograph in the plane"
        ),
    },
    "data and trajectories": {
        "check": _Subcommand("jaxpose.cli.check.command", "find faults in a recording or a trajectory"),
        "fit": _Subcommand("jaxpose.cli.fit.command", "compare pose fields on a trajectory"),
        "eval": _Subcommand("jaxpose.cli.evaluate", "errors of a trajectory against a reference"),
        "export": _Subcommand("jaxpose.cli.export", "write the trajectory of a run in another format"),
        "convert": _Subcommand("jaxpose.cli.convert", "copy a recording into a folder of image files"),
        "view": _Subcommand("jaxpose.cli.view.command", "show a run in the browser, or save it as a page"),
    },
}
SUBCOMMANDS = {name: found for group in _GROUPS.values() for name, found in group.items()}


def main(args: Sequence[str] | None = None) -> None:
    """The command `jaxpose`, or `python -m jaxpose`.

    Args:
        args: the command line; None is that of this process.
    """
    prepare()
    args = sys.argv[1:] if args is None else list(args)
    name = args[0] if args else ""
    if name in ("--help", "-h", "--help-all"):
        say("jaxpose", help_text())
    elif name == "--version":
        say("jaxpose", f"jaxpose {jaxpose.__version__}")
    elif name in SUBCOMMANDS:
        prog = f"jaxpose {name}"
        with interruptible(prog):
            with ended_by_interrupt(prog):
                from jaxpose.experiments.command import start  # here, as --help and --version do without
            start(SUBCOMMANDS[name].module, args[1:], prog=prog)
    else:
        near = difflib.get_close_matches(name, SUBCOMMANDS, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        fail("jaxpose", f"expected one of {', '.join(SUBCOMMANDS)}, got {name or 'nothing'}{hint}")


def help_text() -> str:
    """What `jaxpose --help` prints.

    Returns:
        The subcommands, in groups.
    """
    lines = ["usage: jaxpose COMMAND [OPTIONS]", "", "Camera trajectories as continuous functions of time."]
    for title, group in _GROUPS.items():
        lines += ["", f"{title}:", *(f"  {name:<8} {found.summary}" for name, found in group.items())]
    return "\n".join([*lines, "", "jaxpose COMMAND --help shows what a command takes; jaxpose --version"])


if __name__ == "__main__":
    main()
