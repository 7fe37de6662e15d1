"""The map of a SLAM run as its folder keeps it, `map.npz`."""

import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxpose.errors import DataError
from jaxpose.files import atomic
from jaxpose.scenes.voxel_blocks import CHANNELS, BlockConfig, Blocks, packed, unpacked
from jaxpose.slam.map.texture import Texture

_VERSION = 3


class SavedMap(NamedTuple):
    """A map as a run folder keeps it, `map.npz`."""

    config: BlockConfig
    blocks: Blocks
    texture: Texture  # finer colour on the surface
    keyframes: Int[np.ndarray, " k"]  # frames, counted from the first of the trajectory


def write_map(path: Path | str, saved: SavedMap) -> None:
    """Write a map (npz, compressed): version, resolution, blocks in use, texture, keyframes.

    `coords` (n, 3) say which block of space each is, 8 voxels wide and beginning at a multiple of that;
    `values` (n, 9, 9, 9, 4) are signed distance [m] and colour at its nodes, `texture_tiles` (m, 17, 17, 17,
    4) finer colour and 255 where there is any, tile `texture_slot[k]` for block k.
    """
    coords, values = packed(saved.blocks)
    arrays = asdict(saved.config) | {
        "coords": coords,
        "values": values[..., :4],
        "keyframes": saved.keyframes,
    }
    arrays |= {
        "texture_slot": np.asarray(saved.texture.slot)[1 : len(coords) + 1],
        "texture_tiles": np.asarray(saved.texture.tiles),
    }
    with atomic.atomic(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, version=_VERSION, **arrays)


def read_map(path: Path | str) -> SavedMap:
    """Read what `write_map` wrote; DataError naming the file for what is not that."""
    try:
        with np.load(path, allow_pickle=False) as file:
            content = dict(file)
        if content["version"] != _VERSION:
            raise DataError(f"{path}: expected a map of version {_VERSION}, got {content['version']}")
        config = BlockConfig(float(content["voxel"]), float(content["truncation"]))
        values = np.pad(content["values"], [(0, 0)] * 4 + [(0, CHANNELS - 4)])
        blocks = unpacked(config, content["coords"], values)
        slot = np.zeros(blocks.coords.shape[0], np.int32)
        slot[1 : len(values) + 1] = content["texture_slot"]
        texture = Texture(slot, content["texture_tiles"])
        return SavedMap(config, blocks, texture, content["keyframes"])
    except (zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
        raise DataError(f"{path}: expected a map, got {' '.join(str(error).split())}") from None
