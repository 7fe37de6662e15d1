"""Residuals of users beside poses: against poses that say the same, against simulations, and wrong ones."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import hand_held

from jaxpose.estimate import Factor, position_factor, smooth
from jaxpose.geometry import rigid

T_S = np.arange(0.0, 4.0, 0.25)
SIGMAS = np.array([0.02] * 3 + [0.005] * 3)


def trial(seed):
    rng = np.random.default_rng(seed)
    true, noisy = hand_held.cameras(T_S, rng, np.eye(4), SIGMAS[:3], SIGMAS[3:])
    return rng, true, noisy


def test_positions_beside_poses_are_poses_that_know_more():
    """What poses say of positions, said by a factor: the same means and covariances."""
    _, _, noisy = trial(0)
    together = smooth(T_S, noisy, SIGMAS / np.sqrt(2))
    turns = np.concatenate([SIGMAS[:3], SIGMAS[3:] / np.sqrt(2)])
    apart = smooth(T_S, noisy, turns, factors=[position_factor(T_S, noisy[:, :3, 3], SIGMAS[:3])])
    between = np.linspace(0.0, 3.7, 40)
    np.testing.assert_allclose(apart.pose(between), together.pose(between), atol=1e-6)
    np.testing.assert_allclose(apart.covariance(between), together.covariance(between), rtol=2e-3, atol=1e-9)


def test_an_antenna_beside_the_camera_takes_a_shared_error_off():
    """An odometry's error walks; positions of a point 0.3 m beside hold it, and the covariance says so."""
    rng, true, _ = trial(1)
    step = np.array([0.01] * 3 + [0.002] * 3)
    moves = rigid.inverse(true[:-1]) @ true[1:] @ rigid.exp(step * rng.normal(size=(len(T_S) - 1, 6)))
    walked = [true[0]]
    for move in moves:
        walked.append(walked[-1] @ move)
    t = np.arange(0.0, 3.75, 0.1)
    antenna = np.array([0.3, -0.1, 0.05])
    there = rigid.apply(hand_held.body(t)[0], antenna) + 0.01 * rng.normal(size=(len(t), 3))
    there[7] += 5.0  # which is wrong, and counts as one that is somewhat wrong
    added = np.tile(np.diag(step**2), (len(T_S), 1, 1))
    by = lambda factors: smooth(T_S, np.array(walked), [1e-3] * 6, drift=added, knots_hz=4.0, factors=factors)
    held, alone = by([position_factor(t, there, 0.01, antenna)]), by([])
    error = lambda found: rigid.log(rigid.inverse(found.pose(T_S[-1])) @ true[-1:])[0]
    sigma = lambda found: np.sqrt(np.trace(found.covariance(T_S[-1])[0][:3, :3]))
    assert sigma(held) < 0.5 * sigma(alone)
    assert np.linalg.norm(error(held)[:3]) < min(3 * sigma(held), np.linalg.norm(error(alone)[:3]))
    assert np.abs(rigid.apply(held.pose(t), antenna) - there)[7].max() > 4.8


def test_velocities_in_the_cameras_axes_are_those_of_the_motion():
    """A wheel's speed, on a clock that is found with it: the factor's times are the poses'."""
    rng, true, noisy = trial(2)
    imu = hand_held.readings(4.0, 100.0, rng)
    t = np.arange(0.05, 3.7, 0.05)
    step = 1e-4
    early, late = (hand_held.body(t + s)[0] for s in (-step, step))
    velocity = np.einsum("nji,nj->ni", hand_held.body(t)[0][:, :3, :3], (late - early)[:, :3, 3] / (2 * step))
    wheel = Factor(t - 0.02, lambda _, twist, measured: (twist[:3] - measured) / 0.02, velocity)
    options = dict(estimate=("biases", "gravity", "offset"), noise=hand_held.SHEET)
    found = smooth(T_S - 0.02, noisy, SIGMAS, imu, factors=[wheel], **options)
    assert abs(found.sensors.offset_s - 0.02) < 4 * found.sensors.offset_sigma_s
    T = found.pose(t - 0.02)
    speed = np.diff(T[:, :3, 3], axis=0) / np.diff(t)[:, None]
    middle = (hand_held.body(t[1:])[0] - hand_held.body(t[:-1])[0])[:, :3, 3] / np.diff(t)[:, None]
    without = smooth(T_S - 0.02, noisy, SIGMAS, imu, **options).pose(t - 0.02)
    off = lambda T: np.sqrt(
        np.mean(np.sum((np.diff(T[:, :3, 3], axis=0) / np.diff(t)[:, None] - middle) ** 2, 1))
    )
    assert np.abs(speed - middle).max() < 0.1
    assert off(T) < 0.7 * off(without)


TWICE, SAME = [1.0, 2.0], lambda T, twist, x: x


@pytest.mark.parametrize(
    ("factor", "complaint"),
    [
        (Factor([1.0, 9.0], SAME, np.zeros((2, 1))), "t: expected times between 0 and 3.75 s"),
        (Factor([1.0, np.nan], SAME, np.zeros((2, 1))), "t: expected finite"),
        (Factor(TWICE, SAME, np.zeros((3, 1))), "data: expected shape (2, 1), got (3, 1)"),
        (Factor(TWICE, SAME, np.full((2, 1), np.inf)), "data: expected finite"),
        (Factor(TWICE, SAME, np.zeros(2)), "residual: expected an array (m,)"),
        (Factor(TWICE, lambda T, twist, x: (x, x), np.zeros((2, 1))), "residual: expected an array (m,)"),
        (
            Factor(TWICE, lambda T, twist, x: jnp.int32(x), np.zeros((2, 1))),
            "residual: expected an array (m,)",
        ),
    ],
)
def test_factors_that_cannot_be_used_are_named(factor, complaint):
    _, _, noisy = trial(0)
    with pytest.raises(ValueError, match=re.escape(f"factors[0].{complaint}")):
        smooth(T_S, noisy, SIGMAS, factors=[factor])


def test_positions_that_cannot_be_are_named():
    with pytest.raises(ValueError, match="sigma_m: expected numbers above 0"):
        position_factor([0.0], np.zeros((1, 3)), 0.0)
    with pytest.raises(ValueError, match="position_world: expected shape"):
        position_factor([0.0], np.zeros((2, 3)), 0.1)
