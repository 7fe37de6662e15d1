"""Keyframes: overlap against a loop over points, and what a window holds."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxpose.geometry.camera import Camera
from jaxpose.slam.keyframes import choose, overlap

CAMERA = Camera(50.0, 55.0, 31.0, 23.0, 64, 48)


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return T


def test_overlap_is_the_share_of_points_in_the_image():
    points, T_world_cam, margin = np.random.default_rng(1).normal(size=(300, 3)) * 2, poses(5), 7
    expected = np.zeros(5)
    for k, T in enumerate(T_world_cam):
        for point in points:
            x, y, z, _ = np.linalg.solve(T, [*point, 1])
            if z > 0:
                u, v = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
                expected[k] += (margin <= u < 64 - margin and margin <= v < 48 - margin) / 300
    assert 0 < expected.min() < expected.max() < 1
    assert_allclose(overlap(points, T_world_cam, CAMERA, margin=margin), expected, atol=1e-12)


def test_what_lies_behind_is_not_seen():
    ahead = np.array([[0.0, 0.0, 2.0]])
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert overlap(ahead, np.stack([np.eye(4), turned]), CAMERA).tolist() == [1, 0]


def test_a_window_holds_the_last_keyframe_and_others_that_overlap():
    shares = np.array([0.5, 0.0, 0.2, 0.9, 0.0, 0.0])
    seen = set()
    for seed in range(30):
        chosen = choose(shares, 3, np.random.default_rng(seed))
        assert chosen[0] == 5  # whether it overlaps or not
        assert len(set(chosen)) == 3
        seen |= set(chosen[1:])
    assert seen == {0, 2, 3}


def test_few_keyframes_are_repeated():
    generator = np.random.default_rng(0)
    assert choose(np.array([0.5]), 4, generator) == [0, 0, 0, 0]
    assert sorted(choose(np.array([0.0, 0.5]), 4, generator)) == [1, 1, 1, 1]
    assert choose(np.array([0.5, 0.1]), 4, generator) == [1, 0, 1, 0]


def test_the_choice_follows_from_the_seed():
    draw = lambda seed: choose(np.ones(50), 10, np.random.default_rng(seed))
    assert draw(3) == draw(3)
    assert draw(3) != draw(4)
