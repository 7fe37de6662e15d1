"""Depth images in OpenEXR."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import Float32

from jaxpose.errors import DataError
from jaxpose.files.untrusted import reading

EXTRA = 'pip install -e ".[phone]"'
_MOST_PIXELS = 1 << 26


def read_exr(data: bytes, where: str) -> Float32[np.ndarray, "h w"]:
    """Read an image of depth. Needs the package OpenEXR (extra `phone`).

    Args:
        data: The file, whose depth is its channel R, Y or Z, or the only one.
        where: Its name, for errors.

    Returns:
        Depth as the file has it.

    Raises:
        DataError: For a file that cannot be read, and without the package.
    """
    try:
        import Imath
        import OpenEXR
    except ImportError:
        raise DataError(f"{where}: an EXR needs the package OpenEXR: {EXTRA}") from None
    with reading(where, "an image of depth in OpenEXR"), _silent():
        image = OpenEXR.InputFile(io.BytesIO(data))
        header = image.header()
        low, high = header["dataWindow"].min, header["dataWindow"].max
        height, width = high.y - low.y + 1, high.x - low.x + 1
        channels = [*header["channels"]]
        name = next((name for name in ("R", "Y", "Z", *channels[:1]) if name in channels), None)
        if name is None or (len(channels) > 1 and {"G", "B"} & {*channels}):
            raise ValueError(f"channels {' '.join(channels) or 'none'}")
        if not 0 < height * width <= _MOST_PIXELS:
            raise ValueError(f"{width}x{height} pixels")
        pixels = image.channel(name, Imath.PixelType(Imath.PixelType.FLOAT))
        return np.frombuffer(pixels, np.float32).reshape(height, width)


@contextmanager
def _silent() -> Iterator[None]:
    """Nothing on stderr, to which the package writes of damage what it raises as well."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
