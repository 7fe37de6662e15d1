"""Loops of a run: keyframes that show the same place with other places between them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int


class Loops(NamedTuple):
    """Relative poses of cameras at two keyframes each, the earlier one a, as their images gave them."""

    a: Int[np.ndarray, " m"]  # frames
    b: Int[np.ndarray, " m"]
    T_a_b: Float[np.ndarray, "m 4 4"]
    information: Float[np.ndarray, "m 6 6"]  # over right increments [m, rad]
    believed: Bool[np.ndarray, " m"]  # False: the others speak against it

    def appended(
        self, a: int, b: int, T_a_b: Float[np.ndarray, "4 4"], information: Float[np.ndarray, "6 6"]
    ) -> "Loops":
        """One loop more."""
        row = Loops(np.array([a]), np.array([b]), T_a_b[None], information[None], np.array([True]))
        return Loops(*(np.concatenate(pair) for pair in zip(self, row, strict=True)))


def no_loops(count: int = 0) -> Loops:
    """Places for `count` loops."""
    return Loops(
        np.zeros(count, int),
        np.zeros(count, int),
        np.zeros((count, 4, 4)),
        np.zeros((count, 6, 6)),
        np.zeros(count, bool),
    )


class Proposal(NamedTuple):
    """Where features, depths and motions together have the keyframes, and what depth images say to it."""

    keyframes: Int[np.ndarray, " k"]  # which frames
    T_world_cam: Float[np.ndarray, "k 4 4"]
    covariance: Float[np.ndarray, "k 6 6"]  # of these poses, over right increments; zero of the first
    motion_covariance: Float[np.ndarray, "j 6 6"]  # from each to the next, right increments of the later one
    moved_max: float  # [m] of a keyframe
    depths_apart: float  # how many times as far apart depth images are as where they were tracked
    agrees: bool  # whether that is no contradiction: then it is to be taken
    inflation: float  # else what covariances of tracked poses are to be multiplied by; 1 or more
