"""Events under names and in orders that other programs use, written by numpy and h5py."""

import h5py
import numpy as np
import pytest

from jaxpose.datasets.events import registry
from jaxpose.errors import DataError

COUNT = 3000
rng = np.random.default_rng(3)
T = np.sort(rng.integers(0, 10**6, COUNT))
X, Y, P = rng.integers(0, 346, COUNT), rng.integers(0, 260, COUNT), rng.integers(0, 2, COUNT)
TABLE = np.stack([T, X, Y, P], axis=1)


def h5(names, place):
    def write(file):
        with h5py.File(file, "w") as content:
            for name, column in zip(names, (T, X, Y, P), strict=True):
                content[f"{place}{name}"] = column

    return write


def text(head, row):
    return lambda file: file.write_text(head + "".join(row(*event) + "\n" for event in TABLE.tolist()))


@pytest.mark.parametrize(
    "name, write",
    [
        ("a.npz", lambda file: np.savez(file, timestamps=T, xs=X, ys=Y, pols=P)),
        ("b.npz", lambda file: np.savez(file, events=TABLE.astype(np.float64))),
        ("c.npy", lambda file: np.save(file, TABLE)),
        ("d.npy", lambda file: np.save(file, TABLE[:, [1, 2, 3, 0]])),
        ("e.h5", h5(("t", "x", "y", "polarity"), "")),
        ("f.h5", h5(("timestamps", "x", "y", "polarities"), "events/")),
        ("g.csv", text("t,x,y,polarity\n", lambda t, x, y, p: f"{t},{x},{y},{bool(p)}")),
        ("h.csv", text("x,y,polarity,t\n", lambda t, x, y, p: f"{x},{y},{'ON' if p else 'OFF'},{t}")),
        ("i.txt", text("346 260\n", lambda t, x, y, p: f"{t / 1e6:.6f} {x} {y} {p}")),
    ],
)
def test_events_are_found_under_other_names(tmp_path, name, write):
    write(tmp_path / name)
    read = registry.load_events(tmp_path / name).events
    np.testing.assert_allclose(read.t, (T - T[0]) * 1e-6, atol=1e-9)
    np.testing.assert_array_equal(read.x, X)
    np.testing.assert_array_equal(read.y, Y)
    np.testing.assert_array_equal(read.polarity, 2 * P - 1)


def test_what_no_order_fits_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", TABLE[:, [1, 0, 2, 3]])
    with pytest.raises(DataError, match="a.npy: expected a whole array, got a table a.npy whose columns are"):
        registry.load_events(tmp_path / "a.npy")
    np.save(tmp_path / "b.npy", TABLE[:, :3])
    with pytest.raises(DataError, match="or one of 4 columns, got int64 of shape"):
        registry.load_events(tmp_path / "b.npy")
