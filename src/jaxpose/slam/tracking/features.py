"""Sparse features: the camera's pose by corners that earlier frames have seen, whatever map there is.

Corners of a pyramid, spread over the image, described by ORB (Rublee et al. 2011), matched by the ratio test
(Lowe 2004); the pose by RANSAC over three-point solutions (Ke and Roumeliotis 2017), refined by reweighted
least squares of the reprojection errors, whose spread is their noise. Detection, description, matching and
RANSAC are OpenCV's.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxpose.datasets.types import Frame
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, unproject_numpy

FEWEST = 12  # inliers of a pose that is believed: at random, three points and a few more agree now and then

_MOST = 700  # features of an image
_ROWS, _COLUMNS = 6, 8  # of cells that they are spread over
_CONTRAST = 7  # [grey levels] by which a corner stands out
_PYRAMID = (1.2, 8)  # from level to level, and levels
_RATIO = 0.8  # of the distance to the best match against that to the second best
_OUTLIER_PX = 3.0  # of reprojection, in RANSAC
_OUTLIER = 3.0  # sigmas of reprojection, in the end
_LEAST_NOISE = 0.3  # [px] of the finest level
_INDEPENDENT = 50.0  # features: errors of depth and of intrinsics go together
_STEPS = 10
_SETTLED = 1e-6  # [m, rad]
_NEAREST = 1e-3  # [m] in front of the camera
_SINGULAR = 1e12  # condition of an information that leaves some direction open
_MEDIAN_LENGTH = 1.177  # of a vector in the plane, normal in both directions, in sigmas


class Features(NamedTuple):
    """Corners of an image: where they point to, how far away and how coarse they are, what they look like."""

    direction_cam: Float[np.ndarray, "n 3"]  # z = 1
    depth: Float[np.ndarray, " n"]  # [m] along the optical axis; 0 where there is none
    scale: Float[np.ndarray, " n"]  # [px] of the level of the pyramid
    descriptor: UInt8[np.ndarray, "n 32"]
    usual_depth: float = 1.0  # [m] median of those known; kept, as every later frame asks for it

    @property
    def points_cam(self) -> Float[np.ndarray, "n 3"]:
        """Where they are, in camera axes [m]; the camera's centre for those without depth."""
        return self.direction_cam * self.depth[:, None]


class FeaturePose(NamedTuple):
    """A camera's pose by features."""

    T_world_cam: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]  # of right increments [m, rad], by the spread of reprojection
    inliers: int


def detect(frame: Frame, camera: Camera) -> Features:
    """The corners of a frame, the strongest of each part of it."""
    cv2 = _opencv()
    grey = cv2.cvtColor(np.ascontiguousarray(frame.rgb), cv2.COLOR_RGB2GRAY)
    keypoints, descriptor = _detector().compute(grey, _spread(_detector().detect(grey, None), grey.shape))
    if descriptor is None:
        return Features(np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros((0, 32), np.uint8))
    pixel = np.array([k.pt for k in keypoints], np.float64)
    scale = _PYRAMID[0] ** np.array([k.octave for k in keypoints], np.float64)
    column, row = np.rint(pixel).astype(int).T
    depth = frame.depth[row, column].astype(np.float64)
    features = Features(unproject_numpy(camera, pixel), depth, scale, descriptor)
    known = depth[depth > 0]
    return features._replace(usual_depth=float(np.median(known))) if len(known) else features


def locate_camera(
    now: Features, before: Sequence[tuple[Features, Float[np.ndarray, "4 4"]]], camera: Camera
) -> FeaturePose | None:
    """The pose of the camera that sees features among those of earlier frames, whose poses are known.

    Args:
        now: of the frame whose pose is asked for; they need no depth.
        before: features of frames with their poses `T_world_cam`; those without depth are left out.
        camera: of all of them.

    Returns:
        The pose; None where fewer than FEWEST features agree on one.
    """
    points, chosen = [], []
    for features, T_world_cam in before:
        i, j = match(features, now)
        near = features.depth[i] > 0
        points.append(rigid.apply(T_world_cam, features.points_cam[i[near]]))
        chosen.append(j[near])
    if not points:
        return None
    point, row = np.concatenate(points), np.concatenate(chosen)
    focal = float(camera.fx + camera.fy) / 2
    return _pose(point, now.direction_cam[row, :2], now.scale[row] / focal, focal)


def _opencv() -> Any:
    """OpenCV, loaded when it is first used."""
    try:
        import cv2
    except ImportError as error:
        raise DataError(
            f"features: expected OpenCV, got {error}: pip install opencv-python-headless, or --features none"
        ) from None
    return cv2


@lru_cache(maxsize=1)
def _detector():
    cv2 = _opencv()
    return cv2.ORB_create(4 * _MOST, *_PYRAMID, 31, 0, 2, cv2.ORB_HARRIS_SCORE, 31, _CONTRAST)


def _spread(keypoints: Sequence[Any], shape: tuple[int, ...]) -> Sequence[Any]:
    """The strongest keypoints of each cell of the image, as many of each as there is room for."""
    if len(keypoints) <= _MOST:
        return keypoints
    pixel = np.array([k.pt for k in keypoints])
    cell = (pixel / [shape[1] / _COLUMNS, shape[0] / _ROWS]).astype(int) @ [1, _COLUMNS]
    order = np.lexsort((-np.array([k.response for k in keypoints]), cell))
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    return [keypoints[k] for k in order[np.argsort(rank, kind="stable")[:_MOST]]]


def match(a: Features, b: Features) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Which features of two images look alike, and like no other; each of `b` once.

    Args:
        a: features of one image.
        b: of the other.

    Returns:
        Rows of `a` and rows of `b`, (m,) each.
    """
    cv2, none = _opencv(), np.zeros(0, int)
    if len(a.depth) < 2 or len(b.depth) < 2:
        return none, none
    distance, nearest = cv2.batchDistance(
        a.descriptor, b.descriptor, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
    )
    i = np.flatnonzero(distance[:, 0] < _RATIO * distance[:, 1])
    i = i[np.argsort(distance[i, 0], kind="stable")]
    j, first = np.unique(nearest[i, 0], return_index=True)
    return i[first], j


def _pose(
    point: Float[np.ndarray, "n 3"],
    xy: Float[np.ndarray, "n 2"],
    sigma: Float[np.ndarray, " n"],
    focal: float,
) -> FeaturePose | None:
    """The pose of a camera that sees world points at `xy` (z = 1), each known to `sigma` by its scale."""
    cv2 = _opencv()
    if len(point) < FEWEST:
        return None
    centre = point.mean(axis=0)  # far from the origin, RANSAC's solver would lose digits
    found, rotation, translation, chosen = cv2.solvePnPRansac(
        point - centre, np.ascontiguousarray(xy), np.eye(3), None, iterationsCount=300,
        reprojectionError=_OUTLIER_PX / focal, confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not found or chosen is None or len(chosen) < FEWEST:
        return None
    T = rigid.inverse(rigid.make(cv2.Rodrigues(rotation)[0], translation[:, 0]))
    refined = _refine(T, point - centre, xy, sigma)
    if refined is None:
        return None
    refined.T_world_cam[:3, 3] += centre
    return refined


class _Reprojection(NamedTuple):
    """How far, in sigmas, points are from where they are seen; infinite behind the camera."""

    size: Float[np.ndarray, " n"]
    residual: Float[np.ndarray, "n 2"]  # 0 behind the camera
    by_pose: Float[np.ndarray, "n 2 6"]  # derivative by right increments of the pose


def _reproject(
    T: Float[np.ndarray, "4 4"],
    point: Float[np.ndarray, "n 3"],
    xy: Float[np.ndarray, "n 2"],
    sigma: Float[np.ndarray, " n"],
) -> _Reprojection:
    point_cam = rigid.apply(rigid.inverse(T), point)
    front = point_cam[:, 2] > _NEAREST
    depth = np.where(front, point_cam[:, 2], 1.0)
    seen = point_cam[:, :2] / depth[:, None]
    residual = np.where(front[:, None], (seen - xy) / sigma[:, None], 0)
    change = np.zeros((len(point), 2, 3))  # of the residual by the point in camera axes
    change[:, 0, 0] = change[:, 1, 1] = 1
    change[:, :, 2] = -seen
    change /= (depth * sigma)[:, None, None]
    by_pose = np.concatenate([-change, np.cross(change, point_cam[:, None])], axis=-1)
    return _Reprojection(np.where(front, np.linalg.norm(residual, axis=1), np.inf), residual, by_pose)


def _refine(
    T: Float[np.ndarray, "4 4"],
    point: Float[np.ndarray, "n 3"],
    xy: Float[np.ndarray, "n 2"],
    sigma: Float[np.ndarray, " n"],
) -> FeaturePose | None:
    """The pose of least reprojection error (robust, Geman and McClure 1985); None where too few agree."""
    noise = 1.0
    for _ in range(_STEPS):
        at = _reproject(T, point, xy, sigma)
        near = at.size < 5 * _OUTLIER
        if near.sum() < FEWEST:
            return None
        noise = max(float(np.median(at.size[near])) / _MEDIAN_LENGTH, _LEAST_NOISE)
        weight = 1 / (1 + (at.size / (_OUTLIER * noise)) ** 2) ** 2
        rows = at.by_pose.reshape(-1, 6)
        weighted = rows * np.repeat(weight, 2)[:, None]
        information = weighted.T @ rows
        if np.linalg.cond(information) > _SINGULAR:
            return None
        step = -np.linalg.solve(information, weighted.T @ at.residual.reshape(-1))
        T = T @ rigid.exp(step)
        if np.linalg.norm(step) < _SETTLED:
            break
    at = _reproject(T, point, xy, sigma)
    inlier = at.size < _OUTLIER * noise
    rows = at.by_pose[inlier].reshape(-1, 6)
    information = rows.T @ rows
    if inlier.sum() < FEWEST or np.linalg.cond(information) > _SINGULAR:
        return None
    together = max(float(inlier.sum()) / _INDEPENDENT, 1.0)
    return FeaturePose(T, noise**2 * together * np.linalg.inv(information), int(inlier.sum()))
