"""What loaders of photographs share: frame numbers, poses checked, a guess of the depths."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from jaxpose.errors import DataError
from jaxpose.files.matrices import orthonormal

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # right, up, back to right, down, forward, and the other way
_HELD_OUT = 8

Depths = tuple[float, float, Literal["depth", "disparity"], tuple[str, ...]]  # near, far, spacing, notes


def frame_numbers(names: Sequence[str]) -> tuple[Float[np.ndarray, " n"], str]:
    """Times of images without timestamps, which are in order already, and a note that says what they are.

    It is the last number of the file names, if they differ in nothing else and it increases, so that frames
    that were left out leave their gap; else 0, 1, 2 and so on.
    """
    parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", Path(name).stem) for name in names]
    kept = [part for part in parts if part]
    numbers = np.array([float(part[2]) for part in kept])
    same = len(kept) == len(names) and len({(part[1], part[3]) for part in kept}) == 1
    if same and (np.diff(numbers) > 0).all():
        return numbers, "no timestamps: the time of an image is the frame number in its file name"
    return np.arange(float(len(names))), "no timestamps: the time of an image is its place among the files"


def check_poses(
    T_world_cam: Float[np.ndarray, "n 4 4"], where: Callable[[int], str]
) -> Float[np.ndarray, "n 4 4"]:
    """The poses with rotations orthonormal to the last digit; `where(i)` names pose i in the DataError."""
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.all():
        raise DataError(f"{where(int(finite.argmin()))}: expected a finite pose, got NaN or infinity")
    return orthonormal(T_world_cam, where)


def extent_depths(T_world_cam: Float[np.ndarray, "n 4 4"]) -> tuple[float, float]:
    """Near and far where nothing else tells them: 0.1 and 100 times the cameras' extent (1 if they rest)."""
    centres = T_world_cam[:, :3, 3]
    extent = float(np.linalg.norm(centres - centres.mean(0), axis=1).max()) or 1.0
    return 0.1 * extent, 100 * extent


def focus_depths(T_world_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"] | None:
    """Depth, in each view, of the point nearest to all optical axes; None unless all look at one."""
    axes, centres = T_world_cam[:, :3, 2], T_world_cam[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.mean(0)
    if np.linalg.eigvalsh(total)[0] < 1e-3:  # all but parallel
        return None
    focus = np.linalg.solve(total, np.einsum("nij,nj->i", across, centres) / len(centres))
    depth = np.einsum("ni,ni->n", focus - centres, axes)
    return depth if (depth > 0).all() else None


def guessed_depths(T_world_cam: Float[np.ndarray, "n 4 4"], transparent: bool) -> Depths:
    """Near and far by where the cameras look, or how far they move; with a note."""
    depth = focus_depths(T_world_cam)
    if depth is None:
        (near, far), spacing, why = extent_depths(T_world_cam), "disparity", "the cameras' extent"
    elif transparent:
        near, far, spacing = 0.5 * float(depth.min()), 1.5 * float(depth.max()), "depth"
        why = "the distance to the point that the cameras look at, an object on nothing"
    else:
        near, far, spacing = 0.25 * float(depth.min()), 8 * float(depth.max()), "disparity"
        why = "the distance to the point that the cameras look at"
    return near, far, spacing, (f"near {near:.3g} and far {far:.3g} are guessed from {why}",)


def held_out_rows(count: int) -> tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"], str]:
    """Rows to train on and held out where no file says, every 8th from the first, and a note."""
    held_out = np.arange(count) % _HELD_OUT == 0
    note = f"held out: every {_HELD_OUT}th image, the first included"
    return np.flatnonzero(~held_out), np.flatnonzero(held_out), note
