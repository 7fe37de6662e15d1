"""The loader of a plain folder of colour and depth images, on made folders and damaged ones."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd import plain
from jaxpose.datasets.rgbd.registry import load_recording
from jaxpose.errors import DataError

K = "30 0 15.5\n0 31 11.5\n0 0 1\n"
TIMES = np.array([10.0, 10.1, 10.25, 10.3, 10.4, 10.55])


@pytest.fixture
def desk(tmp_path, walk, save):
    """Six pairs of equal names, r_9 and r_10 among them, and nothing else but intrinsics."""
    folder = tmp_path / "home" / "desk"
    for i in range(6):
        save(folder / f"color/r_{i + 6}.png", walk.rgb[i])
        save(folder / f"depth/r_{i + 6}.png", walk.counts[i])
    (folder / "camera-intrinsics.txt").write_text(K)
    return folder


def write_poses(folder, walk, kind):
    rows = {
        "matrix": [pose.ravel() for pose in walk.T_world_cam],
        "kitti": [pose[:3].ravel() for pose in walk.T_world_cam],
        "tum": [
            [t, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
            for t, pose in zip(TIMES, walk.T_world_cam, strict=True)
        ],
    }[kind]
    (folder / "poses.txt").write_text("".join(" ".join(f"{x:.17g}" for x in row) + "\n" for row in rows))


def test_images_read_back_in_order(desk, walk, metres):
    recording = plain.load(desk, rate_hz=10.0)
    assert np.array_equal(np.asarray(Image.open(desk / recording.files[1])), recording.read(1).rgb)
    assert recording.name == "home/desk" and recording.T_world_cam is None and recording.imu is None
    assert recording.camera == (30, 31, 15.5, 11.5, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.arange(6) / 10)
    assert recording.notes == (
        "no depth_scale: took depth as mm",
        "no poses.txt: there is no ground truth to compare with",
    )
    for i in range(6):
        rgb, depth = recording.read(i)
        np.testing.assert_array_equal(rgb, walk.rgb[i])
        np.testing.assert_allclose(depth, metres(walk.counts[i], 1000), rtol=1e-6)


@pytest.mark.parametrize("kind", ["matrix", "kitti", "tum"])
@pytest.mark.parametrize("stamped", [False, True])
def test_poses_in_three_forms(desk, walk, kind, stamped):
    write_poses(desk, walk, kind)
    if stamped:
        np.savetxt(desk / "times.txt", TIMES)
    recording = plain.load(desk, rate_hz=10.0)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-12)
    known = stamped or kind == "tum"
    np.testing.assert_allclose(recording.t, TIMES - TIMES[0] if known else np.arange(6) / 10, atol=1e-12)


def test_tum_poses_go_by_their_stamps(desk, walk):
    write_poses(desk, walk, "tum")
    np.savetxt(desk / "times.txt", TIMES + [0, 0.015, -0.015, 0.025, 0, 0])
    recording = plain.load(desk)
    np.testing.assert_array_equal(np.isnan(recording.T_world_cam).all((1, 2)), [0, 0, 0, 1, 0, 0])
    np.testing.assert_allclose(recording.T_world_cam[2], walk.T_world_cam[2], atol=1e-12)
    assert recording.notes[-1].endswith("(none, NaN or infinity): r_9")
    # Of two lines with one timestamp, as published ground truth has them, the first counts.
    lines = (desk / "poses.txt").read_text().splitlines()
    again = f"{lines[1].split()[0]} 9 9 9 0 0 0 1"
    (desk / "poses.txt").write_text("\n".join([*lines[:2], again, *lines[2:]]))
    np.testing.assert_array_equal(plain.load(desk).T_world_cam, recording.T_world_cam)


def test_a_pose_of_nan_is_missing_truth(desk, walk):
    write_poses(desk, walk, "matrix")
    lines = (desk / "poses.txt").read_text().splitlines()
    lines[3] = " ".join(["nan"] * 16)
    (desk / "poses.txt").write_text("\n".join(lines))
    np.testing.assert_array_equal(np.isnan(plain.load(desk).T_world_cam).all((1, 2)), [0, 0, 0, 1, 0, 0])


def test_images_without_a_partner_are_left_out_with_their_line(desk, walk):
    write_poses(desk, walk, "matrix")
    np.savetxt(desk / "times.txt", TIMES)
    (desk / "depth/r_6.png").unlink()
    (desk / "depth/r_9.png").unlink()
    recording = plain.load(desk)
    used = [1, 2, 4, 5]
    np.testing.assert_allclose(recording.t, TIMES[used] - TIMES[1])
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam[used], atol=1e-12)
    np.testing.assert_array_equal(recording.read(2).rgb, walk.rgb[4])
    assert recording.notes[0] == "2 images without a partner left out: r_6, r_9"


def test_other_names_pair_in_order(desk, walk):
    for file in sorted((desk / "depth").iterdir()):
        file.rename(file.with_stem(file.stem.replace("r_", "depth")))
    recording = plain.load(desk)
    np.testing.assert_allclose(recording.read(4).depth[1:], walk.counts[4][1:] / 1000, rtol=1e-6)
    assert recording.notes[0] == "colour and depth paired in order: r_6.png with depth6.png and so on"
    (desk / "depth/depth7.png").unlink()
    with pytest.raises(
        DataError, match="desk: expected .* equal number, got 6 as r_6.png and 5 as depth6.png"
    ):
        plain.load(desk)


def write_json(folder, **values):
    (folder / "camera-intrinsics.txt").unlink()
    (folder / "intrinsics.json").write_text(json.dumps(values))


CAMERA = {"fx": 40, "fy": 41, "cx": 15, "cy": 11}


def test_intrinsics_in_json(desk, walk, metres):
    write_json(desk, **CAMERA, width=32, height=24, depth_scale=4000)
    (desk / "intrinsics.json").rename(desk.parent / "intrinsics.json")  # one folder up
    recording = plain.load(desk)
    assert recording.camera == (40, 41, 15, 11, 32, 24, ())
    np.testing.assert_allclose(recording.read(0).depth, metres(walk.counts[0], 4000), rtol=1e-6)
    depth = plain.load(desk, depth_per_metre=2000.0).read(0).depth  # what the caller says comes first
    np.testing.assert_allclose(depth, metres(walk.counts[0], 2000), rtol=1e-6)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"fx": 40}, "intrinsics.json: fy: expected a finite number, got no such entry"),
        (CAMERA | {"fx": "wide"}, "intrinsics.json: fx: expected a finite number, got 'wide'"),
        (CAMERA | {"fx": -1}, "intrinsics.json: expected fx 0 cx"),
        (CAMERA | {"width": 64}, "intrinsics.json: expected the size of the images, 32x24, got 64x24"),
        (CAMERA | {"depth_scale": 0}, "intrinsics.json: depth_scale: expected a finite number above 0"),
    ],
)
def test_unusable_json_is_named(desk, values, message):
    write_json(desk, **values)
    with pytest.raises(DataError, match=f"desk/{message}"):
        plain.load(desk)


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("times.txt", "1\n2\n", "times.txt: expected 6 lines, one for each colour image, got 2"),
        (
            "times.txt",
            "1\n2\n3\n3\n4\n5\n",
            "times.txt:4: expected a timestamp after that before, got a repeated one",
        ),
        ("times.txt", "1\ntwo\n", "times.txt:2: expected a line that begins with a timestamp"),
        (
            "poses.txt",
            "1 2 3\n",
            r"poses.txt:1: expected 16 \(4x4\), 12 \(KITTI\) or 8 \(TUM\) numbers, got 3",
        ),
        ("poses.txt", "# none\n", "poses.txt: expected lines of 16"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "poses.txt: expected 6 lines, .*, got 1"),
        ("poses.txt", "1 0 0 0 0 0 0 1\n", "poses.txt: expected 6 lines, .*, got 1"),
        ("poses.txt", "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 6, "poses.txt: pose 0: expected a pose"),
        ("camera-intrinsics.txt", None, "desk: expected one of camera-intrinsics.txt, intrinsics.json,"),
        ("camera-intrinsics.txt", "30 31 15 11\n", "intrinsics.txt:1: expected 3 numbers, got 4"),
        ("color/r_6.png", "text", "color/r_6.png: expected an image"),
    ],
)
def test_unusable_files_are_named(desk, file, content, message):
    (desk / file).unlink() if content is None else (desk / file).write_text(content)
    with pytest.raises(DataError, match=message) as error:
        plain.load(desk)
    assert str(desk) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "pixels, message",
    [
        (np.full((24, 32), 7, np.uint8), "expected depth in mm, one channel of 16 bits, got uint8"),
        (np.full((20, 32), 7, np.uint16), "expected 32x24, the size of r_6.png, got 32x20"),
    ],
)
def test_depth_of_the_wrong_kind(desk, save, pixels, message):
    save(desk / "depth/r_6.png", pixels)
    with pytest.raises(DataError, match=f"depth/r_6.png: {message}"):
        plain.load(desk)


def test_colour_of_16_bits_is_refused(desk, walk, save):
    save(desk / "color/r_6.png", walk.counts[0])
    with pytest.raises(DataError, match="color/r_6.png: expected an image, got pixels of kind I;16"):
        plain.load(desk)


def test_wrong_folders(desk, tmp_path):
    for path, got in [(tmp_path / "nowhere", "nothing"), (tmp_path, "home")]:
        with pytest.raises(DataError, match=f"{path}: expected folders color/ and depth/, got {got}$"):
            plain.load(path)
    for file in (desk / "depth").iterdir():
        file.unlink()
    with pytest.raises(DataError, match="depth: expected images, got an empty folder"):
        plain.load(desk)
    with pytest.raises(ValueError, match="depth_per_metre"):
        plain.load(desk, depth_per_metre=0.0)


# --- captures of other programs in the same folders ---------------------------------------------------------


def test_a_capture_of_open3d(tmp_path, walk, save, metres):
    """Colour is jpg of 6 digits, the matrix is written column by column, poses are in blocks of 5 lines."""
    for i in range(6):
        save(tmp_path / f"color/{i:06d}.png", walk.rgb[i])
        save(tmp_path / f"depth/{i:05d}.png", walk.counts[i])
    matrix = [30.0, 0, 0, 0, 31.0, 0, 15.0, 11.0, 1]
    (tmp_path / "camera_intrinsic.json").write_text(
        json.dumps({"width": 32, "height": 24, "intrinsic_matrix": matrix, "depth_scale": 4000.0})
    )
    (tmp_path / "scene").mkdir()
    blocks = [
        f"{i} {i} {i + 1}\n" + "\n".join(" ".join(f"{x:.12g}" for x in row) for row in walk.T_world_cam[i])
        for i in (0, 1, 2, 4, 5)
    ]
    (tmp_path / "scene/trajectory.log").write_text("\n".join(blocks) + "\n")
    recording = load_recording(tmp_path)
    assert recording.camera == (30, 31, 15, 11, 32, 24, ())
    np.testing.assert_allclose(recording.read(4).depth, metres(walk.counts[4], 4000), rtol=1e-6)
    np.testing.assert_allclose(recording.T_world_cam[[0, 5]], walk.T_world_cam[[0, 5]], atol=1e-9)
    assert np.isnan(recording.T_world_cam[3]).all()
    (tmp_path / "scene/trajectory.log").write_text(blocks[0][:40])
    with pytest.raises(
        DataError, match="trajectory.log:1: expected a line of three numbers and four of a 4x4"
    ):
        load_recording(tmp_path)


def test_depth_smaller_than_colour_and_other_names_of_folders(tmp_path, walk, save):
    for i in range(6):
        save(tmp_path / f"image/{i}.png", np.repeat(np.repeat(walk.rgb[i], 2, 0), 2, 1))
        save(tmp_path / f"depth/{i}.png", walk.counts[i])
        (tmp_path / f"image/._{i}.png").write_bytes(b"resource fork")
    (tmp_path / "camera-intrinsics.txt").write_text("60 0 30.5\n0 62 22.5\n0 0 1\n")
    recording = load_recording(tmp_path)
    assert recording.camera == (30, 31, 15, 11, 32, 24, ())
    large = Image.fromarray(np.repeat(np.repeat(walk.rgb[2], 2, 0), 2, 1))
    np.testing.assert_array_equal(recording.read(2).rgb, large.resize((32, 24), Image.Resampling.BILINEAR))
    assert "colour resized from 64x48 to 32x24, the size of depth" in recording.notes


def test_a_depth_scale_that_is_upside_down_is_refused(tmp_path, walk, save):
    save(tmp_path / "color/0.png", walk.rgb[0])
    save(tmp_path / "depth/0.png", walk.counts[0])
    (tmp_path / "intrinsics.json").write_text(json.dumps(CAMERA | {"depth_scale": 0.001}))
    with pytest.raises(DataError, match="depth_scale: expected counts a metre, got 0.001"):
        load_recording(tmp_path)
