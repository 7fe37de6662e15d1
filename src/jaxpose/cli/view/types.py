"""What there is to see of a run, as plain data."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

if TYPE_CHECKING:
    from jaxpose.geometry.camera import Camera

WIDTH = 160  # [px] of pictures

Picture = UInt8[np.ndarray, "h w 3"]
Poses = Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 4 4"]]
Render = Callable[[float, int], Picture]  # at a time [s], about so wide [px]


class Shot(NamedTuple):
    """A frame of the run, and the picture that is shown in it."""

    t: float  # [s] since the first frame
    T_world_cam: Float[np.ndarray, "4 4"]
    rgb: Picture | None


class Scene(NamedTuple):
    """What there is to see, in the world of the trajectory.txt; times [s] count from the first frame."""

    name: str  # in words
    camera: "Camera"
    t: Float[np.ndarray, " n"]  # of the frames
    path: Float[np.ndarray, "m 3"]  # the camera's centre
    reference: Float[np.ndarray, "k 3"] | None  # that of the ground truth
    shots: tuple[Shot, ...]
    keyframes: Float[np.ndarray, "j 3"]  # centres; none where the run has no keyframes or does not say
    surface: Path | None  # PLY: a mesh, or else points
    up: Float[np.ndarray, "3"]
    poses: Poses  # T_world_cam at any times
    render: Render | None  # what the run's scene shows from there
    notes: tuple[str, ...]
