"""Depth of one frame carried into another: how much of it is met there, for any poses of the two."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxpose.datasets.types import Recording
from jaxpose.geometry.camera import pixel_grid, project_numpy, unproject_numpy
from jaxpose.geometry.rigid import rotation_angle

_ANCHORS = 8
_MOST_TURN_DEG = 20.0  # between two frames, so that they see the same
_COLUMNS = 64  # of the pixels looked at


class Views(NamedTuple):
    """Pairs of frames, some pixels of the first of each as points in its camera [m], depth of the second."""

    pairs: list[tuple[int, int]]
    points: list[Float[np.ndarray, "n 3"]]
    valid: list[Bool[np.ndarray, " n"]]
    there: list[Float[np.ndarray, "h w"]]
    project: Callable[[Float[np.ndarray, "s n 3"]], Float[np.ndarray, "s n 2"]]


def look(recording: Recording) -> Views | None:
    """Pairs over the whole recording; None if it has no two true poses."""
    pairs = [] if recording.T_world_cam is None else _pairs(recording.T_world_cam)
    if not pairs:
        return None
    camera = recording.camera
    step = max(1, camera.width // _COLUMNS)
    pixel = pixel_grid(camera, step).reshape(-1, 2)
    u, v = pixel.astype(int).T
    rays = unproject_numpy(camera, pixel)
    depth = {i: recording.read(i).depth for i in sorted({i for pair in pairs for i in pair})}
    near = [depth[i][v, u] for i, _ in pairs]
    return Views(
        pairs,
        [rays * z[:, None] for z in near],
        [z > 0 for z in near],
        [depth[j] for _, j in pairs],
        partial(project_numpy, camera),
    )


def agreement(
    views: Views,
    pair: int,
    T_second_first: Float[np.ndarray, "s 4 4"],
    scales: Float[np.ndarray, " s"],
    tolerance: float,
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Share of the points of the first frame that are met within `tolerance` of the depth, for each pose.

    Of all that have depth, and of those that land on depth. Depth is multiplied by `scales`.
    """
    points, valid, there = views.points[pair], views.valid[pair], views.there[pair]
    R_first_second = np.swapaxes(T_second_first[:, :3, :3], 1, 2)
    moved = scales[:, None, None] * (points @ R_first_second) + T_second_first[:, None, :3, 3]
    row, column, inside = _nearest_pixel(views.project(moved), there)
    met = there[row, column] * scales[:, None]
    seen = inside & valid & (met > 0)
    close = seen & (np.abs(moved[..., 2] - met) < tolerance * met)
    return close.sum(1) / max(int(valid.sum()), 1), close.sum(1) / np.maximum(seen.sum(1), 1)


def _pairs(T: Float[np.ndarray, "n 4 4"]) -> list[tuple[int, int]]:
    """Frames here and there, each with up to three later ones that it has not turned far from.

    The angle between two poses is the same under all conventions, so the choice favours none.
    """
    usable = np.flatnonzero(np.isfinite(T).all((1, 2)))
    if len(usable) < 2:
        return []
    pairs = set()
    for k in np.linspace(0, 0.9 * (len(usable) - 1), _ANCHORS).astype(int):
        later = usable[k + 1 :]
        turn = np.degrees(rotation_angle(T[usable[k], :3, :3], T[later, :3, :3]))
        far = int((turn > _MOST_TURN_DEG).argmax()) if (turn > _MOST_TURN_DEG).any() else len(later)
        pairs |= {(int(usable[k]), int(later[max(1, far // part) - 1])) for part in (1, 2, 4)}
    return sorted(pairs)


def _nearest_pixel(
    at: Float[np.ndarray, "s n 2"], image: Float[np.ndarray, "h w"]
) -> tuple[Int[np.ndarray, "s n"], Int[np.ndarray, "s n"], Bool[np.ndarray, "s n"]]:
    """Row and column of the pixel, 0 outside, and which are inside."""
    u, v = np.round(at[..., 0]), np.round(at[..., 1])
    inside = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
    return np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int), inside
