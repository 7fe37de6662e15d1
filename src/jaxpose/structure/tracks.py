"""Which points photographs share: features of each, matched between photographs that look alike.

Blobs of the three colour channels, described by SIFT (Lowe 2004; square roots of histograms, Arandjelovic
and Zisserman 2012), matched by the ratio test in both directions, kept where an essential matrix explains
them (Nister 2004, RANSAC), moved to where their patches agree. Detection, description and RANSAC (its USAC)
are OpenCV's.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxpose.geometry.camera import Camera, unproject_numpy
from jaxpose.structure.patches import align_patches

FEWEST = 15  # matches of two photographs that are believed: at random, five and a few more agree now and then

_MOST = 1000  # features of a photograph
_CONTRAST, _EDGE = 0.006, 10.0  # of SIFT: fainter blobs count than in its paper, RANSAC sorts them out
_SMALL_PX = 200  # images below it are enlarged twice: their finest blobs are too fine for SIFT's first octave
_RATIO = 0.85  # of the distance to the best match against that to the second best
OUTLIER_PX = 0.7  # from the epipolar line
_AGREE = 0.5  # share of two photographs' matches that has to
_SURE = 0.9999  # that RANSAC finds a motion
_ALL_PAIRS = 40  # photographs, up to which each is matched with each
_NEIGHBOURS, _ALIKE = 6, 10  # else: photographs before and after, and most alike, that each is matched with
_SHORTEST = 3  # photographs that see a point


class Tracks(NamedTuple):
    """Points that photographs share: observation by observation."""

    view: Int[np.ndarray, " o"]  # which photograph
    point: Int[np.ndarray, " o"]  # which point, 0 to `points` - 1
    xy_cam: Float[np.ndarray, "o 2"]  # where it is seen, on the plane z = 1 of the camera, without distortion
    views: int
    focal: float  # [px]
    aligned: Bool[np.ndarray, " o"]  # where it is seen is known by its patch: to a fraction of others' error

    @property
    def points(self) -> int:
        """How many points there are."""
        return int(self.point.max(initial=-1)) + 1


class _Features(NamedTuple):
    pixel: Float[np.ndarray, "n 2"]
    descriptor: Float[np.ndarray, "n 131"]  # of length 1, its last three entries by the channel


def find_tracks(
    rgb: UInt8[np.ndarray, "n h w 3"],
    camera: Camera,
    mask: Bool[np.ndarray, "n h w"] | None = None,
    on_step: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Tracks:
    """Find points that at least three photographs share.

    Args:
        rgb: Photographs (n, h, w, 3); neighbours in this order are taken to be neighbours in time.
        camera: Of all of them.
        mask: Which pixels count (n, h, w); None: all.
        on_step: Called with what is done, how much of it, and of how many.

    Returns:
        The observations; none where the photographs share nothing.
    """
    features = []
    for index, image in enumerate(rgb):
        features.append(_detect(image, None if mask is None else mask[index]))
        on_step("features", index + 1, len(rgb))
    directions = [unproject_numpy(camera, each.pixel)[:, :2] for each in features]
    focal = float(camera.fx + camera.fy) / 2
    pairs = _pairs(rgb)
    found = []
    for done, (i, j) in enumerate(pairs):
        matches, distance = _matches(features[i], features[j])
        kept = _verified(directions[i][matches[:, 0]], directions[j][matches[:, 1]], focal)
        both = zip(distance[kept].tolist(), matches[kept].tolist(), strict=True)
        found += [(d, i, a, j, b) for d, (a, b) in both]
        on_step("pairs", done + 1, len(pairs))
    view, feature, point = joined(sorted(found), [len(each.pixel) for each in features])
    pixel = np.array([features[v].pixel[f] for v, f in zip(view, feature, strict=True)]).reshape(-1, 2)
    on_view = partial(on_step, "patches")
    placed = align_patches(rgb.__getitem__, view, point, pixel, _enlarged(rgb[0]), on_view)
    return Tracks(view, point, unproject_numpy(camera, placed.pixel)[:, :2], len(rgb), focal, placed.found)


def _detect(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None) -> _Features:
    """The strongest features of the three channels: grey would miss what is seen by its colour alone."""
    scale = _enlarged(image)
    size = image.shape[1] * scale, image.shape[0] * scale
    counts = (
        None if mask is None else cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    )
    opencv: Any = cv2  # its type stubs lack SIFT
    # Unless it is told to, it doubles the image a quarter of a pixel aside.
    sift = opencv.SIFT_create(contrastThreshold=_CONTRAST, edgeThreshold=_EDGE, enable_precise_upscale=True)
    pixel, response, descriptor = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros((0, 131), np.float32)]
    for channel in range(3):
        plane = np.ascontiguousarray(image[..., channel])
        if scale > 1:
            plane = cv2.resize(plane, size, interpolation=cv2.INTER_CUBIC)
        keypoints, histogram = sift.detectAndCompute(plane, counts)
        if not keypoints:
            continue
        pixel.append((np.array([k.pt for k in keypoints]) + 0.5) / scale - 0.5)
        response.append(np.array([k.response for k in keypoints]))
        total = np.maximum(histogram.sum(axis=1, keepdims=True), 1e-9)
        channels = np.tile(np.eye(3, dtype=np.float32)[channel], (len(keypoints), 1))
        descriptor.append(np.concatenate([np.sqrt(histogram / total), channels], axis=1) / np.sqrt(2))
    order = np.argsort(-np.concatenate(response), kind="stable")[:_MOST]
    return _Features(np.concatenate(pixel)[order], np.concatenate(descriptor)[order].astype(np.float32))


def _enlarged(image: UInt8[np.ndarray, "h w 3"]) -> int:
    return 2 if min(image.shape[:2]) < _SMALL_PX else 1


def _pairs(rgb: UInt8[np.ndarray, "n h w 3"]) -> list[tuple[int, int]]:
    """Photographs to match: all with all if they are few, else neighbours and those most alike from afar."""
    count = len(rgb)
    if count <= _ALL_PAIRS:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    small = np.stack([cv2.resize(image, (12, 12), interpolation=cv2.INTER_AREA) for image in rgb])
    small = small.reshape(count, -1).astype(np.float64)
    small -= small.mean(axis=1, keepdims=True)
    small /= np.maximum(np.linalg.norm(small, axis=1, keepdims=True), 1e-9)
    alike = small @ small.T
    np.fill_diagonal(alike, -np.inf)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _NEIGHBOURS, count))}
    for i, others in enumerate(np.argsort(-alike, axis=1, kind="stable")[:, :_ALIKE].tolist()):
        pairs |= {(min(i, j), max(i, j)) for j in others}
    return sorted(pairs)


def _matches(a: _Features, b: _Features) -> tuple[Int[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Features of two photographs that are each other's best and like no other, and their distances."""
    if min(len(a.pixel), len(b.pixel)) < 2:
        return np.zeros((0, 2), int), np.zeros(0)
    alike = a.descriptor @ b.descriptor.T
    rows = np.arange(len(alike))
    best = alike.argmax(axis=1)
    first = alike[rows, best]
    back = alike.argmax(axis=0)
    alike[rows, best] = -np.inf
    distance, second = (np.sqrt(np.maximum(2 - 2 * x, 0)) for x in (first, alike.max(axis=1)))
    i = np.flatnonzero((distance < _RATIO * second) & (back[best] == rows))
    return np.stack([i, best[i]], axis=1), distance[i]


def _verified(
    a: Float[np.ndarray, "m 2"], b: Float[np.ndarray, "m 2"], focal: float
) -> Int[np.ndarray, " k"]:
    """Which matches one motion of the camera explains; none unless many do."""
    none = np.zeros(0, int)
    if len(a) < FEWEST:
        return none
    fewest = max(FEWEST, _AGREE * len(a))
    # Samples of five that find so many that agree, twice as often as without noise; fewer are not believed.
    samples = 2 * math.log(1 - _SURE) / math.log1p(-min((fewest / len(a)) ** 5, _SURE))
    _, chosen = cv2.findEssentialMat(
        a,
        b,
        np.eye(3),
        method=cv2.USAC_ACCURATE,
        prob=_SURE,
        threshold=OUTLIER_PX / focal,
        maxIters=math.ceil(samples),
    )
    kept = none if chosen is None else np.flatnonzero(chosen)
    return kept if len(kept) >= fewest else none


def joined(
    matches: list[tuple[float, int, int, int, int]], counts: list[int]
) -> tuple[Int[np.ndarray, " o"], Int[np.ndarray, " o"], Int[np.ndarray, " o"]]:
    """Join matches to points, the surest first.

    Two points are not joined that one photograph sees both of: one of the matches between them is wrong.

    Args:
        matches: Of each its distance, a photograph and which of its features, another one and which of its.
        counts: How many features each photograph has.

    Returns:
        View, feature and point of every observation of the points that three photographs see, by views.
    """
    start = np.cumsum([0, *counts]).tolist()
    view = np.repeat(np.arange(len(counts)), counts)
    parent = list(range(start[-1]))
    seen_by = [{v} for v in view.tolist()]

    def root(x: int) -> int:
        while parent[x] != x:
            parent[x] = parent[parent[x]]
            x = parent[x]
        return x

    for _, i, a, j, b in matches:
        one, other = root(start[i] + a), root(start[j] + b)
        if one != other and not seen_by[one] & seen_by[other]:
            parent[one] = other
            seen_by[other] |= seen_by[one]
    roots = np.array([root(x) for x in parent], int)
    _, which, size = np.unique(roots, return_inverse=True, return_counts=True)
    kept = np.flatnonzero((size >= _SHORTEST)[which])
    _, point = np.unique(which[kept], return_inverse=True)
    return view[kept], kept - np.array(start)[view[kept]], point
