"""The TUM RGB-D loader on made folders of the exact layout, and on damaged ones."""

import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd import tum
from jaxpose.errors import DataError
from jaxpose.slam.initial_pose import first_pose

START = 1305031102.0  # seconds since 1970
COLOR_T = START + np.array([0.0, 0.0332, 0.0681, 0.1003, 0.1340, 0.1675])
DEPTH_T = COLOR_T + [0.0051, -0.0043, 0.0215, 0.0062, -0.0070, 0.0012]  # the third is too far from its colour
LAYOUT = "rgbd_dataset_freiburg1_desk"


def write_list(file, timestamps, kind):
    lines = [f"# {kind} images", "# file: 'desk.bag'", "# timestamp filename"]
    file.write_text("\n".join(lines + [f"{t:.6f} {kind}/{t:.6f}.png" for t in timestamps]) + "\n")


def write_truth(file, t, T):
    rows = [
        [timestamp, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        for timestamp, pose in zip(t, T, strict=True)
    ]
    file.write_text("# ground truth\n" + "".join(" ".join(f"{x:.12f}" for x in row) + "\n" for row in rows))


@pytest.fixture
def desk(tmp_path, walk, save):
    """Six frames; true poses 4 ms after each colour image, and far ones between, but none for the fifth."""
    folder = tmp_path / LAYOUT
    for i in range(6):
        save(folder / f"rgb/{COLOR_T[i]:.6f}.png", walk.rgb[i])
        save(folder / f"depth/{DEPTH_T[i]:.6f}.png", walk.counts[i])
    write_list(folder / "rgb.txt", COLOR_T, "rgb")
    write_list(folder / "depth.txt", DEPTH_T, "depth")
    kept = [0, 1, 2, 3, 5]
    t = np.stack([COLOR_T[kept] - 0.012, COLOR_T[kept] + 0.004], axis=1).ravel()
    T = np.stack([np.tile(np.eye(4), (5, 1, 1)), walk.T_world_cam[kept]], axis=1).reshape(-1, 4, 4)
    write_truth(folder / "groundtruth.txt", t[t != COLOR_T[5] - 0.012], T[t != COLOR_T[5] - 0.012])
    return folder


def test_a_made_sequence_reads_back(desk, walk, metres):
    recording = tum.load(desk)
    assert np.array_equal(np.asarray(Image.open(desk / recording.files[1])), recording.read(1).rgb)
    used = [0, 1, 3, 4, 5]
    assert recording.name.endswith(f"/{LAYOUT}")
    assert recording.camera == (
        *(517.3, 516.5, 318.6, 255.3, 32, 24),
        (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    )
    np.testing.assert_allclose(recording.t, COLOR_T[used] - START, atol=1e-6)
    for row, i in enumerate(used):
        rgb, depth = recording.read(row)
        np.testing.assert_array_equal(rgb, walk.rgb[i])
        np.testing.assert_allclose(depth, metres(walk.counts[i], 5000), rtol=1e-6)
        assert depth.dtype == np.float32
    assert np.isnan(recording.T_world_cam[3]).all()
    np.testing.assert_allclose(recording.T_world_cam[[0, 1, 2, 4]], walk.T_world_cam[[0, 1, 3, 5]], atol=1e-9)
    assert recording.imu is None
    assert recording.accelerometer is None
    color, depth, intrinsics, ground_truth = recording.notes
    assert color == (
        "1 of 6 colour images left out, no depth of their own within 0.02 s: 1305031102.068100.png"
    )
    assert depth.startswith("1 of 6 depth images left out") and "1305031102.089600.png" in depth
    assert intrinsics.endswith("which are for 640x480; the images are 32x24")
    assert ground_truth == "1 frames without a usable pose (none within 0.02 s): 1305031102.134000"


def test_a_sequence_in_part_is_used_and_counted(desk, walk):
    """The lists name an image that is not there, and one by another system's name."""
    (desk / f"rgb/{COLOR_T[0]:.6f}.png").unlink()
    (desk / f"rgb/{COLOR_T[1]:.6f}.png").rename(desk / f"rgb/{COLOR_T[1]:.6f}.PNG")
    text = (desk / "rgb.txt").read_text().replace(f"rgb/{COLOR_T[3]:.6f}", f".\\rgb\\{COLOR_T[3]:.6f}")
    (desk / "rgb.txt").write_text(text)
    recording = tum.load(desk)
    assert recording.t0_ns == 1305031102033200000
    for row, i in enumerate([1, 3, 4, 5]):
        np.testing.assert_array_equal(recording.read(row).rgb, walk.rgb[i])
    assert recording.notes[0] == (f"1 of 6 files that rgb.txt lists are not there: rgb/{COLOR_T[0]:.6f}.png")


@pytest.mark.parametrize(
    "change",
    [
        lambda stamp, name: f"{stamp},{name}",
        lambda stamp, name: f"{stamp}, {name}",
        lambda stamp, name: f"{stamp} .\\{name.replace('/', chr(92)).upper()}",
        lambda stamp, name: f"{stamp} /home/somebody/desk/{name}",
        lambda stamp, name: f"{stamp} D:\\data\\desk\\{name.replace('/', chr(92))}",
    ],
)
def test_lists_of_other_systems_and_machines(desk, change):
    before = tum.load(desk)
    lines = [line.split() for line in (desk / "rgb.txt").read_text().splitlines() if line[:1] != "#"]
    (desk / "rgb.txt").write_text("\n".join(change(*line) for line in lines))
    after = tum.load(desk)
    np.testing.assert_array_equal(after.t, before.t)
    assert after.files == before.files


def test_eth3d_has_its_own_calibration(desk):
    folder = desk.rename(desk.with_name("sofa_1"))
    (folder / "calibration.txt").write_text("726.28 726.28 15.5 11.25\n")
    recording = tum.load(folder)
    assert recording.camera == (726.28, 726.28, 15.5, 11.25, 32, 24, ())
    assert not any("fx fy cx cy" in note for note in recording.notes)
    (folder / "calibration.txt").write_text("726.28 726.28 15.5\n")
    with pytest.raises(DataError, match="calibration.txt: expected fx fy cx cy, got '726.28 726.28 15.5'"):
        tum.load(folder)


def test_bonn_s_poses_are_brought_from_the_markers_to_the_camera(desk, walk):
    """www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset: T_ROS T_g T_ROS T_m, less the turn of the world."""
    markers = tum.load(desk).T_world_cam
    recording = tum.load(desk.rename(desk.with_name("rgbd_bonn_crowd")))
    assert recording.camera.fx == 542.822841 and recording.camera.distortion[0] == 0.039903
    T_ros = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    T_m = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    published = (T_ros @ markers @ T_ros)[:, :3, :3] @ T_m
    ours = (T_ros @ recording.T_world_cam)[:, :3, :3]
    known = np.isfinite(ours[:, 0, 0])
    assert np.abs(ours - published)[known].max() < 0.12  # what is published is no rotation to about that
    at = (T_ros @ markers @ T_ros) @ [0.0113, -0.0098, 0.0111, 1]
    np.testing.assert_allclose((T_ros @ recording.T_world_cam)[known, :3, 3], at[known, :3], atol=1e-9)


# The accelerometer's axes in the camera's.
KINECT = {"left": [-1, 0, 0], "up": [0, -1, 0], "forward": [0, 0, 1]}


def held(folder, T_world_cam, turned="left up forward"):
    """Readings of a Kinect held still, as at the fourth image, from 2 s before the first on."""
    up_cam = T_world_cam[3, 2, :3]
    axes = [KINECT[name] for name in turned.split()]
    t = np.arange(COLOR_T[0] - 2, COLOR_T[-1] + 2, 0.002)
    rows = [f"{x:.6f} " + " ".join(f"{9.8 * up_cam @ axis:.6f}" for axis in axes) for x in t]
    (folder / "accelerometer.txt").write_text(
        "\n".join(["# accelerometer data", "# timestamp ax ay az", *rows])
    )
    return 9.8 * up_cam


def test_the_accelerometer_is_read_in_the_camera_s_axes(desk, walk):
    force = held(desk, walk.T_world_cam)
    t, force_cam = tum.load(desk).accelerometer
    np.testing.assert_allclose(force_cam, np.tile(force, (len(t), 1)), atol=1e-5)
    np.testing.assert_allclose([t[0], t[1] - t[0]], [COLOR_T[0] - 2 - START, 0.002], atol=2e-6)
    (desk / "groundtruth.txt").unlink()
    found = first_pose(tum.load(desk))
    assert "upright" in found.notes[0]
    np.testing.assert_allclose(found.T_world_cam[2, :3], force / 9.8, atol=1e-6)


def test_an_accelerometer_that_disagrees_with_the_truth_is_told(desk, walk):
    upright = np.tile(walk.T_world_cam[3], (6, 1, 1))
    write_truth(desk / "groundtruth.txt", COLOR_T, upright)
    held(desk, walk.T_world_cam)
    assert not any("accelerometer" in note for note in tum.load(desk).notes)
    held(desk, walk.T_world_cam, "up left forward")
    (note,) = (note for note in tum.load(desk).notes if "accelerometer" in note)
    assert note.startswith("accelerometer.txt's mean force is 9.8 m/s^2, ") and "by the true poses" in note


def test_an_accelerometer_without_readings_and_a_damaged_one(desk):
    file = desk / "accelerometer.txt"
    file.write_text("# accelerometer data\n# timestamp ax ay az\n")
    recording = tum.load(desk)
    assert recording.accelerometer is None and "accelerometer.txt has no readings" in recording.notes
    file.write_text("# timestamp ax ay az\n1305031098.6 0.1 8.1 -4.0\n1305031098.7 0.1\n")
    with pytest.raises(DataError) as error:
        tum.load(desk)
    assert str(error.value) == f"{file}:3: expected 4 numbers (t ax ay az), got 2"


def test_the_limit_of_association_is_a_setting(desk):
    assert len(tum.load(desk, max_difference_s=0.04).t) == 6
    assert len(tum.load(desk, max_difference_s=0.005).t) == 2
    with pytest.raises(
        DataError, match=f"{LAYOUT}: expected colour and depth within 0.001 s, got timestamps from"
    ):
        tum.load(desk, max_difference_s=0.001)


def test_an_image_has_one_partner_the_nearest(tmp_path, walk, save):
    """As the data set's associate.py: pairs by increasing difference, each image once."""
    generator = np.random.default_rng(3)
    color_t = START + np.cumsum(generator.uniform(0.005, 0.03, 40))
    depth_t = START + np.cumsum(generator.uniform(0.005, 0.03, 40))
    for kind, timestamps, pixels in (("rgb", color_t, walk.rgb[0]), ("depth", depth_t, walk.counts[0])):
        for t in timestamps:
            save(tmp_path / f"{kind}/{t:.6f}.png", pixels)
        write_list(tmp_path / f"{kind}.txt", timestamps, kind)
    left, right, expected = set(range(40)), set(range(40)), []
    differences = np.abs(np.round(color_t, 6)[:, None] - np.round(depth_t, 6)[None])
    for flat in np.argsort(differences, axis=None):
        i, j = divmod(int(flat), 40)
        if differences[i, j] < 0.02 and i in left and j in right:
            left.remove(i)
            right.remove(j)
            expected.append(i)
    expected.sort()
    assert 20 < len(expected) < 40
    t = tum.load(tmp_path).t
    np.testing.assert_allclose(t, color_t[expected] - color_t[expected[0]], atol=2e-6)


@pytest.mark.parametrize(
    "name, fx, lens",
    [
        ("rgbd_dataset_freiburg2_xyz", 520.9, 5),
        ("FR3_office", 535.4, 0),
        ("fr1", 517.3, 5),
        ("fr10", 525.0, 0),
        ("kitchen", 525.0, 0),
    ],
)
def test_the_camera_is_known_by_the_name(desk, name, fx, lens):
    recording = tum.load(desk.rename(desk.parent / name))
    assert recording.camera.fx == fx and len(recording.camera.distortion) == lens
    assumed = [note for note in recording.notes if "no freiburg1, 2 or 3 in the folder's name" in note]
    assert len(assumed) == (fx == 525.0)


def test_intrinsics_of_a_file_come_first(desk):
    (desk.parent / "camera-intrinsics.txt").write_text("30 0 15.5\n0 31 11.5\n0 0 1\n")
    recording = tum.load(desk)
    assert recording.camera == (30, 31, 15.5, 11.5, 32, 24, ())
    assert not any("published" in note for note in recording.notes)


def test_without_truth(desk):
    (desk / "groundtruth.txt").unlink()
    recording = tum.load(desk, depth_per_metre=1000.0)
    assert recording.T_world_cam is None
    assert "no groundtruth.txt: there is no ground truth to compare with" in recording.notes
    assert recording.read(0).depth.max() > 25


def test_the_first_of_lines_with_one_stamp_counts(desk, walk):
    """As in the published ground truth of fr2_desk."""
    file = desk / "groundtruth.txt"
    lines = file.read_text().splitlines()
    last = lines[-1].split()
    file.write_text("\n".join([*lines, " ".join([last[0], "9", "9", "9", *last[4:]])]))
    recording = tum.load(desk)
    np.testing.assert_allclose(recording.T_world_cam[4], walk.T_world_cam[5], atol=1e-9)
    note = f"groundtruth.txt: lines left out: 1 repeat the timestamp before (line {len(lines) + 1})"
    assert note in recording.notes
    file.write_text("\n".join([*lines, "1 0 0 0 0 0 0 1"]))
    with pytest.raises(DataError, match=f"groundtruth.txt:{len(lines) + 1}: expected a timestamp after"):
        tum.load(desk)


@pytest.mark.data
@pytest.mark.parametrize(
    "name, repeated", [("fr2_desk_groundtruth.txt", 1), ("freiburg1_xyz-groundtruth.txt", 0)]
)
def test_real_truth(desk, walk, save, data_dir, name, repeated):
    """The published files, with images made at the timestamps of some of their poses."""
    shutil.copy(data_dir / "trajectories" / name, desk / "groundtruth.txt")
    ground_truth = np.loadtxt(desk / "groundtruth.txt")[10::400]
    for kind, pixels in (("rgb", walk.rgb[0]), ("depth", walk.counts[0])):
        for t in ground_truth[:, 0]:
            save(desk / f"{kind}/{t:.6f}.png", pixels)
        write_list(desk / f"{kind}.txt", ground_truth[:, 0], kind)
    recording = tum.load(desk)
    assert any("repeat the timestamp" in note for note in recording.notes) == bool(repeated)
    np.testing.assert_allclose(recording.T_world_cam[:, :3, 3], ground_truth[:, 1:4], atol=1e-12)
    R = Rotation.from_quat(ground_truth[:, 4:]).as_matrix()
    np.testing.assert_allclose(recording.T_world_cam[:, :3, :3], R, atol=1e-9)


FIRST = "rgb/1305031102.000000.png"


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("rgb.txt", None, "rgb.txt: expected lines of a timestamp and a file name, got nothing"),
        ("depth.txt", "# nothing\n", "depth.txt: expected lines of a timestamp and a file name, got none"),
        ("rgb.txt", "# a\n1.5\n", "rgb.txt:2: expected a timestamp in seconds and a file name, got '1.5'"),
        ("rgb.txt", "one rgb/1.png\n", "rgb.txt:1: expected a timestamp in seconds"),
        ("rgb.txt", "nan rgb/1.png\n", "rgb.txt:1: expected a timestamp in seconds"),
        ("rgb.txt", "2 a.png\n2 b.png\n", "rgb.txt:2: expected a timestamp after 2.0 s, got 2.0 s"),
        ("rgb.txt", "2 ../../a.png\n", "rgb.txt: expected a file name that stays in its folder, got"),
        (FIRST, "text", f"{FIRST}: expected an image, got bytes of no kind"),
        ("groundtruth.txt", "1 2 3\n", "groundtruth.txt:1: expected a trajectory, TUM .*got '1 2 3'"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 x\n", "groundtruth.txt:1: expected 8 numbers"),
        ("camera-intrinsics.txt", "1 2 3\n", "intrinsics.txt: expected 3 rows of 3 numbers, got 1 rows"),
    ],
)
def test_unusable_files_are_named(desk, file, content, message):
    (desk / file).unlink() if content is None else (desk / file).write_text(content)
    with pytest.raises(DataError, match=message) as error:
        tum.load(desk)
    assert str(desk) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "pixels, message",
    [
        (np.full((24, 32), 7, np.uint8), "expected depth in 1/5000 m, one channel of 16 bits, got uint8"),
        (np.full((24, 30), 7, np.uint16), "expected 32x24, the size of 1305031102.000000.png, got 30x24"),
    ],
)
def test_depth_of_the_wrong_kind(desk, save, pixels, message):
    file = f"depth/{DEPTH_T[0]:.6f}.png"
    save(desk / file, pixels)
    with pytest.raises(DataError, match=f"{file}: {message}"):
        tum.load(desk)


def test_wrong_folders_and_settings(desk, tmp_path):
    with pytest.raises(DataError, match="nowhere: expected a folder with rgb.txt and depth.txt, got nothing"):
        tum.load(tmp_path / "nowhere")
    with pytest.raises(DataError, match="rgb.txt: expected lines"):
        tum.load(tmp_path)
    with pytest.raises(ValueError, match="max_difference_s: expected a positive number"):
        tum.load(desk, max_difference_s=0.0)
    with pytest.raises(ValueError, match="depth_per_metre: expected a positive number"):
        tum.load(desk, depth_per_metre=-1.0)
