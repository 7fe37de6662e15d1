"""The map of a SLAM run as its folder keeps it, `map.npz`."""

import zipfile
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxpose.errors import DataError
from jaxpose.files import atomic
from jaxpose.files.schema import check_version, numbers, rigid_transforms
from jaxpose.files.untrusted import read_npz
from jaxpose.scenes.voxel_blocks import (
    CHANNELS,
    NODES,
    BlockConfig,
    decoded_channel,
    of_distance_and_colour,
    packed,
    unpacked,
)
from jaxpose.slam import SavedMap
from jaxpose.slam.map.texture import SIDE, Texture
from jaxpose.slam.tracking.features import Features

_VERSION = 4
_VALUES = 4  # of the channels of a node: distance and colour
_STEP, _MOST_STEPS = 256, 127  # of numbers of 16 bits
_TOGETHER = 256  # blocks
_EFFORT = 4  # of compression: half the time of numpy's 6 for 3% more bytes
_DESCRIPTOR = 32  # bytes
_LARGEST_M = 1e4  # of voxels and distances
_FARTHEST_BLOCK = 1023  # from the origin: a table of 256^3 bricks
_MOST_LOSS = 1e6  # sigmas; and of colour errors


def write_map(path: Path | str, saved: SavedMap) -> None:
    """Write a map (npz, compressed): version, resolution, blocks in use, texture, keyframes.

    `coords` (n, 3) say which block of space each is, 8 voxels wide and beginning at a multiple of that;
    `values` (n, 9, 9, 9, 4), float16, are signed distance [m] and colour of nodes, `texture_tiles` (m, 17,
    17, 17, 4) finer colour and 255 where there is any, tile `texture_slot[k]` for block k. A later run goes
    on with `fusion` (n, 9, 9, 9, 4), the rest of the nodes as the map stores them, and finds itself by what
    begins with `keyframe` and `feature`.
    """
    coords, stored = packed(saved.blocks)
    arrays = asdict(saved.config) | {
        "coords": coords,
        "values": _distance_and_colour(saved.config, stored),
        "fusion": _coarsened(stored[..., _VALUES:]),
        "keyframes": saved.keyframes,
        "keyframe_T_world_cam": saved.T_world_cam,
        "usual": np.array(saved.usual),
        **_of_features(saved.features),
    }
    arrays |= {
        "texture_slot": np.asarray(saved.texture.slot)[1 : len(coords) + 1],
        "texture_tiles": np.asarray(saved.texture.tiles),
    }
    with atomic.atomic(path) as temporary:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=_EFFORT) as archive:
            for name, array in {"version": _VERSION, **arrays}.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)


def _coarsened(fusion: Int[np.ndarray, "n 9 9 9 4"]) -> Int[np.ndarray, "n 9 9 9 4"]:
    """Wide-band distances to a thousandth of their range and roots of weights to 1%: a third of the bytes."""
    found = np.empty_like(fusion)
    for start in range(0, len(fusion), _TOGETHER):
        some = fusion[start : start + _TOGETHER].astype(np.int32)
        coarse = _STEP * np.round(some / _STEP).astype(np.int32)
        coarse[..., 1:] = np.where(some[..., 1:] > 0, np.maximum(coarse[..., 1:], _STEP), 0)  # known stays so
        found[start : start + _TOGETHER] = np.clip(coarse, -_MOST_STEPS * _STEP, _MOST_STEPS * _STEP)
    return found


def _of_features(features: tuple[Features, ...]) -> dict[str, Any]:
    """The features of all keyframes in a row, and how many each has."""
    joined = lambda name, *shape: np.concatenate(
        [np.zeros((0, *shape)), *(getattr(f, name) for f in features)]
    )
    return {
        "feature_count": np.array([len(f.depth) for f in features], int),
        "feature_direction": joined("direction_cam", 3)[:, :2].astype(np.float32),
        "feature_depth": joined("depth").astype(np.float32),
        "feature_scale": joined("scale").astype(np.float32),
        "feature_descriptor": joined("descriptor", _DESCRIPTOR).astype(np.uint8),
    }


def _distance_and_colour(
    config: BlockConfig, stored: Int[np.ndarray, "n 9 9 9 8"]
) -> Float[np.ndarray, "n 9 9 9 4"]:
    """The first channels of the nodes, float16, made of a few blocks at a time: memory is the file's."""
    values = np.empty((*stored.shape[:-1], _VALUES), np.float16)
    for start in range(0, len(stored), _TOGETHER):
        some = stored[start : start + _TOGETHER]
        for k in range(_VALUES):
            values[start : start + _TOGETHER, ..., k] = decoded_channel(config, k, some[..., k])
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
    nodes = (count, NODES, NODES, NODES)
    number("values", (*nodes, _VALUES), least=-_LARGEST_M, most=_LARGEST_M)
    rest = CHANNELS - _VALUES
    fusion = _whole(path, content, "fusion", np.int16, (*nodes, rest), f"int16 of {rest} for each node")
    stored = of_distance_and_colour(config, content["values"])[..., :_VALUES]
    blocks = unpacked(config, coords, np.concatenate([stored, fusion], axis=-1))
    cube = (None, SIDE, SIDE, SIDE, 4)
    tiles = _whole(path, content, "texture_tiles", np.uint8, cube, f"uint8 of n tiles of {SIDE}^3 x 4")
    slot = np.zeros(blocks.coords.shape[0], np.int32)
    slot[1 : count + 1] = number("texture_slot", (count,), whole=True, least=0, most=len(tiles) - 1)
    keyframes = number("keyframes", (None,), whole=True, least=0)
    T_world_cam = number("keyframe_T_world_cam", (None, 4, 4))
    rigid_transforms(path, "keyframe_T_world_cam", T_world_cam)
    loss, colour = number("usual", (2,), least=0, most=_MOST_LOSS).tolist()
    features = _features(path, content, len(T_world_cam))
    return SavedMap(config, blocks, Texture(slot, tiles), keyframes, T_world_cam, features, (loss, colour))


def _whole(
    path: Path | str, content: Any, key: str, kind: type, shape: tuple[int | None, ...], wanted: str
) -> np.ndarray:
    """An array of just this type and shape, None for any size; DataError that says what was `wanted`."""
    x = content.get(key)
    if (
        x is None
        or x.dtype != kind
        or x.ndim != len(shape)
        or any(size not in (None, found) for size, found in zip(shape, x.shape, strict=True))
    ):
        got = "none" if x is None else f"{x.dtype} of shape {x.shape}"
        raise DataError(f"{path}: {key}: expected {wanted}, got {got}")
    return x


def _features(path: Path | str, content: Any, keyframes: int) -> tuple[Features, ...]:
    """The features of each keyframe; none of a run without."""
    number = partial(numbers, path, content)
    counts = number("feature_count", (None,), whole=True, least=0)
    shape, wanted = (None, _DESCRIPTOR), f"uint8 (n, {_DESCRIPTOR})"
    descriptor = _whole(path, content, "feature_descriptor", np.uint8, shape, wanted)
    total = len(descriptor)
    if len(counts) not in (0, keyframes) or counts.sum() != total:
        wanted = f"{keyframes} that sum up to {total}"
        raise DataError(f"{path}: feature_count: expected {wanted}, got {len(counts)} to {counts.sum()}")
    direction = number("feature_direction", (total, 2), least=-_LARGEST_M, most=_LARGEST_M)
    depth = number("feature_depth", (total,), least=0, most=_LARGEST_M)
    scale = number("feature_scale", (total,), above=0, most=_LARGEST_M)
    direction = np.concatenate([direction, np.ones((total, 1))], axis=1)
    ends = np.cumsum(counts)[:-1]
    every = (np.split(x, ends) for x in (direction, depth, scale, descriptor))
    return tuple(Features(*one) for one in zip(*every, strict=True)) if len(counts) else ()
