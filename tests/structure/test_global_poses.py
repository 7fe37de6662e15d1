"""Relative rotations with their information, and poses from them: against the truth, among wrong matches."""

import numpy as np
from helpers.shared_points import around, seen

from jaxpose.evaluation.trajectory_error import pose_errors
from jaxpose.geometry import rigid
from jaxpose.structure.global_poses import global_poses
from jaxpose.structure.relative import relative_rotations


def test_information_of_relative_rotations_says_how_far_off_they_are():
    random = np.random.default_rng(0)
    T, points = around(14, degrees=150), random.uniform(-1, 1, (80, 3))
    found = relative_rotations(seen(T, points, random, noise_px=0.3, share=0.9))
    assert len(found.a) > 60
    true = (rigid.inverse(T[found.a]) @ T[found.b])[:, :3, :3]
    off = rigid.so3_log(found.R_a_b.swapaxes(1, 2) @ true)
    assert np.degrees(np.median(np.linalg.norm(off, axis=1))) < 1.0
    chi2 = np.einsum("pi,pij,pj->p", off, found.information, off)
    assert 1.5 < np.median(chi2) < 4.0  # 2.37, if errors are as they say


def test_poses_need_no_start():
    random = np.random.default_rng(1)
    T, points = around(16), random.uniform(-1, 1, (90, 3))
    found, tied = global_poses(seen(T, points, random, noise_px=0.2, wrong=0.15))
    assert tied.all()
    errors = pose_errors(found, T)
    assert errors.rotation_deg < 0.5 and errors.centre < 0.05
    away = np.linalg.norm(found[:, :3, 3] - found[:, :3, 3].mean(axis=0), axis=1)
    assert 0.6 < np.median(away) < 1.4  # points are about 1 away, and cameras look inwards


def test_photographs_that_pairs_do_not_tie_are_left_out():
    random = np.random.default_rng(2)
    T, points = around(12), random.uniform(-1, 1, (80, 3))
    tracks = seen(T, points, random, share=0.9)
    kept = (tracks.view < 9) == (tracks.point < 60)  # nine see some points, the others the rest
    tracks = tracks._replace(
        view=tracks.view[kept],
        point=tracks.point[kept],
        xy_cam=tracks.xy_cam[kept],
        aligned=tracks.aligned[kept],
    )
    found, tied = global_poses(tracks)
    np.testing.assert_array_equal(tied, np.arange(12) < 9)
    np.testing.assert_array_equal(found[9:], np.tile(np.eye(4), (3, 1, 1)))
    assert pose_errors(found[:9], T[:9]).rotation_deg < 0.1
    no, nothing = np.zeros(0, int), np.zeros(0, bool)
    none = tracks._replace(view=no, point=no, xy_cam=np.zeros((0, 2)), aligned=nothing)
    assert not global_poses(none)[1].any()
