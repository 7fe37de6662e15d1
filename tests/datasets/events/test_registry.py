"""npz and HDF5 archives of events, made of their exact layouts and damaged; layouts told by their files."""

import sys

import numpy as np
import pytest

from jaxpose.cli.check import command as check
from jaxpose.datasets.events import hdf5 as event_hdf5
from jaxpose.datasets.events import npz as event_npz
from jaxpose.datasets.events import registry as event_registry
from jaxpose.errors import DataError
from jaxpose.files.camera_json import write_camera
from jaxpose.geometry.camera import Camera

h5py = pytest.importorskip("h5py", reason="needs the extra hdf5")
hdf5plugin = pytest.importorskip("hdf5plugin", reason="needs the extra hdf5")

N = 3000
OFFSET = 49_599_288_000_000  # microseconds
POSES = "49599.3 1 2 3 0 0 0 1\n49599.4 2 2 3 0 0 0 1\n"


def columns():
    g = np.random.default_rng(2)
    t = 12_345 + np.sort(g.integers(0, 200_000, N))
    return {"t": t, "x": g.integers(0, 64, N), "y": g.integers(0, 48, N), "p": g.integers(0, 2, N)}


def write_h5(file, data, offset=OFFSET):
    kinds = {"t": "u4", "x": "u2", "y": "u2", "p": "u1"}
    file.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(file, "w") as out:
        for name, values in data.items():
            out.create_dataset(f"events/{name}", data=values.astype(kinds[name]), **hdf5plugin.Blosc())
        first = np.searchsorted(data["t"], 1000 * np.arange(data["t"].max() // 1000 + 1))
        out["ms_to_idx"] = first.astype(np.uint64)
        out["t_offset"] = np.int64(offset)


@pytest.fixture(params=["npz", "hdf5"])
def made(request, tmp_path):
    """A folder of either layout with camera and poses; what writes its events; its loader."""
    write_camera(tmp_path / "camera.json", Camera(50, 51, 31, 23, 64, 48, (-0.1, 0.0, 0.0, 0.0)), (), ".")
    (tmp_path / "poses.txt").write_text(POSES)
    if request.param == "npz":
        write = lambda data: np.savez(tmp_path / "events.npz", **{**data, "t": data["t"] + OFFSET})
        write(columns())
        return tmp_path, write, event_npz.load
    write = lambda data: write_h5(tmp_path / "events.h5", data)
    write(columns())
    return tmp_path, write, event_hdf5.load


def test_made_archives_read_back(made):
    folder, _, load = made
    recording, raw = load(folder), columns()
    np.testing.assert_allclose(recording.events.t, (raw["t"] - raw["t"][0]) / 1e6, rtol=1e-12)
    np.testing.assert_array_equal(recording.events.x, raw["x"])
    np.testing.assert_array_equal(recording.events.y, raw["y"])
    np.testing.assert_array_equal(recording.events.polarity, 2 * raw["p"] - 1)
    assert recording.camera == (50, 51, 31, 23, 64, 48, (-0.1, 0, 0, 0)) and recording.mosaic == "mono"
    start = (OFFSET + raw["t"][0]) / 1e6
    np.testing.assert_allclose(recording.t, [49599.3 - start, 49599.4 - start], atol=1e-9)
    np.testing.assert_allclose(recording.T_world_cam[:, :3, 3], [[1, 2, 3], [2, 2, 3]])
    again = event_registry.load_events(folder, mosaic="rggb", span=(0.05, 0.1))
    assert again.mosaic == "rggb" and 0.05 <= again.events.t[0] < again.events.t[-1] < 0.1


def test_archives_alone_are_told_of(made):
    folder, write, load = made
    for name in ("poses.txt", "camera.json"):
        (folder / name).unlink()
    data = columns()
    data["x"][:60], data["y"][:60] = 639, 470  # 2%: more than false ones
    write(data)
    recording = load(folder)
    assert recording.camera == (640, 640, 319.5, 239.5, 640, 480, ())
    assert "size of the sensor taken as 640x480, the smallest known that fits" in recording.notes
    assert "no calib.txt or camera.json: focal length taken as 640 px, no distortion" in recording.notes
    assert recording.notes[-1] == "no poses.txt: there is no ground truth to compare with"
    with pytest.raises(DataError, match="camera.json: expected a camera of 9x9, got 64x48"):
        write_camera(folder / "camera.json", Camera(50, 51, 31, 23, 64, 48), (), ".")
        load(folder, size=(9, 9))


def test_repeated_poses_are_told(made):
    folder, _, load = made
    (folder / "poses.txt").write_text(POSES + POSES.splitlines()[1] + "\n")
    recording = load(folder)
    assert len(recording.t) == 2
    assert "poses.txt: lines left out: 1 repeat the timestamp before (line 3)" in recording.notes


def test_archives_with_bad_events_are_refused(made):
    folder, write, load = made
    for change, message in (
        ({"p": columns()["p"] + 1}, r"events.(npz|h5): event \d+: expected polarities 0 and 1, .*, got 2"),
        ({"t": columns()["t"][::-1]}, r"event 1: expected events in the order of time, got 29\d\d of 3000"),
        ({"x": columns()["x"][:-1]}, "expected .* of one length, got 3000 t, 2999 x, 3000 y, 3000 p"),
        ({name: values[:0] for name, values in columns().items()}, "expected events, got none"),
    ):
        data = {**columns(), **change}
        if message.endswith("none") and load is event_hdf5.load:
            with h5py.File(folder / "events.h5", "w") as out:
                for name in "txyp":
                    out[f"events/{name}"] = np.zeros(0, np.uint32)
        else:
            write(data)
        with pytest.raises(DataError, match=message) as error:
            load(folder)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("keep", [0, 10, 400, 0.5, 0.97])
def test_truncated_archives_are_refused(made, keep):
    folder, _, load = made
    (file,) = [*folder.glob("events.*")]
    content = file.read_bytes()
    file.write_bytes(content[: int(keep if keep > 1 else keep * len(content))])
    with pytest.raises(DataError, match=f"{file}: expected (a whole npz|an HDF5) file, got .") as error:
        load(file)
    assert "\n" not in str(error.value)


def test_npz_of_other_names_compressed_and_damaged(tmp_path):
    raw = columns()
    np.savez_compressed(tmp_path / "a.npz", **{f"{name}s": values for name, values in raw.items()})
    recording = event_npz.load(tmp_path, size=(64, 48))
    np.testing.assert_array_equal(recording.events.x, raw["x"])
    assert recording.notes[-2].startswith("timestamps read as microseconds: 3000 events in 0.1999 s")
    np.savez(tmp_path / "a.npz", t=raw["t"], x=raw["x"])
    for path in (tmp_path, tmp_path / "a.npz"):
        with pytest.raises(
            DataError, match="expected (one npz file with )?arrays x y t p.*, got (a.npz|t, x)"
        ):
            event_npz.load(path)
    np.savez(tmp_path / "a.npz", **{**raw, "x": raw["x"].astype(object)})
    with pytest.raises(DataError, match=r"a.npz: expected a whole npz file, got entries of type \|O"):
        event_npz.load(tmp_path)
    np.savez(tmp_path / "a.npz", **raw)
    np.savez(tmp_path / "b.npz", **raw)
    with pytest.raises(DataError, match="got 2 files, name one of them: a.npz, b.npz"):
        event_npz.load(tmp_path)
    content = bytearray((tmp_path / "a.npz").read_bytes())
    content[len(content) // 2] ^= 1  # a bit that flipped on disk
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(DataError, match="a.npz: expected a whole npz file, got |order of time"):
        event_npz.load(tmp_path / "a.npz", size=(64, 48))


def test_dsec_folders_are_of_the_left_camera(tmp_path):
    write_h5(tmp_path / "events/left/events.h5", columns())
    with h5py.File(tmp_path / "events/left/rectify_map.h5", "w") as out:
        out["rectify_map"] = np.zeros((4, 4))
    assert event_registry.find_format(tmp_path) == "hdf5"
    assert len(event_hdf5.load(tmp_path).events.t) == N
    with h5py.File(tmp_path / "events/left/events.h5", "w") as out:
        out["CD"] = np.zeros(3)
    with pytest.raises(DataError, match="events.h5: expected events/ with x y p t, .*, got CD"):
        event_hdf5.load(tmp_path)


def test_without_the_extra_hdf5_says_how_to_get_it(tmp_path, monkeypatch):
    write_h5(tmp_path / "events.h5", columns())
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(DataError, match=r'got no hdf5plugin: pip install -e "\.\[hdf5\]"'):
        event_hdf5.load(tmp_path)


def test_formats_are_told_by_their_files(tmp_path):
    np.savez(tmp_path / "a.npz", **columns())
    assert event_registry.find_format(tmp_path) == "npz" == event_registry.find_format(tmp_path / "a.npz")
    (tmp_path / "events.txt").write_text("0.1 3 4 1\n0.2 3 4 0\n")
    assert event_registry.find_format(tmp_path) == "davis"
    for name in ("pose", "events"):
        (tmp_path / "train" / name).mkdir(parents=True)
    assert event_registry.find_format(tmp_path) == "eventnerf"
    (tmp_path / "none/a").mkdir(parents=True)
    folders = (
        (tmp_path / "none", "a"),
        (tmp_path / "none/a", "an empty folder"),
        (tmp_path / "no", "nothing"),
    )
    for path, got in folders:
        with pytest.raises(DataError, match=f"{path}: expected a recording of events, .*got {got}$") as error:
            event_registry.load_events(path)
        assert all(name in str(error.value) for name in ("eventnerf", "davis", "hdf5", "npz"))


def test_check_reads_archives(made):
    folder, write, _ = made
    result = check.run(check.Config(next(folder.glob("events.*"))))
    assert result.format in ("npz events (events.npz)", "HDF5 events (events.h5)")
    assert result.facts[0].numbers["count"] == N and check.exit_code(result) == 0
    data = columns()
    data["x"][7] = 64
    write(data)
    result = check.run(check.Config(folder))
    assert check.exit_code(result) == 2
    assert any("expected pixels of 64x48, got up to 64, 47" in str(finding) for finding in result.findings)
    write({**data, "p": data["p"] + 1})
    assert check.exit_code(check.run(check.Config(folder))) == 1


@pytest.mark.parametrize(
    ("t", "words"),
    [
        (np.array([0.0, 1e300]), "event 1: expected a timestamp before the year 2200, got 1e\\+300"),
        (np.array([0, 2**64 - 1], np.uint64), "event 1: expected a timestamp before the year 2200"),
        (np.array([-(2**63), 5], np.int64), "event 0: expected a timestamp before the year 2200"),
        (
            np.array(["2026-01-01", "2026-01-02"], "M8[D]"),
            "expected a whole npz file, got an array described as",
        ),
    ],
)
def test_times_of_no_time_are_refused(tmp_path, t, words):
    np.savez(tmp_path / "a.npz", t=t, x=np.zeros(2, int), y=np.zeros(2, int), p=np.zeros(2, int))
    with pytest.raises(DataError, match=f"a.npz: {words}"):
        event_npz.load(tmp_path / "a.npz", size=(4, 4))
