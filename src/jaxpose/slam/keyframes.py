"""Keyframes: which frames are kept, and which of them a mapping step looks at again."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.datasets.types import Frame
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, project_numpy
from jaxpose.slam.observation import Image, to_device

FrameReader = Callable[[int], Frame]  # a frame by its index, counted from the first of the run


class Keyframe(NamedTuple):
    """A frame that is kept: its image on the device and where it was taken from."""

    index: int
    image: Image
    T_world_cam: np.ndarray  # (4, 4)


def keyframe_images(
    read: FrameReader, indices: Int[np.ndarray, " k"], T_world_cam: Float[np.ndarray, "n 4 4"]
) -> Iterator[Keyframe]:
    """Keyframes one after the other, each image read when it is asked for.

    `T_world_cam` holds the poses of all frames.
    """
    for i in indices.tolist():
        yield Keyframe(i, to_device(read(i)), T_world_cam[i])


def thumbnail(frame: Frame) -> Float[np.ndarray, "2 12 16"]:
    """A descriptor of what a frame looks like from afar: grey and depth, each with mean 0 and spread 1."""
    height, width = frame.depth.shape
    row, column = height // 12, width // 16
    cut = lambda x: x[: 12 * row, : 16 * column].reshape(12, row, 16, column)
    depth, seen = cut(frame.depth), cut(frame.depth) > 0
    deep = depth.sum((1, 3)) / np.maximum(seen.sum((1, 3)), 1)
    channels = np.stack([cut(frame.rgb.mean(axis=-1)).mean((1, 3)), deep])
    channels -= channels.mean((1, 2), keepdims=True)
    return channels / np.maximum(channels.std((1, 2), keepdims=True), 1e-3)


def coarse_depth(frame: Frame) -> Float[np.ndarray, "12 16"]:
    """The farthest depth [m] in each part of a frame; 0 where nothing was measured."""
    height, width = frame.depth.shape
    row, column = height // 12, width // 16
    return frame.depth[: 12 * row, : 16 * column].reshape(12, row, 16, column).max((1, 3))


def seen_shares(
    points_world: Float[np.ndarray, "n 3"],
    T_world_cam: Float[np.ndarray, "k 4 4"],
    depth: Float[np.ndarray, "k 12 16"],
    camera: Camera,
) -> Float[np.ndarray, " k"]:
    """Share of world points that each of some cameras has seen, as nothing it measured there hides them.

    Poses may be off: points count up to a quarter of the image beside it, and a tenth behind what was
    measured (`coarse_depth`).
    """
    z, u, v = _in_views(points_world, T_world_cam, camera)
    u, v = (u + 0.5) / camera.width, (v + 0.5) / camera.height
    inside = (z > 0) & (np.abs(u - 0.5) < 0.75) & (np.abs(v - 0.5) < 0.75)
    row, column = (np.clip(n * np.where(inside, x, 0), 0, n - 1).astype(int) for n, x in ((12, v), (16, u)))
    farthest = depth[np.arange(len(depth))[:, None], row, column]
    return np.mean(inside & (z < 1.1 * farthest), axis=1)


def unlikeness(thumbnails: Float[np.ndarray, "k 2 12 16"], frame: Frame) -> Float[np.ndarray, " k"]:
    """How little each thumbnail is like a frame's: the mean squared difference."""
    return np.mean((thumbnails - thumbnail(frame)) ** 2, axis=(1, 2, 3))


def overlap(
    points_world: np.ndarray,
    T_world_cam: np.ndarray,
    camera: Camera,
    farthest: float = np.inf,
    *,
    margin: int = 20,
) -> np.ndarray:
    """Share (k,) of world points (n, 3) that each of the cameras (k, 4, 4) sees (NICE-SLAM's test).

    A point counts that is at least `margin` pixels inside the image, and nearer than `farthest` [m]: what is
    behind a wall of the next room is in a camera's view too.
    """
    z, u, v = _in_views(points_world, T_world_cam, camera)
    inside = (u >= margin) & (u < camera.width - margin) & (v >= margin) & (v < camera.height - margin)
    return np.mean(inside & (z < farthest), axis=1)


def _in_views(
    points_world: Float[np.ndarray, "n 3"], T_world_cam: Float[np.ndarray, "k 4 4"], camera: Camera
) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n"], Float[np.ndarray, "k n"]]:
    """Depth [m] of world points along each camera's axis, and their column and row [px]."""
    points_cam = rigid.apply(rigid.inverse(T_world_cam)[:, None], points_world)
    u, v = np.moveaxis(project_numpy(camera, points_cam), -1, 0)
    return points_cam[..., 2], u, v


def choose(shares: np.ndarray, count: int, generator: np.random.Generator) -> list[int]:
    """`count` keyframes for a mapping window: the last one, and a random choice of those that overlap.

    Repeats keyframes when there are fewer.
    """
    last = len(shares) - 1
    others = np.flatnonzero(shares[:-1] > 0)
    chosen = [last, *generator.permutation(others)[: count - 1]]
    return [int(chosen[i % len(chosen)]) for i in range(count)]
