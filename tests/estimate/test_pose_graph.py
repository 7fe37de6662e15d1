"""Pose graphs against scipy's least squares, and with relative poses that are wrong."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxpose.estimate.pose_graph import CHI2_999, Edges, optimise_pose_graph, squared_distances
from jaxpose.geometry import rigid


def circle(count: int, sigma: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, Edges]:
    """True poses once and a half around a circle, those by noisy motions, and loops."""
    rng = np.random.default_rng(seed)
    turn = 3 * np.pi * np.arange(count) / count
    outwards = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    true = rigid.make(rigid.so3_exp(turn[:, None] * [0, 0, 1.0]), 3 * outwards)
    again = 2 * count // 3
    a = np.concatenate([np.arange(count - 1), np.arange(count - again)])
    b = np.concatenate([np.arange(1, count), np.arange(again, count)])
    loop = b - a > 1
    sigmas = np.where(loop[:, None], sigma / 3, sigma)
    measured = rigid.inverse(true[a]) @ true[b] @ rigid.exp(sigmas * rng.normal(size=(len(a), 6)))
    information = (1 / sigmas**2)[:, :, None] * np.eye(6)
    start = [true[0]]
    for motion in measured[: count - 1]:
        start.append(start[-1] @ motion)
    return true, np.stack(start), Edges(a, b, measured, information, loop)


SIGMA = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])


def test_it_finds_what_least_squares_finds():
    _, start, edges = circle(12, SIGMA, seed=0)
    certain = edges._replace(doubtful=np.zeros(len(edges.a), bool))

    def poses(x):
        return np.concatenate([start[:1], start[1:] @ rigid.exp(x.reshape(-1, 6))])

    def whitened(x):
        T = poses(x)
        off = rigid.inverse(edges.T_a_b) @ rigid.inverse(T[edges.a]) @ T[edges.b]
        return (np.sqrt(np.diagonal(edges.information, axis1=1, axis2=2)) * rigid.log(off)).ravel()

    best = least_squares(whitened, np.zeros(6 * 11), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = optimise_pose_graph(start, certain)
    assert 0.5 * found.chi2.sum() == pytest.approx(best.cost, rel=1e-9)
    np.testing.assert_allclose(found.T, poses(best.x), atol=1e-6)
    assert squared_distances(start, edges).sum() > 3 * found.chi2.sum()


@pytest.mark.parametrize("seed", range(3))
def test_loops_take_the_drift_away(seed):
    true, start, edges = circle(45, SIGMA, seed)
    found = optimise_pose_graph(start, edges)
    off = lambda T: np.linalg.norm(T[:, :3, 3] - true[:, :3, 3], axis=1)
    assert off(found.T).max() < off(start).max() / 2 and off(start).max() > 0.3
    assert (found.weight > 0.5).all()


@pytest.mark.parametrize("seed", range(3))
def test_wrong_loops_are_not_believed(seed):
    """One loop in five leads to another place, a metre and a radian away, and agrees with no other."""
    _, start, edges = circle(45, SIGMA, seed)
    rng = np.random.default_rng(seed)
    wrong = np.flatnonzero(edges.doubtful)[::5]
    T_a_b = edges.T_a_b.copy()
    T_a_b[wrong] = T_a_b[wrong] @ rigid.exp(rng.normal(size=(len(wrong), 6)))
    found, right = optimise_pose_graph(start, edges._replace(T_a_b=T_a_b)), np.ones(len(edges.a), bool)
    right[wrong] = False
    assert (found.weight[wrong] < 0.1).all() and (found.weight[right] > 0.5).all()
    without = Edges(*(x[right] for x in edges))
    apart = rigid.inverse(optimise_pose_graph(start, without).T) @ found.T
    assert np.abs(rigid.log(apart)).max() < 0.01  # as if they had not been there
    assert (found.chi2[wrong] > CHI2_999).all()
