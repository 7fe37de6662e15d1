"""The event camera: what simulated events add up to, when they happen, what pixels have seen at any time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.errors import DataError
from jaxpose.events import (
    Events,
    PixelIndex,
    change_residual,
    cumulative_polarity,
    index_by_pixel,
    log_intensity,
    mosaic_mask,
    simulate,
)

HEIGHT, WIDTH = 6, 8


def walk(seed=0, images=30, step=0.3):
    """Log intensities that go up and down at random, and their timestamps."""
    generator = np.random.default_rng(seed)
    values = np.cumsum(generator.normal(0, step, (images, HEIGHT, WIDTH)), axis=0)
    return list(zip(0.1 * np.arange(images), values, strict=True))


def total(events: Events, until=np.inf):
    """Sum of polarities of every pixel."""
    seen = events.t <= until
    result = np.zeros((HEIGHT, WIDTH))
    np.add.at(result, (events.y[seen], events.x[seen]), events.polarity[seen])
    return result


def test_events_add_up_to_the_change_of_log_intensity_at_every_image():
    images = walk()
    events = simulate(images, 0.17)
    assert (np.diff(events.t) >= 0).all()
    for t, image in images:
        missing = image - images[0][1] - 0.17 * total(events, t)
        assert np.abs(missing).max() < 0.17 + 1e-9
    assert len(events.t) > 1000  # or there would be nothing to add up


def test_a_ramp_fires_when_it_crosses_each_threshold():
    up, down = np.zeros((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH))
    up[2, 5], down[2, 5], up[1, 1], down[1, 1] = 1.0, 0.4, -0.5, -0.5
    events = simulate([(1.0, np.zeros((HEIGHT, WIDTH))), (3.0, up), (3.5, down)], 0.3)
    first = (events.y == 2) & (events.x == 5)
    # Up at 0.5 a second: 0.3, 0.6, 0.9. Down at 1.2 a second from 1.0: 0.6 again.
    assert_allclose(events.t[first], [1.6, 2.2, 2.8, 3 + 0.4 / 1.2], rtol=1e-12)
    assert_array_equal(events.polarity[first], [1, 1, 1, -1])
    assert_allclose(events.t[~first], [2.2], rtol=1e-12)  # down at 0.25 a second
    assert_array_equal(events.polarity[~first], [-1])


def test_a_moving_edge_leaves_contrast_over_threshold_events_in_each_pixel():
    contrast, threshold = 1.3, 0.25
    column = np.arange(WIDTH)
    images = [
        (t, np.broadcast_to(contrast * np.clip(10 * t - column, 0, 1), (HEIGHT, WIDTH)))
        for t in np.linspace(0, 1, 201)
    ]
    events = simulate(images, threshold)
    assert_array_equal(total(events), np.full((HEIGHT, WIDTH), int(contrast / threshold)))
    assert len(events.t) == HEIGHT * WIDTH * int(contrast / threshold)
    # The k-th comes when the edge, at 10 pixels a second, has covered k thresholds' worth of the pixel.
    fourth_column = events.t[(events.x == 4) & (events.y == 0)]
    assert_allclose(fourth_column, 0.4 + 0.1 * threshold / contrast * np.arange(1, 6), atol=1e-9)


def test_a_blind_pixel_counts_from_the_level_that_it_finds():
    ramp = np.full((HEIGHT, WIDTH), 2.0)
    images = [(0.0, np.zeros((HEIGHT, WIDTH))), (0.5, ramp / 2), (1.0, ramp)]
    events = simulate(images, 0.3, refractory_s=0.1)
    # 0.15 s to each threshold at 2 a second, then 0.1 s blind.
    one = events.t[(events.x == 0) & (events.y == 0)]
    assert_allclose(one, [0.15, 0.4, 0.65, 0.9], rtol=1e-12)
    resting = [*images[:1], (0.2, ramp / 5), (0.4, ramp / 5), (0.6, ramp)]
    one = simulate(resting, 0.3, refractory_s=0.1)
    one = one.t[(one.x == 0) & (one.y == 0)]
    # At 0.15 s; wakes at 0.25 s at level 0.4; from 0.4 s on at 8 a second to 0.7, blind until 0.5375 s.
    assert_allclose(one[:3], [0.15, 0.4375, 0.4375 + 0.1 + 0.3 / 8], rtol=1e-12)


def test_thresholds_spread_and_false_events_are_as_many_as_asked():
    ramp = [(0.0, np.zeros((100, 100))), (1.0, np.full((100, 100), 50.0))]
    events = simulate(ramp, 0.25, threshold_sigma=0.03, seed=3)
    fired = np.bincount(events.y.astype(int) * 100 + events.x, minlength=10_000)
    thresholds = 50 / (fired + 0.5)
    assert_allclose(thresholds.mean(), 0.25, atol=3 * 0.03 / 100)
    assert_allclose(thresholds.std(), 0.03, rtol=0.03)
    quiet = [(0.0, np.zeros((100, 100))), (2.0, np.zeros((100, 100)))]
    false = simulate(quiet, 0.25, noise_hz=3.0, seed=1)
    assert abs(len(false.t) - 60_000) < 5 * np.sqrt(60_000)
    assert abs(int(false.polarity.sum())) < 5 * np.sqrt(60_000)
    assert 0 <= false.t[0] and false.t[-1] <= 2 and (np.diff(false.t) >= 0).all()
    assert_array_equal(simulate(quiet, 0.25, noise_hz=3.0, seed=1).t, false.t)
    assert len(simulate(quiet, 0.25).t) == 0


def test_bad_settings_and_stamps_are_refused():
    images = walk(images=3)
    for settings in ({"threshold": 0.0}, {"threshold": 0.1, "threshold_sigma": -1.0}):
        with pytest.raises(ValueError, match="expected threshold > 0"):
            simulate(images, **settings)
    with pytest.raises(DataError, match="timestamps that increase, got 0.1 s after 0.2 s"):
        simulate([images[0], images[2], images[1]], 0.1)


def test_the_mosaic_is_red_green_green_blue():
    mask = mosaic_mask("rggb", 4, 4)
    assert_array_equal(mask[0, 0], [1, 0, 0])
    assert_array_equal(mask[0, 1], [0, 1, 0])
    assert_array_equal(mask[1, 0], [0, 1, 0])
    assert_array_equal(mask[3, 1], [0, 0, 1])
    assert_array_equal(mask.sum((0, 1)), [4, 8, 4])
    assert_array_equal(mosaic_mask("mono", 2, 3), np.ones((2, 3, 3)))


def test_levels_at_any_time_are_those_of_a_plain_count():
    events = simulate(walk(1), 0.2)
    streams = index_by_pixel(events, HEIGHT, WIDTH)
    assert streams.count.sum() == len(events.t)
    same = np.diff(streams.pixel) == 0
    assert (np.diff(streams.t)[same] >= 0).all() and (np.diff(streams.pixel) >= 0).all()
    device = PixelIndex(*(jnp.asarray(x, jnp.float32 if x.dtype == float else jnp.int32) for x in streams))
    read = jax.jit(jax.vmap(cumulative_polarity, (None, 0, None)))
    timestamps = np.float32([-1.0, 0.0, 0.731, 1.5, 2.9, 10.0])
    # Beside them the timestamp of an event itself, which counts.
    for t in [*timestamps, np.float32(events.t[100])]:
        as_stored = events._replace(t=np.asarray(events.t, np.float32).astype(np.float64))
        assert_array_equal(read(device, jnp.arange(HEIGHT * WIDTH), t), total(as_stored, float(t)).ravel())


def test_pixels_without_events_have_no_level():
    quiet = index_by_pixel(simulate([(0.0, np.zeros((2, 2))), (1.0, np.zeros((2, 2)))], 0.2), 2, 2)
    device = PixelIndex(*(jnp.asarray(x) for x in jax.tree.map(lambda x: x.astype(np.float32), quiet)))
    assert cumulative_polarity(device._replace(pixel=quiet.pixel), jnp.int32(3), jnp.float32(0.5)) == 0
    one = Events(np.array([0.5]), np.uint16([1]), np.uint16([0]), np.int8([-1]))
    streams = index_by_pixel(one, 2, 2)
    assert_array_equal(streams.count, [0, 1, 0, 0])
    device = PixelIndex(*(jnp.asarray(x, jnp.float32 if x.dtype == float else jnp.int32) for x in streams))
    levels = [
        [int(cumulative_polarity(device, jnp.int32(p), jnp.float32(t))) for p in range(4)]
        for t in (0.4, 0.5, 9)
    ]
    assert levels == [[0, 0, 0, 0], [0, -1, 0, 0], [0, -1, 0, 0]]


def test_the_residual_is_of_log_intensity_and_of_the_colours_seen():
    now, before = np.float32([0.2, 0.5, 0.9]), np.float32([0.3, 0.5, 0.1])
    change = np.float32(0.4)
    expected = np.log((now**2.2 + 0.1) / (before**2.2 + 0.1)) - 0.4
    found = change_residual(jnp.asarray(now), jnp.asarray(before), jnp.asarray(change), jnp.ones(3))
    assert_allclose(found, expected, rtol=2e-5)
    masked = change_residual(
        jnp.asarray(now), jnp.asarray(before), jnp.asarray(change), jnp.asarray([0.0, 1.0, 0.0])
    )
    assert_allclose(masked, expected * [0, 1, 0], rtol=2e-5)
    assert_allclose(log_intensity(np.array([0.0, 1.0]), 1e-5), np.log([1e-5, 1 + 1e-5]), rtol=1e-12)
    # Black has a slope, not a NaN.
    assert_allclose(jax.grad(lambda x: log_intensity(x, 0.1))(jnp.float32(0.0)), 0.0, atol=1e-12)
