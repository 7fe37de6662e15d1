"""What events tell of their sensor, beside the settings that a simulator was given."""

import numpy as np
import pytest

from jaxpose.events import Events, dead_time_s, hot_pixels, simulate, threshold_spread

SIZE = 24


def waves(t: np.ndarray, periods: int = 1):
    """Stripes that pass a sensor, so many of them a second."""
    x = np.arange(SIZE)[None] + np.zeros((SIZE, 1))
    for moment in t:
        yield moment, 2.0 * np.sin(2 * np.pi * (periods * moment - x / 9))


@pytest.fixture(scope="module")
def events() -> Events:
    return simulate(waves(np.linspace(0, 4, 401)), 0.25, threshold_sigma=0.02, noise_hz=0.5)


def test_a_pixel_that_never_rests_is_found_and_no_other(events):
    assert not hot_pixels(events, SIZE, SIZE).any()
    generator = np.random.default_rng(0)
    places = {(3, 0), (12, 12), (12, 13), (SIZE - 1, SIZE - 1)}
    rows = [events]
    for row, column in places:
        t = generator.uniform(0, 4, 1500)
        one = np.ones(1500)
        rows.append(
            Events(t, (column * one).astype(np.uint16), (row * one).astype(np.uint16), one.astype(np.int8))
        )
    both = [np.concatenate(columns) for columns in zip(*rows, strict=True)]
    order = np.argsort(both[0], kind="stable")
    found = hot_pixels(Events(*(column[order] for column in both)), SIZE, SIZE)
    assert set(zip(*(index.tolist() for index in np.nonzero(found)), strict=True)) == places


def test_the_time_that_pixels_are_blind(events):
    # Up to 63 units of log intensity a second: a threshold takes a millisecond at least.
    fast = waves(np.linspace(0, 2, 401), periods=5)
    blind = simulate(fast, 0.05, threshold_sigma=0.005, refractory_s=20e-3, noise_hz=0.5)
    found = dead_time_s(blind)
    assert found is not None and 20e-3 < found < 22e-3
    never = Events(np.sort(np.random.default_rng(0).uniform(0, 1, 20_000)), *(column[:20_000] for column in (
        np.zeros(20_000, np.uint16), np.zeros(20_000, np.uint16), np.ones(20_000, np.int8)
    )))  # fmt: skip
    assert dead_time_s(never) is None  # intervals of chance have no edge
    assert dead_time_s(Events(*(column[:50] for column in events))) is None


@pytest.mark.parametrize("relative", [0.05, 0.15])
def test_how_unequal_thresholds_are(relative):
    seen = simulate(waves(np.linspace(0, 4, 401)), 0.1, threshold_sigma=0.1 * relative, seed=3)
    assert threshold_spread(seen, SIZE, SIZE) == pytest.approx(relative, rel=0.15)
    assert threshold_spread(Events(*(column[:50] for column in seen)), SIZE, SIZE) is None


def test_events_beyond_the_sensor_are_refused(events):
    with pytest.raises(ValueError, match="expected pixels of 20x20"):
        hot_pixels(events, 20, 20)
