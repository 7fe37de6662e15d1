"""Streams of events made of arrays: units, order, pixels, polarities, and every refusal in one line."""

from pathlib import Path

import numpy as np
import pytest

from jaxpose.datasets.events.stream import Block, Stream, count, find_unit, seconds
from jaxpose.datasets.events.validate import clean
from jaxpose.errors import DataError

SIZE = (64, 48)
N = 5000


def stream_of(*columns, step=1000, unit=None):
    """A stream of blocks of `step` events."""
    blocks = [Block(*(c[i : i + step] for c in columns)) for i in range(0, len(columns[0]), step)]
    return Stream(Path("made.npz"), lambda: iter(blocks), lambda row: f"made.npz: event {row}", unit)


@pytest.fixture
def made():
    """Timestamps in whole microseconds (5 MHz), pixels, and polarities 0 and 1.

    As arrays that can be changed.
    """
    g = np.random.default_rng(3)
    t = np.cumsum(g.integers(0, 2, N)) * 2 + 7_000_000
    return [t, g.integers(0, 64, N), g.integers(0, 48, N), g.integers(0, 2, N)]


def test_events_come_back_in_few_bytes(made):
    events, tally, notes = clean(stream_of(*made, unit="us"), SIZE)
    t, x, y, p = made
    np.testing.assert_allclose(events.t, (t - t[0]) / 1e6, rtol=1e-12, atol=0)
    np.testing.assert_array_equal(events.x, x)
    np.testing.assert_array_equal(events.y, y)
    np.testing.assert_array_equal(events.polarity, 2 * p - 1)
    assert sum(column.itemsize for column in events) == 13
    assert (tally.count, tally.outside, tally.back, notes) == (N, 0, 0, ())
    assert seconds(tally) == pytest.approx(t[0] / 1e6)


@pytest.mark.parametrize("kinds", [(np.uint32, np.int16, np.uint8, bool), (np.float64,) * 4, (np.int64,) * 4])
@pytest.mark.parametrize("step", [1, N])
def test_kinds_of_numbers_and_blocks_change_nothing(made, kinds, step):
    few = [column[:300] for column in made]
    expected = clean(stream_of(*few), SIZE, unit="us").events
    others = [column.astype(kind) for column, kind in zip(few, kinds, strict=True)]
    found = clean(stream_of(*others, step=step), SIZE, unit="us").events
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_polarities_of_minus_one_are_the_same_as_of_zero(made):
    t, x, y, p = made
    minus = clean(stream_of(t, x, y, 2 * p - 1), SIZE)
    np.testing.assert_array_equal(minus.events.polarity, clean(stream_of(*made), SIZE).events.polarity)
    assert set(minus.events.polarity) == {-1, 1}
    alone = clean(stream_of(t, x, y, np.zeros(N, int)), SIZE)
    assert set(alone.events.polarity) == {-1}


# --- units --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "word", "per_second", "since"),
    [
        ("s", "seconds", 1.0, 0.0),
        ("s", "seconds", 1.0, 1.4e9),
        ("us", "microseconds", 1e6, 0.0),
        ("us", "microseconds", 1e6, 1.4e9),
        ("ns", "nanoseconds", 1e9, 0.0),
        ("ns", "nanoseconds", 1e9, 1.4e9),
    ],
)
@pytest.mark.parametrize("rate_hz", [2e4, 3e5, 1e7])
def test_units_are_found_and_told(made, unit, word, per_second, since, rate_hz):
    # Sensors count whole microseconds.
    ticks = np.cumsum(np.random.default_rng(0).exponential(1e6 / rate_hz, N)).astype(np.int64)
    if unit == "s":
        raw = since + ticks / 1e6
    else:
        raw = round(since * per_second) + ticks * round(per_second / 1e6)
    events, tally, notes = clean(stream_of(raw, *made[1:]), SIZE)
    assert tally.unit == unit
    assert len(notes) == 1 and notes[0].startswith(f"timestamps read as {word}: {N} events in ")
    # Seconds since 1970 have no more digits in float64.
    np.testing.assert_allclose(
        events.t, (ticks - ticks[0]) / 1e6, atol=3e-7 if since and unit == "s" else 1e-12
    )


def test_indices_of_frames_are_found_and_told(made):
    frames = np.sort(np.random.default_rng(0).integers(0, 50, N))
    events, _, notes = clean(stream_of(frames, *made[1:]), SIZE, zero=0)
    np.testing.assert_array_equal(events.t, frames)
    assert notes == (f"timestamps read as frame indices, 1 s each: {N} events in 49 frames",)


def test_a_unit_that_is_given_is_taken(made):
    frames = np.sort(np.random.default_rng(0).integers(0, 50, N))
    events, _, notes = clean(stream_of(frames, *made[1:]), SIZE, unit="us", zero=0)
    np.testing.assert_allclose(events.t, frames / 1e6)
    assert notes == ()


def test_a_stated_unit_holds_unless_its_rate_is_impossible(made):
    t = np.arange(N) * 3
    assert clean(stream_of(t, *made[1:], unit="s"), SIZE).stats.unit == "us"
    (note,) = clean(stream_of(t, *made[1:], unit="s"), SIZE).notes
    assert "microseconds, as in the format's seconds their rate would be impossible" in note
    slow = clean(stream_of(np.arange(N) / 200, *made[1:], unit="s"), SIZE)
    assert slow.stats.unit == "s" and slow.notes == ()
    few = clean(stream_of(*(c[:5] for c in (t, *made[1:])), unit="s"), SIZE)
    assert few.stats.unit == "s" and few.events.t[-1] == 12


def test_one_stamp_for_all_has_a_unit():
    assert find_unit(np.zeros(10)) == "frames"
    assert find_unit(np.array([0.25])) == "s"


# --- what is mended, and told -------------------------------------------------------------------------------


def test_few_events_out_of_order_are_sorted_aloud(made):
    made[0][:] = np.arange(N) * 2
    made[0][[1000, 3500]] -= 100  # one of them the first of a block
    events, tally, notes = clean(stream_of(*made, unit="us"), SIZE)
    order = np.argsort(made[0], kind="stable")
    np.testing.assert_array_equal(events.t, np.sort(made[0]) / 1e6)
    np.testing.assert_array_equal(events.x, made[1][order])
    np.testing.assert_array_equal(events.polarity, 2 * made[3][order] - 1)
    assert tally.back == 2 and tally.first_back == 1000
    assert notes == (f"2 of {N} events were earlier than one before, by up to 9.8e-05 s: sorted",)


def test_equal_events_are_kept_in_their_order(made):
    t, x, y, p = (np.repeat(column, 3) for column in made)
    events, _, notes = clean(stream_of(t, x, y, p, unit="us"), SIZE)
    assert len(events.t) == 3 * N and notes == ()
    np.testing.assert_array_equal(events.x, x)


def test_events_outside_the_sensor_are_left_out_aloud(made):
    t, x, y, p = made
    x[[3, 40]], y[[50, 4999]] = [-1, 64], [48, 70]
    events, tally, notes = clean(stream_of(*made, unit="us"), SIZE)
    kept = np.setdiff1d(np.arange(N), [3, 40, 50, 4999])
    np.testing.assert_array_equal(events.x, x[kept])
    np.testing.assert_array_equal(events.t, (t[kept] - t[0]) / 1e6)
    assert tally.outside == 4
    assert notes == (f"4 of {N} events left out, outside the sensor of 64x48: from -1, 0 to 64, 70",)


def test_a_span_is_a_part(made):
    whole = clean(stream_of(*made, unit="us"), SIZE).events
    part, tally, _ = clean(stream_of(*made, step=100, unit="us"), SIZE, span=(0.001, 0.002))
    inside = (whole.t >= 0.001) & (whole.t < 0.002)
    assert 0 < inside.sum() < N
    for a, b in zip(part, whole, strict=True):
        np.testing.assert_array_equal(a, b[inside])
    assert tally.count == N  # it ends less than 10 ms later
    late = clean(stream_of(made[0] * 100, *made[1:], step=100, unit="us"), SIZE, span=(0.001, 0.002))
    assert late.stats.count < N / 10


# --- what is refused ----------------------------------------------------------------------------------------


def shuffle(t, x, y, p):
    np.random.default_rng(0).shuffle(t)


def put(column, row, value):
    def change(*columns):
        columns[column][row] = value

    return change


def jump(t, x, y, p):
    t[2500:] -= t[2500] - t[0]  # two recordings in a file
    t[2500:] -= 20_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            shuffle,
            r"made.npz: event \d+: expected events in the order of time, got \d+ of 5000 earlier than one ",
        ),
        (jump, "made.npz: event 2500: expected events in the order of time, got .* by up to 0.02"),
        (put(3, 1234, 2), "made.npz: event 1234: expected polarities 0 and 1, or -1 and 1, got 2"),
        (put(3, 1234, -1), "made.npz: expected polarities 0 and 1, or -1 and 1, got -1 and 0 and 1"),
        (
            put(1, slice(0, 600), 64),
            "made.npz: expected pixels of 64x48, got 600 of 5000 events outside, up to 64",
        ),
        (
            put(1, slice(None), -5),
            "expected pixels of 64x48, got 5000 of 5000 events outside, from -5, 0 to ",
        ),
    ],
)
def test_unusable_events_are_refused(made, change, message):
    change(*made)
    with pytest.raises(DataError, match=message) as error:
        clean(stream_of(*made), SIZE, unit="us")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (0, np.nan, "made.npz: event 1234: expected a finite timestamp, got nan"),
        (0, np.inf, "event 1234: expected a finite timestamp, got inf"),
        (1, np.nan, "event 1234: expected a whole number for x, got nan"),
        (1, np.inf, "event 1234: expected a whole number for x, got inf"),
        (2, 10.5, "event 1234: expected a whole number for y, got 10.5"),
        (3, 0.5, "event 1234: expected a whole number for polarity, got 0.5"),
    ],
)
def test_unusable_numbers_are_refused(made, column, value, message):
    made[column] = made[column].astype(float)
    made[column][1234] = value
    with pytest.raises(DataError, match=message):
        clean(stream_of(*made), SIZE)


def test_no_events_are_refused(made):
    none = [column[:0] for column in made]
    for stream in (stream_of(*none), Stream(Path("made.npz"), lambda: iter([Block(*none)]), str)):
        with pytest.raises(DataError, match="^made.npz: expected events, got none$"):
            clean(stream, SIZE)
        with pytest.raises(DataError, match="^made.npz: expected events, got none$"):
            count(stream, SIZE, most=10)
    with pytest.raises(DataError, match="expected events, got none from 90 to 91 s"):
        clean(stream_of(*made), SIZE, unit="us", span=(90.0, 91.0))
    with pytest.raises(ValueError, match="span: expected two rising times .*, got 2 and 1"):
        clean(stream_of(*made), SIZE, span=(2.0, 1.0))
    made[1] = np.array(["a"] * N)
    with pytest.raises(DataError, match="made.npz: expected numbers for x, got <U1"):
        clean(stream_of(*made), SIZE)


def test_a_count_refuses_nothing_and_stops(made):
    made[3][10] = 7
    made[1][20] = 99
    tally = count(stream_of(*made, unit="us"), SIZE, most=1500)
    assert (tally.count, tally.outside, tally.odd, tally.high[0]) == (2000, 1, 10, 99)
    assert tally.polarities == {0.0, 1.0, 7.0}
