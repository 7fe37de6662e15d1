"""Readings reduced to a few numbers an interval: the same sum of squares, and the sensor's noise."""

import numpy as np
import pytest
from helpers import hand_held

from jaxpose.estimate import inertial


@pytest.mark.parametrize("knots_hz", (10.0, 20.0))
def test_the_sum_of_squares_is_that_over_all_readings(knots_hz):
    """Of what the body does, at the nodes, against what was read, at the readings' own times."""
    rng = np.random.default_rng(0)
    imu = hand_held.readings(3.0, 200.0, rng)
    intervals = round(3 * knots_hz)
    reduced = inertial.node_readings(imu, (0.0, 3.0), intervals)
    places = ((np.arange(intervals)[:, None] + inertial.PLACES) * (3.0 / intervals)).ravel()
    predicted = np.concatenate(hand_held.body(places)[1:], axis=1).reshape(-1, inertial.BANDS, 6)
    inside = (imu.t >= 0) & (imu.t <= 3)
    exact = np.concatenate(hand_held.body(imu.t[inside])[1:], axis=1)
    read = np.concatenate([imu.omega_body, imu.acceleration_body], axis=1)[inside]
    whole = ((exact - read) ** 2).sum(0)
    kept = ((reduced.root @ predicted - reduced.value) ** 2).sum((0, 1))
    np.testing.assert_allclose(kept + reduced.unexplained.sum(0), whole, rtol=2e-3)
    assert reduced.count.sum() == inside.sum()


def test_noise_is_known_without_a_trajectory():
    imu = hand_held.readings(20.0, 200.0, np.random.default_rng(1))
    found = inertial.white_noise(inertial.node_readings(imu, (0.0, 20.0), 300))
    sheet = np.sqrt(200.0) * np.array(hand_held.SHEET[:2])
    np.testing.assert_allclose(found, sheet, rtol=0.03)


def test_bands_go_from_slow_to_fast():
    """A slow wave is seen in the first bands, a fast one in the last."""
    t = np.arange(0.0, 3.0, 0.005)
    for hz, bands in ((0.8, slice(0, 3)), (17.0, slice(6, 12))):
        wave = np.tile(np.sin(2 * np.pi * hz * t)[:, None], (1, 3))
        reduced = inertial.node_readings(inertial.Imu(t, wave, 0 * wave), (0.0, 3.0), 30)
        power = (reduced.value[..., :3] ** 2).sum((0, 2))
        assert power[bands].sum() > 0.9 * power.sum()
