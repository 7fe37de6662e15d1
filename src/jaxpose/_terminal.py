"""What commands print: names that no terminal shows are escaped, and a stream may be closed or full."""

import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def prepare() -> None:
    """Escape what the streams' encoding lacks; without stderr what would go there is dropped."""
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]


def say(name: str, text: str) -> None:
    """Print to a reader that may have gone, as `head` does.

    Exits with one line on stderr where stdout is closed or its disk is full.

    Args:
        name: what that line begins with.
        text: what to print; control characters in it, which names of files may hold, are escaped.
    """
    if sys.stdout is None:
        fail(name, "expected an open stdout, got a closed one")
    try:
        print(printable(text), flush=True)
    except OSError as error:
        sys.stdout = open(os.devnull, "w")  # what Python flushes at its end
        if not isinstance(error, BrokenPipeError):
            fail(name, f"stdout: {error.strerror}")


def printable(text: str) -> str:
    """Text with control characters but tabs and line ends escaped: a name may not move the cursor."""
    return _CONTROLS.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


def fail(name: str, message: str) -> NoReturn:
    """Exit with code 1 and one line on stderr."""
    words = " ".join(message.split())
    sys.exit(printable(f"{name}: {words if len(words) < 2000 else words[:2000] + ' ...'}"))


@contextmanager
def interruptible(name: str) -> Iterator[None]:
    """Ctrl-C ends what it holds with one line on stderr and code 1.

    Args:
        name: what that line begins with.
    """
    try:
        yield
    except KeyboardInterrupt:
        fail(name, "interrupted")


@contextmanager
def ended_by_interrupt(name: str) -> Iterator[None]:
    """Let Ctrl-C end the process at once, with one line on stderr and code 1, while nothing is to be kept.

    For imports: what an interrupt raises among them may be swallowed, as by JAX's callback of the garbage
    collector, and the process would go on.

    Args:
        name: what that line begins with.
    """

    def end(*_: object) -> NoReturn:
        cleared = "\r\x1b[2K" if sys.stderr.isatty() else ""
        os.write(2, f"{cleared}{printable(name)}: interrupted\n".encode())
        os._exit(1)

    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not ignored, nor a caller's
    if not ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
