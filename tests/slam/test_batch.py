"""How sure a tracked trajectory is: own errors and a map's that walks, against simulations of them."""

import numpy as np
import pytest
from helpers import hand_held

from jaxpose.geometry import rigid
from jaxpose.slam.batch import inflation, own_covariances, tracked_covariances
from jaxpose.slam.types import TrackingStatus, no_frames

OWN = np.repeat([0.004, 0.003], 3)


def square(error, P):
    return np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., None])[..., 0])


def test_covariances_are_those_of_simulated_errors():
    t = np.arange(0.0, 6.0, 0.2)
    truth = hand_held.body(t)[0]
    rng, poses, moves = np.random.default_rng(0), [], []
    known = tracked_covariances(t, truth, np.tile(np.diag(OWN**2), (len(t), 1, 1)))
    at = np.searchsorted(known.t, t - 1e-6)
    np.testing.assert_allclose(known.t[at], t, atol=1e-9)
    first = at[: len(t) - 5]
    for _ in range(200):
        shared, T = np.eye(4), truth.copy()
        for i, (step, own) in enumerate(rng.normal(size=(len(t), 2, 6)) * OWN):
            if i:
                shared = shared @ truth[i] @ rigid.exp(step) @ rigid.inverse(truth[i])
            T[i] = shared @ truth[i] @ rigid.exp(own)
        poses.append(square(rigid.log(rigid.inverse(T) @ truth), known.pose[at]))
        moved, truly = (rigid.inverse(x[:-5]) @ x[5:] for x in (T, truth))
        moves.append(square(rigid.log(rigid.inverse(moved) @ truly), known.second[first]))
    for squares in (poses, moves):
        assert np.mean(squares) == pytest.approx(6, abs=0.3)
        assert np.mean(squares, axis=0) == pytest.approx(6, abs=1.5)  # at every time


def test_between_frames_a_restless_motion_is_less_sure():
    """Acceleration is white noise: paths drawn so, with a spline through every fourth of their poses."""
    from scipy.interpolate import CubicSpline

    rng, dt, between = np.random.default_rng(0), 0.05, 4
    density, t = 0.3, dt * np.arange(401)
    errors, stated = [], []
    for _ in range(40):
        velocity = np.cumsum(rng.normal(size=(401, 3)) * np.sqrt(density * dt), axis=0)
        x = np.cumsum(velocity, axis=0) * dt
        kept = slice(0, None, between)
        T = np.tile(np.eye(4), (101, 1, 1))
        T[:, :3, 3] = x[kept]
        known = tracked_covariances(t[kept], T, np.tile(1e-14 * np.eye(6), (101, 1, 1)))
        middle = slice(22, 380, between)
        errors.append(CubicSpline(t[kept], x[kept])(t[middle]) - x[middle])
        stated.append(np.diagonal(known.pose[middle], axis1=1, axis2=2)[:, :3])
    assert np.sqrt(np.mean(np.square(errors)) / np.mean(stated)) == pytest.approx(1, abs=0.15)


def test_frames_in_doubt_have_no_covariance_of_their_own():
    frames = no_frames(np.arange(20.0))
    measured = np.random.default_rng(0).uniform(1, 2, (19, 1, 1)) * np.eye(6)
    frames = frames.put(np.arange(1, 20), covariance=measured)
    frames = frames.put(7, status=TrackingStatus.LOST)
    own = own_covariances(frames)
    assert np.isnan(own[7]).all()
    np.testing.assert_allclose(own[6], measured[[1, 2, 3, 4, 5, 7, 8, 9, 10]].mean(0), atol=1e-9)
    np.testing.assert_allclose(own[0], own[1])
    flat = frames.put(np.arange(1, 20), covariance=np.diag([1.0, 1, 1, 1, 1, -1e-14]))  # as float32 rounds
    assert np.linalg.eigvalsh(own_covariances(flat)[3])[0] > 1e-11
    ended = own_covariances(frames.put(19, status=TrackingStatus.LOST))
    np.testing.assert_allclose(ended[19], np.eye(6))  # not known, but there
    assert np.isnan(own_covariances(no_frames(np.arange(3.0)))).all()


@pytest.mark.parametrize("larger", [0.5, 1.0, 3.0])
def test_covariances_are_to_explain_what_other_poses_of_keyframes_differ_by(larger):
    """Errors of the same law as is stated, and of half and three times its size; one keyframe is far off."""
    t = np.arange(0.0, 120.0, 0.25)
    truth, rng = hand_held.body(t)[0], np.random.default_rng(1)
    frames = no_frames(t)
    frames = frames.put(np.arange(len(t)), covariance=np.diag(OWN**2), status=TrackingStatus.TRACKED)
    frames = frames.put(33, status=TrackingStatus.LOST)  # says nothing of itself
    shared, T = np.eye(4), truth.copy()
    for i, (step, own) in enumerate(larger * rng.normal(size=(len(t), 2, 6)) * OWN):
        if i and i != 33:
            shared = shared @ truth[i] @ rigid.exp(step) @ rigid.inverse(truth[i])
        T[i] = shared @ truth[i] @ rigid.exp(own)
    keyframes = np.sort(rng.permutation(len(t))[:300])
    other = truth[keyframes]
    other[100, 0, 3] += 5.0
    found = inflation(frames, T, keyframes, other)
    assert found == pytest.approx(max(larger**2, 1.0), rel=0.15)
    short = inflation(frames.put(np.arange(len(t)), t=t / 1000), T, keyframes, other)  # 0.1 s in all
    assert np.isfinite(short) and short >= 1
    assert inflation(no_frames(t), T, keyframes, other) == 1, "nothing is stated that could be too little"
