"""Camera trajectories: check data, find a field that carries a motion, compare, take out and look at a run.

`jaxpose COMMAND --help` tells what a command takes. The experiments that make runs are
`python -m jaxpose.experiments.rgbd_slam`, `imu_slam`, `noisy_nerf`, `event_nerf` and `planar`.
"""

import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from jaxpose.cli import evaluate, export
from jaxpose.cli.check import command as check
from jaxpose.cli.fit import command as fit
from jaxpose.cli.view import command as view
from jaxpose.experiments import command
from jaxpose.files.atomic import json_text

_MODULES = {
    check.Config: ("check", check),
    fit.Config: ("fit", fit),
    evaluate.Config: ("eval", evaluate),
    export.Config: ("export", export),
    view.Config: ("view", view),
}
# All that the command line can ask for: the config of one of the commands.
_Command = Annotated[
    Annotated[check.Config, tyro.conf.subcommand("check", description=check.__doc__)]
    | Annotated[fit.Config, tyro.conf.subcommand("fit", description=fit.__doc__)]
    | Annotated[evaluate.Config, tyro.conf.subcommand("eval", description=evaluate.__doc__)]
    | Annotated[export.Config, tyro.conf.subcommand("export", description=export.__doc__)]
    | Annotated[view.Config, tyro.conf.subcommand("view", description=view.__doc__)],
    tyro.conf.FlagCreatePairsOff,
]


def main(args: Sequence[str] | None = None) -> None:
    """The command: `jaxpose`, or `python -m jaxpose`."""
    config: Any = command.parse("jaxpose", _Command, __doc__, args, prog="jaxpose")  # pyright: ignore
    name, module = _MODULES[type(config)]

    code, shown = 0, None

    def said() -> str:
        nonlocal code, shown
        progress = {"on_field": _tell} if module is fit else {}
        result = module.run(config, **progress)
        if module is view:
            shown = result
            return view.report(shown)
        if module is check:
            code = check.exit_code(result)
        return json_text(result) if config.json else module.report(result)

    command.guarded(f"jaxpose {name}", said)
    if shown is not None:
        view.wait(shown)
    if code:
        sys.exit(code)


def _tell(field: str) -> None:
    print(f"fitting {field}", file=sys.stderr)
