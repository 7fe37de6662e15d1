"""The ScanNet loader on made folders of the exported layout, and on damaged ones."""

import numpy as np
import pytest
from PIL import Image

from jaxpose.datasets.rgbd import scannet
from jaxpose.errors import DataError

NUMBERS = (0, 2, 9, 10, 11, 100)  # in text order 10 and 100 come before 2
INTRINSICS = "30 0 15.5 0\n0 31 11.5 0\n0 0 1 0\n0 0 0 1\n"


def write_scene(folder, frames, walk, save):
    for i, number in enumerate(NUMBERS):
        large = walk.rgb[i].repeat(2, axis=0).repeat(2, axis=1)
        save(frames / f"color/{number}.png", large)
        save(frames / f"depth/{number}.png", walk.counts[i])
        (frames / "pose").mkdir(exist_ok=True)
        np.savetxt(frames / f"pose/{number}.txt", walk.T_world_cam[i])
    (folder / "intrinsic").mkdir()
    (folder / "intrinsic/intrinsic_depth.txt").write_text(INTRINSICS)
    return folder


@pytest.fixture
def scene(tmp_path, walk, save):
    return write_scene(tmp_path / "scene0000_00", tmp_path / "scene0000_00", walk, save)


def test_a_made_scene_reads_back(scene, walk, metres):
    recording = scannet.load(scene, rate_hz=10.0)
    assert [(scene / file).is_file() for file in recording.files] == [True] * len(recording.t)
    assert recording.name.endswith("/scene0000_00") and recording.imu is None
    assert recording.camera == (30, 31, 15.5, 11.5, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.array(NUMBERS) / 10)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-12)
    assert recording.notes == ("colour resized from 64x48 to 32x24, the size of depth",)
    for i in range(6):
        rgb, depth = recording.read(i)
        large = Image.fromarray(walk.rgb[i].repeat(2, axis=0).repeat(2, axis=1))
        np.testing.assert_array_equal(rgb, np.asarray(large.resize((32, 24), Image.Resampling.BILINEAR)))
        np.testing.assert_allclose(depth, metres(walk.counts[i], 1000), rtol=1e-6)


def test_names_with_zeros_before_the_number_keep_their_poses(scene, walk):
    for kind, zeros in (("color", 6), ("depth", 5), ("pose", 4)):
        for file in (scene / kind).iterdir():
            file.rename(file.with_stem(file.stem.zfill(zeros)))
    (scene / "pose/._0000.txt").write_bytes(b"resource fork")
    recording = scannet.load(scene, rate_hz=10.0)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-12)
    np.testing.assert_allclose(recording.t, np.array(NUMBERS) / 10)


def test_a_resized_image_stays_where_it_is(scene, save):
    """An edge at half the width of colour is at half the width of depth."""
    half = np.zeros((48, 64, 3), np.uint8)
    half[:, 32:] = 255
    save(scene / "color/0.png", half)
    rgb = scannet.load(scene).read(0).rgb
    assert rgb.shape == (24, 32, 3)
    assert (rgb[:, :15] == 0).all() and (rgb[:, 17:] == 255).all()
    assert rgb[0, 15, 0] == 255 - rgb[0, 16, 0] < 128


def test_frames_of_its_own_folder(tmp_path, walk, save):
    folder = tmp_path / "scene0000_00"
    recording = scannet.load(write_scene(folder, folder / "frames", walk, save))
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-12)
    assert recording.camera.fx == 30


def test_published_intrinsics_are_assumed_aloud(scene):
    (scene / "intrinsic/intrinsic_depth.txt").unlink()
    recording = scannet.load(scene)
    assert recording.camera[:4] == (577.590698, 578.729797, 318.905426, 242.683609)
    assert recording.notes[1].startswith("no intrinsic/intrinsic_depth.txt: took the published fx fy cx cy")
    assert recording.notes[1].endswith("which are for 640x480; the images are 32x24")


def test_lost_poses_are_missing_truth(scene, walk):
    (scene / "pose/2.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (scene / "pose/10.txt").unlink()
    (scene / "color/100.png").unlink()
    recording = scannet.load(scene)
    np.testing.assert_array_equal(np.isnan(recording.T_world_cam).all((1, 2)), [0, 1, 0, 1, 0])
    np.testing.assert_allclose(recording.T_world_cam[4], walk.T_world_cam[4], atol=1e-12)
    assert recording.notes[0] == "1 frames skipped: 100 has no color"
    assert recording.notes[2] == "2 frames without a usable pose (none, NaN or infinity): 2, 10"


def test_without_poses_there_is_no_truth(scene):
    for file in (scene / "pose").iterdir():
        file.unlink()
    assert scannet.load(scene).T_world_cam is None


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("pose/9.txt", "1 0 0 0\n", "pose/9.txt: expected 4 rows of 4 numbers, got 1 rows"),
        ("pose/9.txt", "a b c d\n", "pose/9.txt:1: expected 4 numbers, got 'a b c d'"),
        ("pose/9.txt", "0 0 0 0\n" * 4, "pose/9.txt: expected a pose.*determinant 0"),
        ("intrinsic/intrinsic_depth.txt", "1 0 0\n", "intrinsic_depth.txt:1: expected 4 numbers, got 3"),
        ("intrinsic/intrinsic_depth.txt", INTRINSICS.replace("30", "0"), "depth.txt: expected fx 0 cx"),
        ("intrinsic/intrinsic_depth.txt", INTRINSICS.replace("15.5", "99"), "centre in 32x24, got 30 0 99 0"),
        ("color/0.png", "text", "color/0.png: expected an image"),
        ("depth/11.png", "text", "depth/11.png: expected an image"),
    ],
)
def test_unusable_files_are_named(scene, file, content, message):
    (scene / file).write_text(content)
    with pytest.raises(DataError, match=message) as error:
        scannet.load(scene)
    assert str(scene) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "number, pixels, message",
    [
        (0, np.full((24, 32), 7, np.uint8), "expected depth in mm, one channel of 16 bits, got uint8"),
        (100, np.full((20, 32), 7, np.uint16), "expected 32x24, the size of 0.png, got 32x20"),
    ],
)
def test_depth_of_the_wrong_kind(scene, save, number, pixels, message):
    save(scene / f"depth/{number}.png", pixels)
    with pytest.raises(DataError, match=f"depth/{number}.png: {message}"):
        scannet.load(scene)


def test_wrong_folders(scene, tmp_path):
    for path, got in [(tmp_path / "nowhere", "nothing"), (tmp_path, "scene0000_00")]:
        with pytest.raises(DataError, match=f"{path}: expected color/N.jpg, depth/N.png and .*got {got}$"):
            scannet.load(path)
    for file in (scene / "depth").iterdir():
        file.rename(file.with_stem(f"frame{file.stem}"))
    with pytest.raises(DataError, match="depth: expected color/N.jpg, .* got frame0.png, "):
        scannet.load(scene)
