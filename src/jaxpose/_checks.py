"""What public functions say of arguments that they cannot use: one line with name, expected and found."""

from typing import Any

import numpy as np


def check_shapes(**arguments: tuple[Any, str]) -> dict[str, int]:
    """The sizes that letters stand for; ValueError for arguments of other shapes.

    Each argument is given by its name as (value, shape), the shape in words such as "n 4 4": a number is a
    size, a word is any size, which is the same in all arguments, and a first word that begins with * stands
    for any number of axes. Values may be numpy or JAX arrays, traced too.

    >>> check_shapes(t=(np.zeros(3), "n"), T=(np.zeros((2, 4, 4)), "n 4 4"))
    Traceback (most recent call last):
    ValueError: T: expected shape (3, 4, 4), got (2, 4, 4)
    """
    sizes: dict[str, int] = {}
    for name, (value, wanted) in arguments.items():
        words, shape = wanted.split(), np.shape(value)
        free = bool(words) and words[0].startswith("*")
        words, found = words[free:], shape[max(len(shape) - len(words) + 1, 0) :] if free else shape
        right = len(found) == len(words)
        for word, size in zip(words, found, strict=False):
            right &= size == (int(word) if word.isdecimal() else sizes.setdefault(word, size))
        if not right:
            known = [str(sizes[w]) if w in sizes and len(found) == len(words) else w for w in words]
            text = ", ".join(["..."] * free + known) + ("," if len(words) + free == 1 else "")
            raise ValueError(f"{name}: expected shape ({text}), got {shape}")
    return sizes


def check_finite(**arguments: np.ndarray) -> None:
    """ValueError naming the first argument that holds NaN or infinity, and where."""
    for name, value in arguments.items():
        bad = ~np.isfinite(value)
        if bad.any():
            index = ", ".join(map(str, np.argwhere(bad)[0])) if bad.ndim else ""
            got = f"{value[bad][0]}" + (f" at index ({index})" if index else "")
            raise ValueError(f"{name}: expected finite numbers, got {got}")


def check_increasing(**arguments: np.ndarray) -> None:
    """ValueError naming the first argument whose numbers do not increase, or are not finite, and where."""
    check_finite(**arguments)
    for name, t in arguments.items():
        for row in np.flatnonzero(np.diff(t) <= 0) + 1:
            raise ValueError(f"{name}: expected increasing times, got {t[row]!s} after {t[row - 1]!s} s")
