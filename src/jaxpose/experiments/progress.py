"""What a command is doing, on stderr: a line at once for each phase, and never a silence of five seconds."""

import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import NamedTuple, Protocol, runtime_checkable

_SILENCE_S = 3.0  # after which the last line is said again with its time
_REDRAW_S = 0.1


class Update(NamedTuple):
    """What a run is doing: a phase and, where it has steps, how many of them are done."""

    phase: str
    done: int = 0
    total: int = 0  # 0: not known
    unit: str = "steps"
    state: Mapping[str, str] = MappingProxyType({})  # numbers of the run at this step, in words
    quiet: bool = False  # written only if it lasts


@runtime_checkable
class Stream(Protocol):
    """What is written on, as stderr is."""

    def write(self, text: str, /) -> int: ...
    def flush(self) -> None: ...
    def isatty(self) -> bool: ...


OnUpdate = Callable[[Update], None]


def silent(update: Update) -> None:
    """Say nothing: what functions do that are called without a callback."""
    del update


@contextmanager
def shown(stream: Stream | None = None) -> Iterator[OnUpdate]:
    """Write updates on a stream while the block runs.

    A terminal gets one line per phase that is redrawn. Elsewhere a line is written for each new phase, and
    then one every few seconds.

    Args:
        stream: where to write; None is stderr.

    Returns:
        What to call with each `Update`.
    """
    screen = _Screen(stream or sys.stderr)
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(0.25):
            screen.repeat()

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield screen.show
    finally:
        ended.set()
        thread.join()
        screen.end_line()


class _Screen:
    """The last update, and when it was written."""

    def __init__(self, stream: Stream):
        self.stream, self.redraws = stream, stream.isatty()
        self.lock = threading.Lock()
        self.update: Update | None = None
        self.began = self.written = time.perf_counter()
        self.first = 0  # steps done when the phase began, as far as it was told
        self.reached = self.began  # when the last step was told
        self.open = False  # whether the line may still be redrawn

    def show(self, update: Update) -> None:
        with self.lock:
            now = time.perf_counter()
            if self.update is None or update.phase != self.update.phase or update.done < self.update.done:
                self.end_line()
                self.began, self.first, self.reached = now, update.done, now
                is_new = True
            else:
                is_new = False
                if update.done > self.update.done:
                    self.reached = now
            self.update = update
            if update.quiet:
                self.written = now
                return
            pause = _REDRAW_S if self.redraws else _SILENCE_S
            if is_new or update.done == update.total > 0 or now - self.written >= pause:
                self.write(now)

    def repeat(self) -> None:
        with self.lock:
            now = time.perf_counter()
            pause = 1.0 if self.redraws and self.open else _SILENCE_S
            if self.update is not None and now - self.written >= pause:
                self.write(now)

    def write(self, now: float) -> None:
        assert self.update is not None
        text = line(self.update, now - self.began, self.first, now - self.reached)
        self.written = now
        if self.redraws:
            width = shutil.get_terminal_size().columns - 1
            self.stream.write(f"\r\x1b[2K{text[:width]}")
            self.open = True
        else:
            self.stream.write(f"{text}\n")
        self.stream.flush()

    def end_line(self) -> None:
        if self.open:
            self.stream.write("\n")
            self.stream.flush()
            self.open = False


def line(update: Update, seconds: float, first: int = 0, since: float = 0.0) -> str:
    """An update in words.

    Args:
        update: what to say.
        seconds: [s] since the phase began.
        first: the steps that were done then: what others have taken tells what is left.
        since: [s] for which no step has been told.

    Returns:
        One line, without its end.

    >>> line(Update("tracking", 20, 60, "frames", {"loss": "0.31"}), 10.0)
    '  tracking  20/60 frames  10 s, 20 s left  loss 0.31'
    """
    parts = [f"  {update.phase}"]
    if update.total:
        parts.append(f"{update.done}/{update.total} {update.unit}")
    if seconds >= 1:
        left = 0.0
        if update.done > first:
            left = (seconds - since) * (update.total - update.done) / (update.done - first) - since
        parts.append(f"{seconds:.0f} s" + (f", {left:.0f} s left" if left >= 1 else ""))
    parts.extend(f"{name} {value}" for name, value in update.state.items())
    return "  ".join(parts)
