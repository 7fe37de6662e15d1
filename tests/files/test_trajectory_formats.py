"""Trajectory files whose format is found by what is in them: round trips, timestamps, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.files import trajectories


def trajectory(count=12, start=1.6e9):
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return trajectories.Trajectory(start + np.cumsum(rng.uniform(0.01, 0.1, count)), T)


def test_every_format_is_found_and_gives_the_poses_back(tmp_path):
    written = trajectory()
    trajectories.write_tum(tmp_path / "tum", written)
    trajectories.write_kitti(tmp_path / "kitti", written.T)
    trajectories.write_euroc(tmp_path / "euroc", written)
    np.savetxt(tmp_path / "lines", written.T.reshape(-1, 16), fmt="%.17g")
    np.savetxt(tmp_path / "blocks", written.T.reshape(-1, 4), fmt="%.17g", header="poses")
    for name, found, stamped in (
        ("tum", "TUM", True), ("kitti", "KITTI", False), ("euroc", "EuRoC", True),
        ("lines", "4x4 list", False), ("blocks", "4x4 list", False),
    ):  # fmt: skip
        read = trajectories.read_trajectory(tmp_path / name)
        assert (read.format, read.has_timestamps, read.notes) == (found, stamped, ())
        np.testing.assert_allclose(read.trajectory.T, written.T, atol=1e-14)
        t = written.t if stamped else np.arange(12)
        found_t = trajectories.since(read.trajectory, 0)
        np.testing.assert_allclose(found_t, t, rtol=0, atol=3e-7 if name == "euroc" else 0)


def test_euroc_is_read_by_another(tmp_path):
    from evo.tools import file_interface

    written = trajectory()
    trajectories.write_euroc(tmp_path / "data.csv", written)
    theirs = file_interface.read_euroc_csv_trajectory(tmp_path / "data.csv")
    np.testing.assert_allclose(np.array(theirs.poses_se3), written.T, atol=1e-12)
    np.testing.assert_allclose(theirs.timestamps, written.t, rtol=0, atol=3e-7)
    line = (tmp_path / "data.csv").read_text().splitlines()[1]
    assert line.split(",")[0] == str(round(written.t[0] * 1e9))


def test_what_euroc_cannot_hold(tmp_path):
    written = trajectory(3, start=0.0)
    with pytest.raises(DataError, match="timestamps at least 1 ns apart"):
        trajectories.write_euroc(tmp_path / "out", written._replace(t=np.array([0, 1e-10, 2e-10])))
    written.T[1] = np.nan
    with pytest.raises(DataError, match="out: expected finite poses, got NaN or infinity in row 1"):
        trajectories.write_euroc(tmp_path / "out", written)
    assert not list(tmp_path.iterdir())


def test_of_equal_stamps_the_first_is_kept_and_counted(tmp_path):
    lines = ["1 0 0 0 0 0 0 1", "2 5 0 0 0 0 0 1", "2 6 0 0 0 0 0 1", "3 7 0 0 0 0 0 1"]
    (tmp_path / "tum").write_text("\n".join(lines))
    read = trajectories.read_trajectory(tmp_path / "tum")
    assert read.repeated == 1
    np.testing.assert_array_equal(read.trajectory.t, [1, 2, 3])
    np.testing.assert_array_equal(read.trajectory.T[:, 0, 3], [0, 5, 7])
    (tmp_path / "tum").write_text("\n".join([*lines, "2.5 0 0 0 0 0 0 1"]))
    with pytest.raises(DataError, match="tum:5: expected a timestamp after 3.0 s, got 2.5 s"):
        trajectories.read_trajectory(tmp_path / "tum")


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "file: expected a trajectory, TUM .* got no line of numbers"),
        ("# only\n\n", "got no line of numbers"),
        ("# head\n1 2 3\n", "file:2: expected a trajectory, TUM .*, got '1 2 3'"),
        ("1,2,3,4,5,6,7\n", "file:1: expected a trajectory, TUM .*, got '1,2,3,4,5,6,7'"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", "file: expected four lines for each pose, got 3 lines"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n", "file:1: expected a last row 0 0 0 1 .*, got 0 0 1 1"),
        ("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "file:1: expected a rotation"),
        ("1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n", "file:3: expected 4 numbers of 4x4 poses, got 3"),
    ],
)  # fmt: skip
def test_what_is_no_trajectory(tmp_path, text, message):
    (tmp_path / "file").write_text(text)
    with pytest.raises(DataError, match=message) as error:
        trajectories.read_trajectory(tmp_path / "file")
    assert "\n" not in str(error.value)


def test_stamps_of_lists_and_tables(tmp_path):
    file = tmp_path / "timestamps"
    file.write_text("# images\n1.5 rgb/1.5.png\n\n2.25 rgb/2.25.png\n")
    assert trajectories.read_timestamps(file) == [1_500_000_000, 2_250_000_000]
    file.write_text("#timestamp [ns],w\n1403715523912140000,-0.1\n1403715523917140000,0.2\n")
    assert trajectories.read_timestamps(file) == [1403715523912140000, 1403715523917140000]
    for text, message in (
        ("1\n\nx\n", "timestamps:3: expected a line that begins with a timestamp, got 'x'"),
        ("1\nnan\n", "timestamps:2: expected a timestamp after that before, got NaN"),
        ("1\n1\n", "timestamps:2: expected a timestamp after that before, got a repeated one"),
        ("1\n0.5\n", "timestamps:2: expected a timestamp after 1.0 s, got 0.5 s"),
        ("# none\n", "timestamps: expected lines of a line that begins with a timestamp, got none"),
    ):
        file.write_text(text)
        with pytest.raises(DataError, match=message):
            trajectories.read_timestamps(file)


@pytest.mark.parametrize("mark", ["[", "(", "[(", "<qw>", "#[", "."])
def test_a_line_too_long_for_names_is_no_header(tmp_path, mark):
    """Regular expressions that look for names would look to its end from every bracket: for minutes."""
    (tmp_path / "a.txt").write_text(mark * 100_000 + "\n0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n")
    found = trajectories.read_trajectory(tmp_path / "a.txt")
    assert found.format == "TUM" and found.trajectory.t.tolist() == [0, 1]
