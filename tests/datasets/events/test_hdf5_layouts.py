"""The layouts of events in HDF5 that others write, each written here by h5py."""

import h5py
import numpy as np
import pytest

from jaxpose.datasets.events import hdf5
from jaxpose.errors import DataError

COUNT = 500
RNG = np.random.default_rng(0)
T = 1_000_000 + np.cumsum(RNG.integers(1, 40, COUNT))  # [us]
X, Y, P = RNG.integers(0, 346, COUNT), RNG.integers(0, 260, COUNT), RNG.integers(0, 2, COUNT)


def columns(place, names, *, scale=1, polarity=P):
    def write(out):
        values = (T * scale if scale != 1 else T, X, Y, polarity)
        for name, column in zip(names, values, strict=True):
            out[f"{place}{name}"] = column

    return write


def table(place, names=None, order=(0, 1, 2, 3)):
    def write(out):
        values = [(T, X, Y, P)[k] for k in order]
        if names is None:
            out.create_dataset(place, data=np.stack(values, 1), compression="gzip")
            return
        rows = np.zeros(COUNT, [(name, "<i8") for name in names])
        for name, column in zip(names, values, strict=True):
            rows[name] = column
        out[place] = rows

    return write


@pytest.mark.parametrize(
    "write",
    [
        columns("events/", ("ts", "xs", "ys", "ps")),
        columns("events/", ("ts", "xs", "ys", "ps"), scale=1e-6, polarity=P == 1),  # seconds and booleans
        columns("", ("t", "x", "y", "p")),
        columns("", ("timestamps", "x", "y", "polarities"), polarity=2 * P - 1),
        columns("prophesee/left/", ("t", "x", "y", "p")),
        table("CD/events", ("x", "y", "p", "t"), (1, 2, 3, 0)),
        table("events", ("timestamp", "x", "y", "polarity")),
        table("events", None, (0, 1, 2, 3)),
        table("davis/left/events", None, (1, 2, 0, 3)),
        table("data", None, (1, 2, 3, 0)),
    ],
)
def test_every_layout_gives_the_same_events(tmp_path, write):
    with h5py.File(tmp_path / "e.h5", "w") as out:
        write(out)
    events = hdf5.load(tmp_path, size=(346, 260)).events
    np.testing.assert_allclose(events.t, (T - T[0]) / 1e6, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(events.x, X)
    np.testing.assert_array_equal(events.y, Y)
    np.testing.assert_array_equal(events.polarity, 2 * P - 1)


def test_a_table_that_could_be_read_two_ways_is_refused(tmp_path):
    with h5py.File(tmp_path / "e.h5", "w") as out:
        rows = np.arange(COUNT)
        out["events"] = np.stack([rows, rows // 300, rows // 260, rows // 260], 1)
    with pytest.raises(DataError, match="e.h5: .*got a table events whose columns are .*several"):
        hdf5.load(tmp_path, size=(346, 260))


def test_a_filter_that_is_not_installed_is_named(tmp_path):
    with h5py.File(tmp_path / "e.h5", "w") as out:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((COUNT,))
        plan.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL, ())
        kind = h5py.h5t.py_create(np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")]))
        out.create_group("CD")
        space = h5py.h5s.create_simple((COUNT,))
        rows = h5py.h5d.create(out.id, b"CD/events", kind, space, plan)
        rows.write_direct_chunk((0,), b"\0" * 7000)
    with pytest.raises(DataError, match="compressed by filter 36559, not installed: Prophesee's ECF"):
        hdf5.load(tmp_path, size=(346, 260))
