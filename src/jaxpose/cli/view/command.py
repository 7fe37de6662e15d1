"""Show a run in the browser: path and ground truth, cameras with their images, map, renders over time.

RUN is a run folder, or a trajectory file. A slider moves a camera along the run's continuous trajectory and
shows what the run's map or radiance field shows from there. Nothing is loaded from the network. --save writes
the scene as one HTML file, the camera on its way in it, which opens in any browser without this program, or
as a GIF of what the camera sees on its way.
"""

import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import tyro

from jaxpose.cli.view import access
from jaxpose.cli.view.animation import animate
from jaxpose.cli.view.scene import read_scene
from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_apart, check_least
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.progress import OnUpdate, Update, silent


@dataclass(frozen=True)
class Config:
    """What to show, and where."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]  # run folder, or trajectory file
    port: int = 8080  # of the page; the next free one if it is taken
    host: str = (
        "127.0.0.1"  # address to listen at: only this machine sees it; 0.0.0.0: any machine that reaches it
    )
    frustums: int = 30  # so many frames, evenly over the run, are shown as cameras with their pictures
    save: Path | None = None  # HTML or GIF file to write instead

    def __post_init__(self):
        if not 0 <= self.port < 65536:
            raise ValueError(f"--port: expected 0 (any) to 65535, got {self.port}")
        check_least(self, frustums=0)
        check_apart("--save", self.save, self.run)
        if self.save is not None and self.save.suffix not in (".html", ".gif"):
            raise ValueError(f"--save: expected a name that ends in .html or .gif, got {self.save}")


class Shown(NamedTuple):
    """Where a run is to be seen, until `close()`."""

    run: str  # in words
    url: str | None
    file: Path | None
    notes: tuple[str, ...]
    close: Callable[[], None]


def run(config: Config, on_update: OnUpdate = silent) -> Shown:
    """Show the run until `close()` is called, or write it to a file.

    Args:
        config: what to show, and where.
        on_update: called with what is being done.

    Returns:
        Where it is to be seen.

    Raises:
        DataError, OSError: for what cannot be used.
    """
    on_update(Update(f"reading {config.run}", quiet=True))
    if config.save is not None and config.save.suffix == ".gif":
        scene = read_scene(config.run, 0, on_update)
        animate(scene, config.save, on_update)
        return Shown(scene.name, None, config.save, scene.notes, lambda: None)
    try:
        from jaxpose.cli.view import page as view_page
    except ImportError:
        raise DataError('expected viser, got none: pip install -e ".[viewer]"') from None
    allowed = access.access(config.host)
    scene = read_scene(config.run, config.frustums, on_update)
    if config.save is not None:
        view_page.save(scene, config.save, on_update)
        return Shown(scene.name, None, config.save, scene.notes, lambda: None)
    on_update(Update("opening the page", quiet=True))
    port, close = view_page.serve(scene, allowed, config.port)
    notes = () if config.port in (0, port) else (f"port {config.port} is taken",)
    if allowed.token is not None:
        notes += ("other machines reach this page: whoever has its address, token and all, sees the run",)
    return Shown(scene.name, access.url(allowed, port), None, (*notes, *scene.notes), close)


def main(args: Sequence[str] | None = None, prog: str = "jaxpose view") -> None:
    """The command `jaxpose view`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    wait(execute(Command(prog, Config, __doc__, run, report), args))


def report(shown: Shown) -> str:
    """Where to look."""
    if shown.file is None:
        line = f"{shown.url}  {shown.run}; Ctrl-C ends"
    else:
        line = f"{shown.file}  {shown.run}; {shown.file.stat().st_size / 1e6:.1f} MB"
        line += ", opens in any browser" if shown.file.suffix == ".html" else ""
    return "\n".join([line, *(f"  note  {note}" for note in shown.notes)])


def wait(shown: Shown) -> None:
    """Keep showing until the user interrupts; a file needs no waiting for."""
    if shown.url is None:
        return
    sys.stdout.flush()  # whoever reads it through a pipe waits for the address
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    shown.close()
