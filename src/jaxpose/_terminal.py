"""What commands print: names that no terminal shows are escaped, and a stream may be closed or full."""

import os
import re
import sys
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
