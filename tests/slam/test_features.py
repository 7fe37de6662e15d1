"""Sparse features: poses against known ones, covariances against trials, and images without texture."""

import sys

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxpose.datasets.types import Frame
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, project_numpy, unproject_numpy
from jaxpose.slam.tracking import features
from jaxpose.slam.tracking.features import FEWEST, Features, detect, locate_camera

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
LENS = Camera(300.0, 300.0, 159.5, 119.5, 320, 240, (-0.28, 0.07, 0.0002, 0.00002))
T_WORLD_CAM = rigid.exp(np.array([0.3, -0.2, 0.4, 0.1, 0.2, -0.1]))


def described(rng, direction_cam, depth):
    """Features that no other looks like."""
    n = len(depth)
    return Features(direction_cam, depth, np.ones(n), rng.integers(0, 256, (n, 32)).astype(np.uint8))


def two_views(rng, n, noise_px=0.0, wrong=0):
    """Points seen from the world's origin, and the same seen from T_WORLD_CAM, some of them elsewhere."""
    depth = rng.uniform(1.5, 4.0, n)
    xy = rng.uniform(-0.35, 0.35, (n, 2))
    first = described(rng, np.c_[xy, np.ones(n)], depth)
    point_cam = rigid.apply(rigid.inverse(T_WORLD_CAM), first.points_cam)
    seen = point_cam[:, :2] / point_cam[:, 2:] + rng.normal(size=(n, 2)) * noise_px / CAMERA.fx
    seen[:wrong] = rng.uniform(-0.4, 0.4, (wrong, 2))
    return first, Features(np.c_[seen, np.ones(n)], np.zeros(n), np.ones(n), first.descriptor)


def test_a_pose_is_found_among_half_wrong_matches():
    first, now = two_views(np.random.default_rng(0), 200, wrong=100)
    found = locate_camera(now, [(first, np.eye(4))], CAMERA)
    assert found is not None and 95 <= found.inliers <= 110
    assert_allclose(found.T_world_cam, T_WORLD_CAM, atol=1e-6)
    # What the first camera's pose is, the second's follows; far from the origin as near.
    T = rigid.make(np.eye(3), np.array([5e5, -4e6, 200.0]))
    moved = locate_camera(now, [(first, T)], CAMERA)
    assert moved is not None
    assert_allclose(moved.T_world_cam, T @ T_WORLD_CAM, atol=1e-6)


def test_the_covariance_is_that_of_many_trials():
    """Squared Mahalanobis distances of 300 trials: 6 on average, within the 99% band of their mean."""
    rng, n, trials = np.random.default_rng(1), 45, 300
    distances = []
    for _ in range(trials):
        first, now = two_views(rng, n, noise_px=0.8)
        found = locate_camera(now, [(first, np.eye(4))], CAMERA)
        assert found is not None
        error = rigid.log(rigid.inverse(T_WORLD_CAM) @ found.T_world_cam)
        distances.append(error @ np.linalg.solve(found.covariance, error))
    # The spread is itself estimated from 90 numbers, of which the robust weights drop some: 15% either way.
    assert 6 * 0.85 < np.mean(distances) < 6 * 1.35


def test_slopes_are_those_of_finite_differences():
    rng = np.random.default_rng(2)
    first, now = two_views(rng, 20, noise_px=2.0)
    point, xy, sigma = first.points_cam, now.direction_cam[:, :2], np.full(20, 1 / 300)
    at = features._reproject(T_WORLD_CAM, point, xy, sigma)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        after, before = (
            features._reproject(T_WORLD_CAM @ rigid.exp(s * step), point, xy, sigma).residual for s in (1, -1)
        )
        assert_allclose(at.by_pose[..., k], (after - before) / 2e-6, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("agree", [FEWEST - 1, 0])
def test_too_few_that_agree_are_no_pose(agree):
    first, now = two_views(np.random.default_rng(3), 60, wrong=60 - agree)
    found = locate_camera(now, [(first, np.eye(4))], CAMERA)
    # Wrong ones may agree with a few by chance, but never with a pose that is far off.
    assert found is None or np.linalg.norm(rigid.log(rigid.inverse(T_WORLD_CAM) @ found.T_world_cam)) < 0.1


def test_points_in_one_place_are_no_pose():
    first, now = two_views(np.random.default_rng(4), 40)
    one = first._replace(direction_cam=np.tile(first.direction_cam[:1], (40, 1)), depth=np.full(40, 2.0))
    same = now._replace(direction_cam=np.tile(now.direction_cam[:1], (40, 1)))
    assert locate_camera(same, [(one, np.eye(4))], CAMERA) is None


def wall_seen(camera, T_world_cam, seed=0):
    """A wall at z = 2 with a random texture, as a camera with a lens sees it."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (60, 60)).astype(np.uint8)
    texture = cv2.resize(coarse, (600, 600), interpolation=cv2.INTER_CUBIC)
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    direction = unproject_numpy(camera, np.stack([column, row], axis=-1)) @ T_world_cam[:3, :3].T
    along = (2.0 - T_world_cam[2, 3]) / direction[..., 2]
    point = T_world_cam[:3, 3] + along[..., None] * direction
    where = ((point[..., :2] + 2) * 150).astype(np.float32)
    grey = cv2.remap(texture, where[..., 0], where[..., 1], cv2.INTER_LINEAR)
    depth = (point - T_world_cam[:3, 3]) @ T_world_cam[:3, 2]
    return Frame(np.repeat(grey[..., None], 3, -1), depth.astype(np.float32))


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_a_camera_before_a_wall_is_found_as_well_as_it_is_said_to_be(camera):
    T = rigid.exp(np.array([0.15, -0.1, 0.1, 0.03, -0.05, 0.06]))
    before, now = (detect(wall_seen(camera, pose), camera) for pose in (np.eye(4), T))
    assert len(now.depth) > 200 and (now.depth > 0).all()
    found = locate_camera(now, [(before, np.eye(4))], camera)
    assert found is not None
    error = rigid.log(rigid.inverse(T) @ found.T_world_cam)
    assert np.linalg.norm(error[:3]) < 0.02 and np.linalg.norm(error[3:]) < 0.01  # 1 px is 0.7 cm, 0.003
    assert error @ np.linalg.solve(found.covariance, error) < 22.5  # the 99.9% of chi^2
    # A corner of the image points where its pixel does.
    pixel = project_numpy(camera, now.direction_cam)
    assert (pixel > -0.5).all() and (pixel < [camera.width, camera.height]).all()


def test_features_are_spread_over_the_image():
    """Two thousand strong corners in one cell do not take the places of five hundred weak ones elsewhere."""
    rng = np.random.default_rng(0)
    strong = [cv2.KeyPoint(*xy, 31, -1, 2 + r) for *xy, r in rng.uniform(0, [39, 39, 1], (2000, 3)).tolist()]
    places = rng.uniform([40, 40, 0], [320, 240, 1], (500, 3)).tolist()
    weak = [cv2.KeyPoint(*xy, 31, -1, r) for *xy, r in places]
    chosen = features._spread([*strong, *weak], (240, 320))
    assert len(chosen) == features._MOST
    kept = {k.response for k in chosen}
    assert {k.response for k in weak} <= kept
    assert sorted(k.response for k in strong)[500 - features._MOST :] == sorted(r for r in kept if r >= 2)


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_without_texture_there_are_none(grey):
    blank = detect(Frame(np.full((240, 320, 3), grey, np.uint8), np.ones((240, 320), np.float32)), CAMERA)
    assert len(blank.depth) == 0 and blank.usual_depth == 1
    seen = detect(wall_seen(CAMERA, np.eye(4)), CAMERA)
    for now, before in ((blank, seen), (seen, blank), (blank, blank)):
        assert locate_camera(now, [(before, np.eye(4))], CAMERA) is None
    assert locate_camera(seen, [], CAMERA) is None
    assert locate_camera(seen, [(seen._replace(depth=0 * seen.depth), np.eye(4))], CAMERA) is None


def test_without_opencv_one_line_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    expected = r"features: expected OpenCV, .*opencv-python-headless.*--features none"
    with pytest.raises(DataError, match=expected):
        detect(wall_seen(CAMERA, np.eye(4)), CAMERA)
