"""The map of a SLAM run as its folder keeps it, `map.npz`."""

import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.errors import DataError
from jaxpose.files import atomic
from jaxpose.scenes import GridConfig
from jaxpose.slam.map.texture import Texture

_VERSION = 2


class SavedMap(NamedTuple):
    """A map as a run folder keeps it, `map.npz`."""

    grid: GridConfig
    values: Float[np.ndarray, "x y z 4"]  # of the finest level: signed distance [m], red, green, blue
    texture: Texture  # finer colour on the surface
    keyframes: Int[np.ndarray, " k"]  # frames, counted from the first of the trajectory


def write_map(path: Path | str, saved: SavedMap) -> None:
    """Write a map (npz, compressed): version, the fields of its `GridConfig`, values, paint, keyframes."""
    arrays = asdict(saved.grid) | {"values": saved.values, "keyframes": saved.keyframes}
    arrays |= {f"paint_{name}": array for name, array in saved.texture._asdict().items()}
    with atomic.atomic(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, version=_VERSION, **arrays)


def read_map(path: Path | str) -> SavedMap:
    """Read what `write_map` wrote; DataError naming the file for what is not that."""
    try:
        with np.load(path, allow_pickle=False) as file:
            content = dict(file)
        if content["version"] != _VERSION:
            raise DataError(f"{path}: expected a map of version {_VERSION}, got {content['version']}")
        lower, upper = (tuple(content[name].tolist()) for name in ("lower", "upper"))
        voxel, truncation = float(content["voxel"]), float(content["truncation"])
        config = GridConfig(lower, upper, voxel, int(content["levels"]), truncation)
        texture = Texture(content["paint_slot"], content["paint_tiles"])
        return SavedMap(config, content["values"], texture, content["keyframes"])
    except (zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
        raise DataError(f"{path}: expected a map, got {' '.join(str(error).split())}") from None
