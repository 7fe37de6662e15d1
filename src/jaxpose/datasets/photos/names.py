"""Image files found by the names that other programs and other systems have written for them."""

import os
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from jaxpose.datasets.images import SUFFIXES, natural_order
from jaxpose.files.schema import may_exist


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder and of those in it, in natural order of their names; no `._*` of macOS."""
    found = [path for path in _files(folder) if path.suffix.lower() in SUFFIXES]
    return sorted(found, key=lambda path: natural_order(path.relative_to(folder).as_posix()))


def finder(folder: Path) -> Callable[[str], Path | None]:
    """A function from the name of an image to its file.

    The file is the one with that name; else, by what lies in the folder, the one whose name differs in case,
    lacks its suffix, has `\\` for `/`, or was absolute on another machine. None where there is none, or more
    than one.
    """
    listing: dict[str, list[Path]] = {}

    def look_up(name: str) -> Path | None:
        if not listing:
            for path in _files(folder):
                if path.suffix.lower() in SUFFIXES:
                    relative = path.relative_to(folder).as_posix().casefold()
                    for key in (relative, relative[: -len(path.suffix)]):
                        listing.setdefault(key, []).append(path)
            listing.setdefault("", [])
        parts = PurePosixPath(name.casefold()).parts
        absolute = name.startswith("/") or re.match(r"[A-Za-z]:", name) is not None
        for start in range(len(parts) if absolute else 1):
            candidates = listing.get("/".join(parts[start:]), [])
            if candidates:
                return candidates[0] if len(candidates) == 1 else None
        return None

    def find(name: str) -> Path | None:
        plain = name.replace("\\", "/")
        if not may_exist(plain):
            return None
        # What is there under the very name goes first, so that a suffix is tried in the order of SUFFIXES.
        for candidate in (name, plain, *(f"{plain}{suffix}" for suffix in SUFFIXES)):
            if (folder / candidate).is_file():
                return folder / candidate
        return look_up(os.path.normpath(plain))

    return find


def _files(folder: Path) -> list[Path]:
    """All files in a folder and below, without hidden ones; links to folders are followed once."""
    found, seen = [], set()
    for root, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(root)
        folders[:] = [] if real in seen else sorted(name for name in folders if not name.startswith("."))
        if real not in seen:
            found += [Path(root, name) for name in sorted(files) if not name.startswith(".")]
        seen.add(real)
    return found
