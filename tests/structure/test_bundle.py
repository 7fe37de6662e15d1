"""Bundle adjustment: against the truth, against scipy on the same problem, among wrong matches, from afar."""

import numpy as np
import pytest
from helpers.shared_points import FOCAL, around, disturbed, seen
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxpose.evaluation.trajectory_error import align, pose_errors, procrustes
from jaxpose.geometry import rigid
from jaxpose.structure import adjust


def test_poses_far_off_are_found_among_wrong_matches():
    random = np.random.default_rng(0)
    T, points = around(20), random.uniform(-1, 1, (150, 3))
    tracks = seen(T, points, random, noise_px=0.2, wrong=0.1)
    start = disturbed(T, random, 0.8, 0.3)
    assert pose_errors(start, T).rotation_deg > 15
    found = adjust(tracks, start, depth=4.0)
    assert found is not None and found.supported.all()
    errors = pose_errors(found.T_world_cam, T)
    assert errors.rotation_deg < 0.1 and errors.centre < 0.01
    assert found.noise_px == pytest.approx(0.2, rel=0.25)
    assert_allclose(np.median(found.depth), 4.0, rtol=0.1)
    assert found.start_agrees < 0.3
    from_truth = adjust(tracks, T, depth=4.0)
    assert from_truth is not None and from_truth.start_agrees > 0.9


def test_against_scipy():
    """The same reprojection errors, without wrong matches, by another solver: the same least loss."""
    random = np.random.default_rng(1)
    T, points = around(6, degrees=120), random.uniform(-1, 1, (30, 3))
    tracks = seen(T, points, random, noise_px=0.5, share=1.0)
    found = adjust(tracks, disturbed(T, random, 0.05, 0.02), depth=4.0)

    def residual(x):
        poses, places = x[:36].reshape(6, 6), x[36:].reshape(-1, 3)
        R = Rotation.from_rotvec(poses[tracks.view, 3:]).as_matrix()
        at = np.einsum("oji,oj->oi", R, places[tracks.point] - poses[tracks.view, :3])
        off = FOCAL * (at[:, :2] / at[:, 2:] - tracks.xy_cam)
        ratio = (off**2).sum(1, keepdims=True) / (3 * found.noise_px) ** 2
        return (off / np.sqrt(1 + ratio)).ravel()  # Geman and McClure's, as sums of squares

    turns = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    best = least_squares(
        residual, np.concatenate([np.concatenate([T[:, :3, 3], turns], 1).ravel(), points.ravel()])
    )
    mine = Rotation.from_matrix(found.T_world_cam[:, :3, :3]).as_rotvec()
    ours = np.concatenate(
        [np.concatenate([found.T_world_cam[:, :3, 3], mine], 1).ravel(), found.points.ravel()]
    )
    assert (residual(ours) ** 2).sum() < 1.005 * (best.fun**2).sum()


def test_aligned_observations_count_as_they_are_surer():
    """Four in ten are ten times less off, which is found: better than taking all for alike."""
    off = {True: [], False: []}
    for seed in range(5):
        random = np.random.default_rng(seed)
        T, points = around(12, degrees=180), random.uniform(-1, 1, (60, 3))
        tracks = seen(T, points, random, noise_px=0.5, aligned=0.4)
        for told in off:
            told_so = tracks._replace(aligned=tracks.aligned & told)
            off[told].append(pose_errors(adjust(told_so, T, depth=4.0).T_world_cam, T).rotation_deg)
    assert np.median(off[True]) < 0.7 * np.median(off[False])


def test_all_cameras_may_start_in_one_place():
    """As for photographs without poses: a forward-facing scene; the depth settles the scale."""
    random = np.random.default_rng(2)
    centres = np.concatenate([random.uniform(-0.6, 0.6, (12, 2)), np.zeros((12, 1))], axis=1)
    T = rigid.make(rigid.so3_exp(random.normal(0, 0.05, (12, 3))), centres)
    points = np.concatenate([random.uniform(-2, 2, (200, 2)), random.uniform(3, 8, (200, 1))], axis=1)
    found = adjust(seen(T, points, random, noise_px=0.2), np.tile(np.eye(4), (12, 1, 1)), depth=5.0)
    assert pose_errors(found.T_world_cam, T).rotation_deg < 0.1
    assert_allclose(np.median(found.depth), 5.0)
    moved = align(procrustes(found.T_world_cam, T), found.T_world_cam)
    assert_allclose(moved[:, :3, 3], T[:, :3, 3], atol=0.02)


@pytest.mark.parametrize("given", ["of other photographs", "in one place"])
def test_given_poses_that_are_wrong_do_no_harm(given):
    random = np.random.default_rng(4)
    T, points = around(16), random.uniform(-1, 1, (90, 3))
    start = T[random.permutation(16)] if given == "of other photographs" else np.tile(T[0], (16, 1, 1))
    found = adjust(seen(T, points, random, noise_px=0.2, wrong=0.1), start, depth=4.0)
    assert found.supported.all() and pose_errors(found.T_world_cam, T).rotation_deg < 0.2


def test_photographs_that_share_nothing_keep_their_poses():
    random = np.random.default_rng(3)
    T, points = around(12), random.uniform(-1, 1, (80, 3))
    tracks = seen(T, points, random)
    kept = tracks.view != 5
    tracks = tracks._replace(view=tracks.view[kept], point=tracks.point[kept], xy_cam=tracks.xy_cam[kept])
    start = disturbed(T, random, 0.05, 0.02)
    found = adjust(tracks, start, depth=4.0)
    assert_allclose(np.flatnonzero(~found.supported), [5])
    assert_allclose(found.T_world_cam[5], start[5])
    none = tracks._replace(view=np.zeros(0, int), point=np.zeros(0, int), xy_cam=np.zeros((0, 2)))
    assert adjust(none, start, depth=4.0) is None


def test_bad_input():
    tracks = seen(around(5), np.zeros((3, 3)), np.random.default_rng(0), share=1.0)
    with pytest.raises(ValueError, match=r"T_start: expected shape \(5, 4, 4\), got \(4, 4, 4\)"):
        adjust(tracks, around(4), depth=4.0)
    with pytest.raises(ValueError, match="depth: expected more than 0, got 0"):
        adjust(tracks, around(5), depth=0.0)
    with pytest.raises(ValueError, match="T_start: "):
        adjust(tracks, np.full((5, 4, 4), np.nan), depth=4.0)
