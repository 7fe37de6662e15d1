"""Bundle adjustment with depth and motions: against the truth and scipy, and how sure it is of motions."""

import numpy as np
import pytest
from helpers.shared_points import FOCAL, around, disturbed, seen
from scipy.optimize import least_squares

from jaxpose.estimate.pose_graph import Edges
from jaxpose.evaluation.trajectory_error import pose_errors
from jaxpose.geometry import rigid
from jaxpose.structure.measured import adjust_measured


def problem(random, views=12, noise_px=0.3, deep=0.01, moved=0.01, share=0.6, count=200):
    """A part of a circle and what it sees, depths with errors as of disparities, motions with errors."""
    T, points = around(views, degrees=120), random.uniform(-1, 1, (count, 3))
    tracks = seen(T, points, random, noise_px=noise_px, share=share)
    z = np.einsum("oj,oj->o", T[tracks.view, :3, 2], points[tracks.point] - T[tracks.view, :3, 3])
    depth = z + deep * z**2 * random.normal(size=len(z))
    true = rigid.inverse(T[:-1]) @ T[1:]
    motion = disturbed(true, random, moved, moved)
    a = np.arange(views - 1)
    information = np.tile(np.eye(6) / moved**2, (views - 1, 1, 1))
    start = [T[0]]
    for each in motion:
        start.append(start[-1] @ each)
    return T, tracks, depth, np.stack(start), Edges(a, a + 1, motion, information, np.zeros(views - 1, bool))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_points_seen_by_many_hold_the_poses_whatever_a_few_say(seed):
    random = np.random.default_rng(seed)
    T, tracks, depth, start, motions = problem(random)
    clean = pose_errors(adjust_measured(tracks, depth, start, motions).T_world_cam, T)
    depth[random.random(len(depth)) < 0.2] *= 1.5  # edges that fly
    depth[random.random(len(depth)) < 0.2] = 0
    wrong = random.random(len(depth)) < 0.05
    tracks.xy_cam[wrong] += random.uniform(-0.1, 0.1, (wrong.sum(), 2))
    found = adjust_measured(tracks, depth, start, motions).T_world_cam
    np.testing.assert_array_equal(found[0], T[0])
    before, after = (pose_errors(x, T) for x in (start, found))
    assert before.centre > 0.02 and before.rotation_deg > 1
    assert clean.centre < 0.007 and clean.rotation_deg < 0.25
    assert after.centre < 1.2 * clean.centre and after.rotation_deg < 1.2 * clean.rotation_deg


def test_no_depth_at_all_leaves_the_motions():
    random = np.random.default_rng(1)
    _, tracks, depth, start, motions = problem(random)
    found = adjust_measured(tracks, 0 * depth, start, motions)
    np.testing.assert_allclose(found.T_world_cam, start, atol=1e-6)
    np.testing.assert_allclose(found.covariance[1], found.motion_covariance[0], atol=1e-12)
    # A lever: the first motion's error of rotation moves the third pose, about where the second was.
    across = rigid.inverse(rigid.inverse(start[1]) @ start[2])
    both = rigid.carried(across[None], found.motion_covariance[:1])[0] + found.motion_covariance[1]
    np.testing.assert_allclose(found.covariance[2], both, atol=1e-12)


def test_against_scipy():
    """Errors that are normal: nearly the least squares of the same errors in units of their true spread."""
    random = np.random.default_rng(2)
    T, tracks, depth, start, motions = problem(random, views=5, share=1.0, count=80)
    found = adjust_measured(tracks, depth, start, motions).T_world_cam

    def residual(x):
        poses = np.concatenate([T[:1], start[1:] @ rigid.exp(x[:24].reshape(4, 6))])
        places = x[24:].reshape(-1, 3)[np.unique(tracks.point, return_inverse=True)[1]]
        away = places - poses[tracks.view, :3, 3]
        at = np.einsum("oji,oj->oi", poses[tracks.view, :3, :3], away)
        off = FOCAL * (at[:, :2] / at[:, 2:] - tracks.xy_cam) / 0.3
        deep = (at[:, 2] - depth) / at[:, 2] ** 2 / 0.01
        tied = rigid.log(rigid.inverse(motions.T_a_b) @ rigid.inverse(poses[:-1]) @ poses[1:]) / 0.01
        return np.concatenate([off.ravel(), deep, tied.ravel()])

    _, first = np.unique(tracks.point, return_index=True)
    ray = np.concatenate([tracks.xy_cam[first], np.ones((len(first), 1))], axis=1) * depth[first, None]
    places = rigid.apply(start[tracks.view[first]], ray).ravel()
    best = least_squares(residual, np.concatenate([np.zeros(24), places]))
    ours = rigid.log(rigid.inverse(start[1:]) @ found[1:]).ravel()
    of_ours = least_squares(lambda x: residual(np.concatenate([ours, x])), places)
    of_start = least_squares(lambda x: residual(np.concatenate([0 * ours, x])), places)
    assert best.cost < of_ours.cost < 1.02 * best.cost < 1.5 * best.cost < of_start.cost


@pytest.mark.parametrize("told", [0.1, 1.0, 10.0])
def test_motions_count_as_they_agree_and_not_as_they_say(told):
    """Whatever factor their information is told with; errors of motions and poses are as large as stated."""
    random = np.random.default_rng(3)
    squares, of_poses = [], []
    for _ in range(6):
        T, tracks, depth, start, motions = problem(random, moved=0.002)
        motions = motions._replace(information=told * motions.information)
        found, known, covariance = adjust_measured(tracks, depth, start, motions)
        assert not known[0].any()
        off = rigid.log(rigid.inverse(T[1:]) @ found[1:])
        of_poses.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(known[1:]), off))
        off = rigid.log(rigid.inverse(rigid.inverse(T[:-1]) @ T[1:]) @ rigid.inverse(found[:-1]) @ found[1:])
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off))
    assert 4 < np.mean(squares) < 9 and 3 < np.mean(of_poses) < 10  # 6 numbers each


def test_what_does_not_fit_is_refused():
    _, tracks, depth, start, motions = problem(np.random.default_rng(4))
    with pytest.raises(ValueError, match="depth: expected shape"):
        adjust_measured(tracks, depth[1:], start, motions)
    start[3, 0, 0] = np.nan
    with pytest.raises(ValueError, match="T_start"):
        adjust_measured(tracks, depth, start, motions)
