"""Points that photographs share: of a textured plane, whose images are known homographies of one another."""

import cv2
import numpy as np
import pytest

from jaxpose.geometry.camera import Camera
from jaxpose.structure import find_tracks
from jaxpose.structure.tracks import _detect

CAMERA = Camera(300.0, 300.0, 119.5, 89.5, 240, 180)


def plane(count: int):
    """A blotched plane at z = 2 from cameras that move and turn: photographs, homographies from the first."""
    random = np.random.default_rng(0)
    blots = cv2.GaussianBlur(random.uniform(0, 255, (400, 500, 3)).astype(np.float32), (0, 0), 3)
    blots = np.clip(128 + 8 * (blots - blots.mean()), 0, 255).astype(np.uint8)
    K = np.array([[300.0, 0, 119.5], [0, 300.0, 89.5], [0, 0, 1]])
    photographs, H = [], []
    for k in range(count):
        turn = cv2.Rodrigues(np.array([0.0, 0.03 * k, 0.02 * k]))[0]
        shift = np.array([0.08 * k, 0.0, 0.03 * k])
        H.append(K @ (turn + np.outer(shift, [0, 0, 1]) / 2) @ np.linalg.inv(K))
        whole = H[k] @ np.array([[1.0, 0, -130], [0, 1, -110], [0, 0, 1]])
        photographs.append(cv2.warpPerspective(blots, whole, (240, 180), flags=cv2.INTER_AREA))
    return np.stack(photographs), H


def test_points_of_a_plane():
    photographs, H = plane(5)
    steps = []
    tracks = find_tracks(photographs, CAMERA, on_step=lambda *step: steps.append(step))
    assert tracks.views == 5 and tracks.points > 50
    assert ("features", 5, 5) in steps and ("pairs", 10, 10) in steps
    pixel = 300 * tracks.xy_cam + [119.5, 89.5]
    at = np.concatenate([pixel, np.ones((len(pixel), 1))], axis=1)
    first = np.einsum("oij,oj->oi", np.linalg.inv(np.array(H))[tracks.view], at)
    first = first[:, :2] / first[:, 2:]
    centre = np.stack([np.bincount(tracks.point, x) for x in first.T], 1) / np.bincount(tracks.point)[:, None]
    off = np.linalg.norm(first - centre[tracks.point], axis=1)
    assert np.median(off) < 0.3 and np.mean(off < 1.5) > 0.95
    pairs = set(zip(tracks.view.tolist(), tracks.point.tolist(), strict=True))
    assert len(pairs) == len(tracks.view)  # a photograph sees a point once


@pytest.mark.parametrize("sigma", [1.5, 3.0, 6.0])
def test_a_blob_is_where_its_middle_is(sigma):
    """OpenCV's own places are a quarter of a pixel aside, an eighth of one that was doubled."""
    random, off = np.random.default_rng(0), []
    for size in (100, 700):  # the smaller one is enlarged first
        rows, columns = np.mgrid[:size, :size]
        for x, y in size / 2 + random.uniform(-3, 3, (8, 2)):
            bright = 40 + 180 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
            found = _detect(np.tile(bright.round().astype(np.uint8)[..., None], 3), None).pixel
            off.append(found[np.linalg.norm(found - [x, y], axis=1).argmin()] - [x, y])
    assert np.abs(np.mean(off, axis=0)).max() < 0.04


def test_nothing_is_found_where_there_is_nothing():
    grey = np.full((4, 180, 240, 3), 128, np.uint8)
    assert find_tracks(grey, CAMERA).points == 0
    photographs, _ = plane(3)
    masked = find_tracks(photographs, CAMERA, np.zeros((3, 180, 240), bool))
    assert masked.points == 0
