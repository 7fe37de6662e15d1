"""Cameras around points, and what they see of them."""

import numpy as np

from jaxpose.geometry import rigid
from jaxpose.structure import Tracks

FOCAL = 200.0


def around(count: int, radius: float = 4.0, degrees: float = 360.0) -> np.ndarray:
    """Cameras on a wavy part of a circle that look at the origin."""
    angle = np.linspace(0, np.radians(degrees), count, endpoint=False)
    height = 0.6 * np.sin(2 * angle)
    centre = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    forward = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return rigid.make(np.stack([right, np.cross(forward, right), forward], axis=-1), centre)


def seen(
    T: np.ndarray,
    points: np.ndarray,
    random,
    noise_px: float = 0.0,
    wrong: float = 0.0,
    share=0.6,
    aligned=0.0,
):
    """Tracks of points, each in a share of the cameras; some of the matches lead anywhere.

    Some are aligned, and ten times less off.
    """
    view, point = np.nonzero(random.random((len(T), len(points))) < share)
    at = np.einsum("oji,oj->oi", T[view, :3, :3], points[point] - T[view, :3, 3])
    is_aligned = random.random(len(view)) < aligned if aligned else np.zeros(len(view), bool)
    sigma = np.where(is_aligned, 0.1, 1.0)[:, None] * noise_px / FOCAL
    xy = at[:, :2] / at[:, 2:] + sigma * random.normal(0, 1, (len(view), 2))
    lost = random.random(len(view)) < wrong
    xy[lost] = random.uniform(-0.3, 0.3, (lost.sum(), 2))
    return Tracks(view, point, xy, len(T), FOCAL, is_aligned)


def disturbed(T: np.ndarray, random, metres: float, radians: float) -> np.ndarray:
    return T @ rigid.exp(
        np.concatenate([random.normal(0, metres, (len(T), 3)), random.normal(0, radians, (len(T), 3))], 1)
    )
