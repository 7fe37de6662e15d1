"""The map of a SLAM run as its folder keeps it, `map.npz`."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.errors import DataError
from jaxpose.files import atomic
from jaxpose.files.schema import check_version, numbers
from jaxpose.files.untrusted import read_npz
from jaxpose.scenes.voxel_blocks import (
    NODES,
    BlockConfig,
    Blocks,
    decoded,
    of_distance_and_colour,
    packed,
    unpacked,
)
from jaxpose.slam.map.texture import SIDE, Texture

_VERSION = 3
_TOGETHER = 256  # blocks
_LARGEST_M = 1e4  # of voxels and distances
_FARTHEST_BLOCK = 1023  # from the origin: a table of 256^3 bricks


class SavedMap(NamedTuple):
    """A map as a run folder keeps it, `map.npz`."""

    config: BlockConfig
    blocks: Blocks
    texture: Texture  # finer colour on the surface
    keyframes: Int[np.ndarray, " k"]  # frames, counted from the first of the trajectory


def write_map(path: Path | str, saved: SavedMap) -> None:
    """Write a map (npz, compressed): version, resolution, blocks in use, texture, keyframes.

    `coords` (n, 3) say which block of space each is, 8 voxels wide and beginning at a multiple of that;
    `values` (n, 9, 9, 9, 4), float16, are signed distance [m] and colour of nodes, `texture_tiles` (m, 17,
    17, 17, 4) finer colour and 255 where there is any, tile `texture_slot[k]` for block k.
    """
    coords, stored = packed(saved.blocks)
    arrays = asdict(saved.config) | {
        "coords": coords,
        "values": _distance_and_colour(saved.config, stored),
        "keyframes": saved.keyframes,
    }
    arrays |= {
        "texture_slot": np.asarray(saved.texture.slot)[1 : len(coords) + 1],
        "texture_tiles": np.asarray(saved.texture.tiles),
    }
    with atomic.atomic(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, version=_VERSION, **arrays)


def _distance_and_colour(
    config: BlockConfig, stored: Int[np.ndarray, "n 9 9 9 8"]
) -> Float[np.ndarray, "n 9 9 9 4"]:
    """The first channels of the nodes, float16, made of a few blocks at a time: memory is the file's."""
    values = np.empty((*stored.shape[:-1], 4), np.float16)
    for start in range(0, len(stored), _TOGETHER):
        values[start : start + _TOGETHER] = decoded(config, stored[start : start + _TOGETHER])[..., :4]
    return values


def read_map(path: Path | str) -> SavedMap:
    """Read what `write_map` wrote; DataError naming file and entry for what is not that."""
    content = read_npz(path, "a map")
    check_version(path, content, _VERSION, "a map")
    number = partial(numbers, path, content)
    voxel, truncation = (float(number(key, above=0, most=_LARGEST_M)) for key in ("voxel", "truncation"))
    config = BlockConfig(voxel, truncation)
    coords = number("coords", (None, 3), whole=True)
    count, reach = len(coords), int(np.abs(coords).max(initial=0))
    if reach > min(_FARTHEST_BLOCK, count + 64) or len(np.unique(coords, axis=0)) != count:
        raise DataError(f"{path}: coords: expected blocks beside each other, got {reach} of {count} away")
    number("values", (count, NODES, NODES, NODES, 4), least=-_LARGEST_M, most=_LARGEST_M)
    blocks = unpacked(config, coords, of_distance_and_colour(config, content["values"]))
    tiles = content.get("texture_tiles")
    if (
        tiles is None
        or tiles.dtype != np.uint8
        or tiles.ndim != 5
        or tiles.shape[1:] != (SIDE, SIDE, SIDE, 4)
    ):
        got = "none" if tiles is None else f"{tiles.dtype} of shape {tiles.shape}"
        raise DataError(f"{path}: texture_tiles: expected uint8 of n tiles of {SIDE}^3 x 4, got {got}")
    slot = np.zeros(blocks.coords.shape[0], np.int32)
    slot[1 : count + 1] = number("texture_slot", (count,), whole=True, least=0, most=len(tiles) - 1)
    keyframes = number("keyframes", (None,), whole=True, least=0)
    return SavedMap(config, blocks, Texture(slot, tiles), keyframes)
