"""What was known of poses beside what photographs share: against scipy, and as sure as errors are."""

import numpy as np
import pytest
from helpers.shared_points import FOCAL, around, disturbed, seen
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxpose.evaluation.trajectory_error import align, procrustes
from jaxpose.geometry import rigid
from jaxpose.structure import adjust
from jaxpose.structure.uncertainty import aligned_covariances, covariances

_HOLDS_90 = 10.64  # chi-squared of six numbers


def informations(sigma):
    """Of a sigma for each of six increments of each pose."""
    return sigma[:, :, None] ** -2.0 * np.eye(6)


def only(tracks, kept):
    """Some of the observations."""
    names = ("view", "point", "xy_cam", "aligned")
    return tracks._replace(**{name: getattr(tracks, name)[kept] for name in names})


def test_against_scipy():
    """The same least squares, of what was known and of points, in another solver: less is nowhere near."""
    random = np.random.default_rng(1)
    T, points = around(5, degrees=100), random.uniform(-1, 1, (24, 3))
    tracks = seen(T, points, random, noise_px=0.5, share=1.0)
    sigma = np.array([0.02, 0.02, 0.05, 0.01, 0.01, 0.005]) * np.arange(1, 6)[:, None]
    start = T @ rigid.exp(sigma * random.normal(0, 1, (5, 6)))
    found = adjust(tracks, start, depth=4.0, information=informations(sigma))

    def residual(x):
        poses, places = x[:30].reshape(5, 6), x[30:].reshape(-1, 3)
        at = rigid.make(Rotation.from_rotvec(poses[:, 3:]).as_matrix(), poses[:, :3])
        off = np.einsum("oji,oj->oi", at[tracks.view, :3, :3], places[tracks.point] - poses[tracks.view, :3])
        off = FOCAL * (off[:, :2] / off[:, 2:] - tracks.xy_cam)
        ratio = (off**2).sum(1, keepdims=True) / (3 * found.noise_px) ** 2
        known = rigid.log(rigid.inverse(start) @ at) / sigma
        return np.concatenate([(off / found.noise_px / np.sqrt(1 + ratio)).ravel(), known.ravel()])

    packed = lambda T, points: np.concatenate(
        [np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_rotvec()]).ravel(), points.ravel()]
    )
    best = least_squares(residual, packed(found.T_world_cam, found.points), method="lm", max_nfev=2000)
    loss = lambda found: (residual(packed(found.T_world_cam, found.points)) ** 2).sum()
    assert loss(found) < 1.005 * (best.fun**2).sum()
    assert loss(adjust(tracks, start, depth=4.0)) > 1.2 * (best.fun**2).sum()


@pytest.mark.parametrize("known", [False, True], ids=["after an alignment", "in the world of what was known"])
def test_covariances_are_those_of_simulated_errors(known):
    """Among wrong matches; what was known is uniform, and five times surer of every fourth pose."""
    squares = []
    for seed in range(5):
        random = np.random.default_rng(seed)
        T, points = around(16), random.uniform(-1, 1, (80, 3))
        tracks = seen(T, points, random, noise_px=0.5, wrong=0.1)
        sigma = np.where(np.arange(16) % 4, 0.2, 0.04)[:, None] * np.array([1, 1, 1, 0.3, 0.3, 0.3])
        start = T @ rigid.exp(sigma * random.uniform(-1, 1, (16, 6)) * np.sqrt(3))
        found = adjust(tracks, start, depth=4.0, information=informations(sigma) if known else None)
        poses = found.T_world_cam
        poses = poses if known else align(procrustes(poses, T), poses)
        off = rigid.log(rigid.inverse(poses) @ T)
        squares += np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance), off).tolist()
    assert 4.5 < np.mean(squares) < 8
    assert 0.8 < np.mean(np.array(squares) < _HOLDS_90) < 0.97


def test_sure_poses_hold_the_world():
    """Two cameras that are known to a millimetre place and scale all others, which are 40 cm off."""
    random = np.random.default_rng(5)
    T, points = around(12), random.uniform(-1, 1, (120, 3))
    tracks = seen(T, points, random, noise_px=0.2)
    tracks = only(tracks, tracks.view != 9)  # which sees nothing
    sigma = np.full((12, 6), 0.4)
    sigma[[0, 6]] = 1e-3
    start = disturbed(T, random, 0.4, 0.1)
    start[[0, 6]] = T[[0, 6]]
    found = adjust(tracks, start, depth=4.0, information=informations(sigma))
    others = np.setdiff1d(np.arange(12), [9])
    assert_allclose(found.T_world_cam[others, :3, 3], T[others, :3, 3], atol=0.02)
    assert not found.supported[9]
    assert_allclose(found.T_world_cam[9], start[9])
    assert_allclose(found.covariance[9], 0.16 * np.eye(6))
    free = adjust(tracks, start, depth=4.0)
    assert np.abs(free.T_world_cam[others, :3, 3] - T[others, :3, 3]).max() > 0.1
    assert np.isnan(free.covariance[9]).all()


def test_what_is_held_by_nothing_has_no_covariance():
    T, tied = around(4), np.eye(24)
    assert_allclose(covariances(4 * tied), np.tile(np.eye(6) / 4, (4, 1, 1)))
    assert np.isnan(covariances(np.diag(np.r_[0.0, np.ones(23)]))).all()
    assert np.isnan(aligned_covariances(T, np.zeros((24, 24)))).all()


def test_bad_input():
    tracks = seen(around(5), np.zeros((3, 3)), np.random.default_rng(0), share=1.0)
    with pytest.raises(ValueError, match="information: expected positive definite matrices"):
        adjust(tracks, around(5), depth=4.0, information=np.zeros((5, 6, 6)))
