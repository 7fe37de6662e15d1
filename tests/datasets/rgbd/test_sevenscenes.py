"""The 7-Scenes loader on made folders of the exact layout, on damaged ones, and on the real clip."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd import sevenscenes
from jaxpose.errors import DataError

SIZE = (64, 48)  # width, height
K = "50 0 31.5\n0 52 23.5\n0 0 1\n"


def color_of(number, size=SIZE):
    return np.random.default_rng(number).integers(0, 256, (size[1], size[0], 3), np.uint8)


def depth_of(number, size=SIZE):
    depth = np.random.default_rng(1000 + number).integers(400, 5000, (size[1], size[0])).astype(np.uint16)
    depth[0, :3] = [0, 65535, 1234]
    return depth


def pose_of(number):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.1 * number, -0.2, 0.3]).as_matrix()
    T[:3, 3] = [number, 1, 2]
    return T


def write_frame(folder, number, *, suffix="png", size=SIZE):
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"frame-{number:06d}"
    Image.fromarray(color_of(number, size)).save(folder / f"{stem}.color.{suffix}")
    Image.fromarray(depth_of(number, size)).save(folder / f"{stem}.depth.png")
    np.savetxt(folder / f"{stem}.pose.txt", pose_of(number), delimiter="\t", fmt="%.7e")


@pytest.fixture
def scene(tmp_path):
    """A scene with one sequence of five frames, number 3 missing, and intrinsics beside the sequence."""
    for number in (0, 1, 2, 4, 5):
        write_frame(tmp_path / "kitchen" / "seq-01", number)
    (tmp_path / "kitchen" / "camera-intrinsics.txt").write_text(K)
    return tmp_path / "kitchen"


def test_a_made_sequence_reads_back(scene):
    recording = sevenscenes.load(scene / "seq-01", rate_hz=10.0)
    assert recording.name == "kitchen/seq-01"
    assert recording.camera == (50, 52, 31.5, 23.5, 64, 48, ())
    np.testing.assert_allclose(recording.t, [0, 0.1, 0.2, 0.4, 0.5])
    assert recording.imu is None and recording.notes == ()
    for row, number in enumerate((0, 1, 2, 4, 5)):
        rgb, depth = recording.read(row)
        np.testing.assert_array_equal(rgb, color_of(number))
        np.testing.assert_allclose(depth[1:], depth_of(number)[1:] / 1000, rtol=1e-7)
        np.testing.assert_array_equal(depth[0, :3], np.array([0, 0, 1.234], np.float32))
        assert (rgb.dtype, depth.dtype) == (np.uint8, np.float32)
        np.testing.assert_allclose(recording.T_world_cam[row], pose_of(number), atol=1e-6)


def test_rotations_are_orthonormal_in_double_precision(scene):
    R = sevenscenes.load(scene).T_world_cam[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)


def test_the_scene_folder_stands_for_its_only_sequence(scene, monkeypatch):
    assert len(sevenscenes.load(scene).t) == 5
    monkeypatch.chdir(scene / "seq-01")
    recording = sevenscenes.load(".")
    assert recording.name == "kitchen/seq-01" and recording.camera.fx == 50


def test_first_number_is_time_zero(tmp_path):
    for number in (7, 9):
        write_frame(tmp_path, number)
    np.testing.assert_allclose(sevenscenes.load(tmp_path).t, [0, 2 / 30])


def test_jpg_colour_and_png_before_jpg(scene):
    write_frame(scene / "seq-01", 6, suffix="jpg")
    Image.fromarray(color_of(99)).save(scene / "seq-01" / "frame-000005.color.jpg")
    recording = sevenscenes.load(scene)
    assert np.abs(recording.read(5).rgb.mean() - color_of(6).mean()) < 3
    np.testing.assert_array_equal(recording.read(4).rgb, color_of(5))


def test_intrinsics_in_the_sequence_come_before_those_beside_it(scene):
    (scene / "seq-01" / "camera-intrinsics.txt").write_text(K.replace("50", "40"))
    assert sevenscenes.load(scene).camera.fx == 40


def test_published_intrinsics_are_assumed_aloud(tmp_path):
    write_frame(tmp_path / "large", 0, size=(640, 480))
    write_frame(tmp_path / "small", 0)
    large, small = sevenscenes.load(tmp_path / "large"), sevenscenes.load(tmp_path / "small")
    assert large.camera[:4] == small.camera[:4] == (585, 585, 320, 240)
    assert large.notes == ("no camera-intrinsics.txt: took the published fx fy cx cy = 585 585 320 240",)
    assert small.notes[0].endswith("which are for 640x480; the images are 64x48")


def test_bundlefusion_has_its_own_camera_and_scale(tmp_path):
    """The lines of `info.txt` of graphics.stanford.edu/projects/bundlefusion."""
    for number in range(2):
        write_frame(tmp_path, number, suffix="jpg")
    one = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    K = "50 0 31.5 0 0 52 23.5 0 0 0 1 0 0 0 0 1"
    (tmp_path / "info.txt").write_text(
        "m_versionNumber = 4\nm_sensorName = StructureSensor\nm_colorWidth = 64\nm_colorHeight = 48\n"
        f"m_depthWidth = 64\nm_depthHeight = 48\nm_depthShift = 2000\nm_calibrationColorIntrinsic = {K}\n"
        f"m_calibrationColorExtrinsic = {one}\nm_calibrationDepthIntrinsic = {K} \nm_frames.size = 2\n"
    )
    recording = sevenscenes.load(tmp_path)
    assert recording.camera == (50, 52, 31.5, 23.5, 64, 48, ()) and recording.notes == ()
    np.testing.assert_allclose(recording.read(1).depth[1:], depth_of(1)[1:] / 2000, rtol=1e-7)
    (tmp_path / "info.txt").write_text("m_depthShift = 1000\n")
    with pytest.raises(DataError, match="info.txt: expected m_calibrationDepthIntrinsic, m_depthWidth"):
        sevenscenes.load(tmp_path)


# --- what is skipped or repaired, and told ------------------------------------------------------------------


def test_incomplete_frames_are_skipped_aloud(scene):
    (scene / "seq-01" / "frame-000001.depth.png").unlink()
    (scene / "seq-01" / "frame-000004.color.png").unlink()
    recording = sevenscenes.load(scene)
    assert recording.notes == ("2 frames skipped: 1 has no depth, 4 has no color",)
    np.testing.assert_allclose(recording.t, [0, 2 / 30, 5 / 30])
    np.testing.assert_array_equal(recording.read(2).rgb, color_of(5))
    np.testing.assert_allclose(recording.T_world_cam[:, 0, 3], [0, 2, 5])


def test_a_sequence_without_poses_has_no_truth(scene):
    for file in (scene / "seq-01").glob("*.pose.txt"):
        file.unlink()
    recording = sevenscenes.load(scene)
    assert recording.T_world_cam is None and "no usable poses" in recording.notes[0]


def test_poses_that_are_not_finite_are_missing_truth(scene):
    write_pose = lambda number, text: (scene / "seq-01" / f"frame-{number:06d}.pose.txt").write_text(text)
    write_pose(1, "nan nan nan nan\n" * 4)
    write_pose(4, "1 0 0 -inf\n0 1 0 inf\n0 0 1 0\n0 0 0 1\n")
    (scene / "seq-01" / "frame-000005.pose.txt").unlink()
    recording = sevenscenes.load(scene)
    assert len(recording.t) == 5
    np.testing.assert_array_equal(np.isnan(recording.T_world_cam).all((1, 2)), [0, 1, 0, 1, 1])
    assert np.isfinite(recording.T_world_cam[[0, 2]]).all()
    assert recording.notes == (
        "3 frames without a usable pose (none, NaN or infinity): 000001, 000004, 000005",
    )


@pytest.mark.parametrize("stretch, told", [(1.009, False), (1.011, True)])
def test_poses_off_a_rotation_are_projected(scene, stretch, told):
    np.savetxt(scene / "seq-01" / "frame-000001.pose.txt", np.diag([stretch, 1, 1, 1]))
    recording = sevenscenes.load(scene)
    np.testing.assert_allclose(recording.T_world_cam[1], np.eye(4), atol=1e-15)
    note = "1 poses were more than 0.01 off a rotation, made orthonormal: 000001"
    assert recording.notes == ((note,) if told else ())


# --- what cannot be used ------------------------------------------------------------------------------------


def spoil_depth(scene, number, depth):
    Image.fromarray(depth).save(scene / "seq-01" / f"frame-{number:06d}.depth.png")


def fill_depth(scene):
    for number in (0, 1, 2, 4, 5):
        spoil_depth(scene, number, np.full((48, 64), 65535 * (number % 2), np.uint16))


def write(name, text):
    return lambda scene: (scene / name).write_text(text)


IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
POSE = "seq-01/frame-000002.pose.txt"


@pytest.mark.parametrize(
    "spoil, message",
    [
        (
            lambda s: spoil_depth(s, 2, depth_of(2)[:, :60]),
            "2.depth.png: expected 64x48, the size of .*, got 60x48",
        ),
        (
            lambda s: spoil_depth(s, 0, depth_of(0)[:40]),
            "0.depth.png: expected 64x48, the size of frame-000000.c",
        ),
        (lambda s: write_frame(s / "seq-01", 1, size=(60, 48)), "1.color.png: expected 64x48, .*, got 60x48"),
        (
            lambda s: spoil_depth(s, 0, np.full((48, 64), 9, np.uint8)),
            "0.depth.png: expected depth in mm, one channel",
        ),
        (
            fill_depth,
            r"seq-01: expected depth in mm, got only 0 and 65535 \(none\) in frame-000000.depth.png, ",
        ),
        (
            write("seq-01/frame-000004.color.png", "no image"),
            "4.color.png: expected an image, got bytes of no kind",
        ),
        (write("seq-01/frame-000000.depth.png", ""), "0.depth.png: expected an image, got "),
        (write("camera-intrinsics.txt", "585 585 320 240\n"), "intrinsics.txt:1: expected 3 numbers, got 4"),
        (
            write("camera-intrinsics.txt", K.replace("31.5", "x")),
            "intrinsics.txt:1: expected 3 numbers, got '50 0 x'",
        ),
        (write("camera-intrinsics.txt", K[:20]), "intrinsics.txt: expected 3 rows of 3 numbers, got 2 rows"),
        (
            write("camera-intrinsics.txt", K.replace("50", "0")),
            "expected fx 0 cx / .*, got 0 0 31.5 / 0 52 23.5",
        ),
        (write("camera-intrinsics.txt", K.replace("31.5", "320")), "with the centre in 64x48, got 50 0 320"),
        (write("camera-intrinsics.txt", K.replace("50", "nan")), "expected fx 0 cx"),
        (write(POSE, IDENTITY[:16]), "2.pose.txt: expected 4 rows of 4 numbers, got 2 rows"),
        (write(POSE, IDENTITY.replace("0 0 0 1", "0 0 0")), "2.pose.txt:4: expected 4 numbers, got 3"),
        (write(POSE, "a b c d\n" + IDENTITY), "2.pose.txt:1: expected 4 numbers, got 'a b c d'"),
        (write(POSE, IDENTITY.replace("1 0 0 0", "-1 0 0 0")), "2.pose.txt: expected a pose.*determinant -1"),
        (write(POSE, "0 0 0 0\n" * 4), "2.pose.txt: expected a pose.*determinant 0 and 0 0 0 0"),
        (write(POSE, IDENTITY.replace("0 0 0 1", "0 0 9 1")), "2.pose.txt: expected a pose.* and 0 0 9 1"),
    ],
)
def test_unusable_files_are_named(scene, spoil, message):
    spoil(scene)
    with pytest.raises(DataError, match=message) as error:
        sevenscenes.load(scene)
    assert str(scene) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_an_image_damaged_in_its_pixels_is_named_when_read(scene, kind):
    file = scene / "seq-01" / f"frame-000001.{kind}.png"
    file.write_bytes(file.read_bytes()[:-400])
    recording = sevenscenes.load(scene)
    recording.read(0)
    with pytest.raises(DataError, match=f"frame-000001.{kind}.png: expected an image, got "):
        recording.read(1)


def test_a_first_image_damaged_in_its_pixels_is_named_at_once(scene):
    file = scene / "seq-01" / "frame-000000.color.png"
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.raises(DataError, match="frame-000000.color.png: expected an image, got "):
        sevenscenes.load(scene)


def test_a_folder_without_a_sequence_is_refused(scene, tmp_path):
    for path, found in [
        (tmp_path / "nowhere", "got nothing"),
        (scene / "camera-intrinsics.txt", "got a file"),
        (tmp_path, "got kitchen$"),
    ]:
        with pytest.raises(DataError, match=f"{path}: expected .*frame-NNNNNN.*{found}"):
            sevenscenes.load(path)
    (scene / "seq-02").mkdir()
    with pytest.raises(DataError, match="got 2 sequences, name one of them: seq-01, seq-02"):
        sevenscenes.load(scene)
    with pytest.raises(DataError, match="seq-02: expected .*got an empty folder"):
        sevenscenes.load(scene / "seq-02")


def test_only_incomplete_frames_are_no_frames(scene):
    for file in (scene / "seq-01").glob("*.depth.png"):
        file.unlink()
    with pytest.raises(DataError, match="seq-01: expected .*, got 0 has no depth, 1 has no depth"):
        sevenscenes.load(scene)


@pytest.mark.parametrize("rate_hz", [0.0, -30.0, float("nan")])
def test_a_rate_must_be_positive(scene, rate_hz):
    with pytest.raises(ValueError, match="rate_hz: expected a positive rate"):
        sevenscenes.load(scene, rate_hz=rate_hz)


# --- the real clip ------------------------------------------------------------------------------------------


@pytest.mark.data
def test_the_real_clip(data_dir):
    """400 frames; poses orthonormal after loading and as the file says, one jump of 36 mm from 121 to 122."""
    recording = sevenscenes.load(data_dir / "7scenes_redkitchen")
    T, notes = recording.T_world_cam, recording.notes
    assert recording.camera == (585, 585, 320, 240, 640, 480, ())
    assert notes == ()
    np.testing.assert_allclose(recording.t, np.arange(400) / 30)
    first = np.loadtxt(data_dir / "7scenes_redkitchen/seq-01/frame-000000.pose.txt")
    np.testing.assert_allclose(T[0], first, atol=1e-3)
    np.testing.assert_allclose(T[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2) - np.eye(3), 0, atol=1e-14)
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    assert step.argmax() == 121 and step.max() == pytest.approx(0.036, abs=1e-3)
    rgb, depth = recording.read(399)
    assert (rgb.shape, depth.shape) == ((480, 640, 3), (480, 640))
    assert 0.3 < depth[depth > 0].min() and depth.max() < 10
    assert recording.name == "7scenes_redkitchen/seq-01"
