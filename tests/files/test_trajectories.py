"""Trajectory files against round trips and evo, their errors, and atomic writing."""

import dataclasses
import json
import os
import sys
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import jaxpose
from jaxpose.errors import DataError
from jaxpose.files import association, atomic, run_folder, trajectories


def random_trajectory(seed, count=20):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-6, 6, size=(count, 1))
    return trajectories.Trajectory(1.5e9 + np.cumsum(rng.uniform(1e-4, 1, count)), T)


# --- trajectories ---------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_tum_round_trip(tmp_path_factory, seed):
    file = tmp_path_factory.mktemp("tum") / "trajectory.txt"
    written = random_trajectory(seed)
    trajectories.write_tum(file, written)
    read = trajectories.read_tum(file)
    assert read.t0_ns == Decimal(repr(float(written.t[0]))) * 10**9 and read.t[0] == 0
    np.testing.assert_array_equal(trajectories.since(read, 0), written.t)
    np.testing.assert_array_equal(read.T[:, :3, 3], written.T[:, :3, 3])
    np.testing.assert_allclose(read.T, written.T, atol=1e-14)


def test_kitti_round_trip(tmp_path):
    written = random_trajectory(0)
    trajectories.write_kitti(tmp_path / "poses.txt", written.T)
    read = trajectories.read_kitti(tmp_path / "poses.txt", rate_hz=4.0)
    np.testing.assert_allclose(read.T, written.T, atol=1e-14)
    np.testing.assert_array_equal(read.t, np.arange(20) / 4)


def test_tum_conventions(tmp_path):
    """Quaternions are xyzw, comments skipped, poses map to the world."""
    file = tmp_path / "trajectory.txt"
    half = np.sqrt(0.5)
    file.write_text(f"# t tx ...\n\n1.5 1 2 3 0 0 {half} {half}\r\n  2.5\t4 5 6 0 0 0 -1\n")
    t, T, t0_ns = trajectories.read_tum(file)
    assert t0_ns == 0
    np.testing.assert_array_equal(t, [1.5, 2.5])
    np.testing.assert_allclose(T[0] @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-15)
    np.testing.assert_allclose(T[1] @ [1, 0, 0, 1], [5, 5, 6, 1], atol=1e-15)


def test_euroc_conventions(tmp_path):
    """Nanoseconds, quaternion wxyz; with or without velocity and biases."""
    file = tmp_path / "data.csv"
    half = np.sqrt(0.5)
    for rest in ("", ",0" * 9):
        file.write_text(f"#timestamp, ...\n1403715524907143168,1,2,3,{half},0,0,{half}{rest}\n")
        t, T, t0_ns = trajectories.read_euroc(file)
        assert t[0] == 0 and t0_ns == 1403715524907143168
        np.testing.assert_allclose(T[0] @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-15)


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    [
        "freiburg1_xyz-groundtruth.txt",
        "fr2_desk_ORB.txt",
        "euroc/V1_03_difficult.csv",
        "tum_vi/dataset-room1_512_16.csv",
    ],
)
def test_readers_agree_with_evo(data_dir, name):
    from evo.tools import file_interface

    file = data_dir / "trajectories" / name
    if file.suffix == ".csv":
        ours, theirs = trajectories.read_euroc(file), file_interface.read_euroc_csv_trajectory(file)
    else:
        ours, theirs = trajectories.read_tum(file), file_interface.read_tum_trajectory_file(file)
    np.testing.assert_allclose(trajectories.since(ours, 0), theirs.timestamps, rtol=0, atol=3e-7)
    np.testing.assert_allclose(ours.T, np.array(theirs.poses_se3), atol=1e-9)


TUM_LINE = "1 0 0 0 0 0 0 1\n"
EUROC_LINE = "1000000000,0,0,0,1,0,0,0\n"
KITTI_LINE = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    "reader, text, message",
    [
        (
            trajectories.read_tum,
            "",
            r"trajectory: expected lines of 8 numbers \(t tx ty tz qx qy qz qw\), got none",
        ),
        (trajectories.read_tum, "# only\n", "trajectory: expected lines of 8 numbers"),
        (trajectories.read_tum, TUM_LINE + "2 0 0 0 0 0 1\n", "trajectory:2: expected 8 numbers .*, got 7"),
        (
            trajectories.read_tum,
            "#\n" + TUM_LINE + "2 0 0 0 x 0 0 1\n",
            "trajectory:3: expected 8 .*, got '2 0 0 0 x 0 0 1'",
        ),
        (
            trajectories.read_tum,
            TUM_LINE + "2 0 0 0 0 0 0 0\n",
            "trajectory:2: expected finite numbers, got NaN, infinity or a zero quaternion",
        ),
        (trajectories.read_tum, "2 0 0 0 0 0 0 0\n", "trajectory:1: expected a unit quaternion, got zero"),
        (
            trajectories.read_tum,
            TUM_LINE + "2 0 0 0 0 0 0 2\n",
            "trajectory:2: expected a unit quaternion xyzw behind the position, got one of length 2",
        ),
        (trajectories.read_tum, TUM_LINE + "2 0 0 0 0 nan 0 1\n", "trajectory:2: expected finite numbers"),
        (trajectories.read_tum, TUM_LINE + "2 0 inf 0 0 0 0 1\n", "trajectory:2: expected finite numbers"),
        (
            trajectories.read_tum,
            TUM_LINE + TUM_LINE,
            "trajectory:2: expected a timestamp after that before, got a repeated one",
        ),
        (
            trajectories.read_tum,
            TUM_LINE + "0.5" + TUM_LINE[1:],
            "trajectory:2: expected a timestamp after 1.0 s, got 0.5 s",
        ),
        (
            trajectories.read_tum,
            "-9e18" + TUM_LINE[1:] + TUM_LINE,
            "trajectory: expected timestamps until the year 2200, got -9e.18 s",
        ),
        (trajectories.read_tum, "\x00\x89PNG\n", "trajectory: expected text, got bytes that are none"),
        (trajectories.read_euroc, EUROC_LINE + "1 2 3\n", "trajectory:2: expected 17 numbers .*, got 1"),
        (trajectories.read_euroc, EUROC_LINE[:-1] + ",0\n", "trajectory:1: expected 17 numbers .*, got 9"),
        (
            trajectories.read_euroc,
            EUROC_LINE + "2000000000,0,0,0,1,1,0,0\n",
            "trajectory:2: expected a unit quaternion wxyz",
        ),
        (trajectories.read_kitti, KITTI_LINE + TUM_LINE, "trajectory:2: expected 12 numbers .*, got 8"),
        (
            trajectories.read_kitti,
            KITTI_LINE + "-" + KITTI_LINE,
            "trajectory:2: expected a rotation, got a matrix",
        ),
    ],
)
def test_a_bad_line_is_named(tmp_path, reader, text, message):
    file = tmp_path / "trajectory"
    file.write_text(text)
    with pytest.raises(DataError, match=message) as error:
        reader(file)
    assert str(file) in str(error.value) and "\n" not in str(error.value)


def test_kitti_rounding_is_repaired(tmp_path):
    (tmp_path / "poses.txt").write_text("1.003 0.002 0 7 -0.001 0.999 0 8 0 0 1 9\n")
    T = trajectories.read_kitti(tmp_path / "poses.txt").T[0]
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)
    np.testing.assert_array_equal(T[:3, 3], [7, 8, 9])


def test_missing_truth_is_left_out_of_tum_and_refused_by_kitti(tmp_path):
    trajectory = random_trajectory(1, 5)
    trajectory.T[3] = np.nan
    trajectories.write_tum(tmp_path / "reference.txt", trajectory)
    np.testing.assert_array_equal(
        trajectories.since(trajectories.read_tum(tmp_path / "reference.txt"), 0), np.delete(trajectory.t, 3)
    )
    with pytest.raises(DataError, match="poses.txt: expected finite poses, got NaN or infinity in frame 3"):
        trajectories.write_kitti(tmp_path / "poses.txt", trajectory.T)
    assert not (tmp_path / "poses.txt").exists()


# --- association ----------------------------------------------------------------------------------------

# Timestamps on a grid, so that equal distances and repeated partners happen.
STAMPS = st.lists(st.integers(0, 60), min_size=1, max_size=25, unique=True).map(lambda x: np.sort(x) / 4.0)


@settings(deadline=None)
@given(STAMPS, STAMPS, st.sampled_from([0.0, 0.25, 0.6, 5.0]))
def test_associate_agrees_with_evo(t_a, t_b, most):
    from evo.core import sync

    short, long = (t_b, t_a) if len(t_b) <= len(t_a) else (t_a, t_b)
    expected_short, expected_long = sync.matching_time_indices(short, long, most)
    try:
        found_a, found_b = association.associate(t_a, t_b, most)
    except DataError:
        found_a = found_b = np.array([], int)
    found_short, found_long = (found_b, found_a) if len(t_b) <= len(t_a) else (found_a, found_b)
    assert list(found_short) == expected_short
    assert list(found_long) == expected_long


@settings(deadline=None)
@given(STAMPS, STAMPS)
def test_associate_finds_the_nearest(t_a, t_b):
    found_a, found_b = association.associate(t_a, t_b, np.inf)
    distance = np.abs(t_a[:, None] - t_b)
    nearest = distance.min(axis=0) if len(t_b) <= len(t_a) else distance.min(axis=1)
    np.testing.assert_array_equal(distance[found_a, found_b], nearest)


@pytest.mark.parametrize(
    "t_b, found",
    [
        (np.array([9.0, 10.0]), "9.000 to 10.000 s, the nearest two 7 s apart"),
        (np.array([0.9, 1.025]), "0.900 to 1.025 s, the nearest two 0.025 s apart"),
        (np.array([]), "no timestamps"),
    ],
)
def test_disjoint_stamps_are_refused(t_b, found):
    with pytest.raises(
        DataError, match=f"expected timestamps within 0.01 s, got 0.000 to 2.000 s and {found}"
    ):
        association.associate(np.array([0.0, 1.0, 2.0]), t_b)


# --- writing --------------------------------------------------------------------------------------------


class Point(NamedTuple):
    x: float
    y: float


@dataclasses.dataclass(frozen=True)
class Settings:
    path: Path
    span: tuple[float, float] = (0.0, 1.0)


def test_write_json_takes_what_a_run_has(tmp_path):
    file = tmp_path / "results.json"
    atomic.write_json(
        file,
        {
            "config": Settings(Path("a") / "b"),
            "error": np.float32(0.5),
            "count": np.int64(3),
            "lost": np.bool_(True),
            "lists": [np.array([1.0, np.nan, -np.inf]), jnp.array([[1, 2]])],
            "nothing": float("nan"),
            "point": Point(1.0, float("inf")),
            "scalar": jnp.float32(2.0),
            "none": None,
            7: "seven",
        },
    )
    # Strict JSON: Python's own reader would take NaN otherwise.
    read = json.loads(file.read_text(), parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert read == {
        "config": {"path": os.path.join("a", "b"), "span": [0.0, 1.0]},
        "error": 0.5,
        "count": 3,
        "lost": True,
        "lists": [[1.0, None, None], [[1, 2]]],
        "nothing": None,
        "point": {"x": 1.0, "y": None},
        "scalar": 2.0,
        "none": None,
        "7": "seven",
    }
    assert read["lost"] is True


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    file = tmp_path / "results.json"
    atomic.write_json(file, {"run": 1})
    with pytest.raises(TypeError):
        atomic.write_json(file, {"run": object()})
    with pytest.raises(RuntimeError), atomic.atomic(file) as temporary:
        temporary.write_text("half a fi")
        raise RuntimeError
    assert json.loads(file.read_text()) == {"run": 1}
    assert list(tmp_path.iterdir()) == [file]


def test_atomic_replaces_at_the_end_only(tmp_path):
    file = tmp_path / "picture.png"
    file.write_text("old")
    with atomic.atomic(file) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".png")
        temporary.write_text("new")
        assert file.read_text() == "old"
    assert file.read_text() == "new"
    assert list(tmp_path.iterdir()) == [file]


# --- the run --------------------------------------------------------------------------------------------


def test_run_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = run_folder.folder_path("imu_slam", name="mine")
    assert named == Path("outputs/imu_slam/mine") and not named.exists()
    for _ in range(2):  # a named folder may exist
        with run_folder.opened(named) as folder:
            assert folder == named and named.is_dir()
    stamped = {run_folder.folder_path("imu_slam") for _ in range(3)}
    assert len(stamped) == 3 and {folder.parent for folder in stamped} == {named.parent}
    assert run_folder.folder_path("imu_slam", out=tmp_path / "a/b") == tmp_path / "a/b"
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError), run_folder.opened(tmp_path / "file"):
        pass


def test_a_failed_run_takes_away_no_folder_but_its_own(tmp_path):
    """Neither the user's empty folders, nor anything that holds a file."""
    (tmp_path / "out" / "mine").mkdir(parents=True)
    for folder, written in (("out", None), ("new/run", None), ("other/run", "results.json")):
        with pytest.raises(KeyError), run_folder.opened(tmp_path / folder) as inner:
            if written:
                (inner / written).touch()
            raise KeyError
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} == {
        "out", "out/mine", "other", "other/run", "other/run/results.json",
    }  # fmt: skip


def test_versions():
    versions = run_folder.versions()
    assert versions["jaxpose"] == jaxpose.__version__
    assert versions["python"] == sys.version.split()[0]
    assert versions["backend"] in ("cpu", "gpu", "tpu") and versions["device"]
    assert json.loads(json.dumps(versions)) == versions
