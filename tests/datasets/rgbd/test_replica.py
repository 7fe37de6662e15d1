"""The Replica loader on made folders of NICE-SLAM's layout, and on damaged ones."""

import json

import numpy as np
import pytest

from jaxpose.datasets.rgbd import replica
from jaxpose.errors import DataError

CAMERA = {"w": 32, "h": 24, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "scale": 5000.0}


@pytest.fixture
def room0(tmp_path, walk, save):
    """A scene of six frames, colour as png in jpg's place so that it reads back exactly."""
    folder = tmp_path / "Replica" / "room0"
    for i in range(6):
        save(folder / f"results/frame{i:06d}.png", walk.rgb[i])
        save(folder / f"results/depth{i:06d}.png", walk.counts[i])
    rows = [" ".join(f"{x:.18e}" for x in pose.ravel()) for pose in walk.T_world_cam]
    (folder / "traj.txt").write_text("\n".join(rows) + "\n")
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    return folder


def test_a_made_scene_reads_back(room0, walk, metres):
    recording = replica.load(room0, rate_hz=20.0)
    assert [(room0 / file).is_file() for file in recording.files] == [True] * len(recording.t)
    assert recording.name == "Replica/room0" and recording.notes == () and recording.imu is None
    assert recording.camera == (30, 31, 15.5, 11.5, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.arange(6) / 20)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-12)
    for i in range(6):
        rgb, depth = recording.read(i)
        np.testing.assert_array_equal(rgb, walk.rgb[i])
        np.testing.assert_allclose(depth, metres(walk.counts[i], 5000), rtol=1e-6)


def test_published_camera_is_assumed_aloud(room0, walk, metres, save):
    (room0.parent / "cam_params.json").unlink()
    recording = replica.load(room0)
    assert recording.camera[:4] == (600, 600, 599.5, 339.5)
    assert "600 600 599.5 339.5, which are for 1200x680; the images are 32x24" in recording.notes[0]
    np.testing.assert_allclose(recording.read(2).depth, metres(walk.counts[2], 6553.5), rtol=1e-6)


def test_axes_are_right_down_forward(tmp_path, save):
    """A wall seen straight on and from the side: NICE-SLAM's pose files put its points at one place."""
    u, v = np.meshgrid(np.arange(32), np.arange(24))
    turn = np.deg2rad(20)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    T[1, :3, 3] = [-0.3, 0.1, 0.2]
    for i in range(2):
        ray = np.stack([(u - 15.5) / 30, (v - 11.5) / 31, np.ones_like(u)], axis=-1) @ T[i, :3, :3].T
        depth = (3.0 - T[i, 2, 3]) / ray[..., 2]  # of the plane z = 3
        save(tmp_path / f"results/depth{i:06d}.png", np.round(depth * 5000).astype(np.uint16))
        save(tmp_path / f"results/frame{i:06d}.jpg", np.zeros((24, 32, 3), np.uint8))
    np.savetxt(tmp_path / "traj.txt", T.reshape(2, 16))
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    recording = replica.load(tmp_path)
    camera = recording.camera
    for i in range(2):
        depth = recording.read(i).depth
        point = np.stack(
            [(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth], -1
        )
        world = point @ recording.T_world_cam[i, :3, :3].T + recording.T_world_cam[i, :3, 3]
        np.testing.assert_allclose(world[..., 2], 3, atol=3e-4)


def test_frames_and_poses_that_are_missing(room0, walk):
    (room0 / "results/frame000001.png").unlink()
    (room0 / "results/depth000003.png").unlink()
    lines = (room0 / "traj.txt").read_text().splitlines()
    lines[2] = " ".join(["nan"] * 16)
    (room0 / "traj.txt").write_text("\n".join(lines[:5]))
    recording = replica.load(room0)
    np.testing.assert_allclose(recording.t, np.array([0, 2, 4, 5]) / 30)
    np.testing.assert_array_equal(np.isnan(recording.T_world_cam).all((1, 2)), [0, 1, 0, 1])
    np.testing.assert_allclose(recording.T_world_cam[2], walk.T_world_cam[4], atol=1e-12)
    np.testing.assert_array_equal(recording.read(2).rgb, walk.rgb[4])
    assert recording.notes == (
        "2 frames skipped: 1 has no color, 3 has no depth",
        "2 frames without a usable pose (none, NaN or infinity): 000002, 000005",
    )
    (room0 / "traj.txt").unlink()
    recording = replica.load(room0)
    assert recording.T_world_cam is None and "no traj.txt" in recording.notes[1]


def camera(**values):
    return json.dumps({"camera": {key: x for key, x in (CAMERA | values).items() if x is not None}})


PARAMETERS = "../cam_params.json"


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("traj.txt", "1 2 3\n", r"traj.txt:1: expected 16 numbers \(a 4x4 pose, row by row\), got 3"),
        ("traj.txt", "1 " * 15 + "x\n", "traj.txt:1: expected 16 numbers"),
        ("traj.txt", "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n", "traj.txt:1: expected a pose.*determinant -1"),
        (PARAMETERS, "{", "cam_params.json:1: expected the camera, got Expecting property name"),
        (PARAMETERS, "[]", "cam_params.json: expected the camera, got no JSON object"),
        (PARAMETERS, camera(fx=None), "cam_params.json: fx: expected a finite number, got no such entry"),
        (PARAMETERS, camera(fx="wide"), "cam_params.json: fx: expected a finite number, got 'wide'"),
        (PARAMETERS, camera(fx=0), "cam_params.json: expected fx 0 cx"),
        (PARAMETERS, camera(w=40), "cam_params.json: expected the size of the images, 32x24, got 40x24"),
        (PARAMETERS, camera(scale=0), "cam_params.json: scale: expected a finite number above 0, got 0"),
        ("results/frame000002.png", "text", "frame000002.png: expected an image"),
    ],
)
def test_unusable_files_are_named(room0, file, content, message):
    (room0 / file).write_text(content)
    with pytest.raises(DataError, match=message) as error:
        replica.load(room0)
    assert str(room0.parent) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "pixels, message",
    [
        (np.full((24, 32), 7, np.uint8), "expected depth in 1/5000 m, one channel of 16 bits, got uint8"),
        (np.full((20, 32), 7, np.uint16), "expected 32x24, the size of frame000000.png, got 32x20"),
    ],
)
def test_depth_of_the_wrong_kind(room0, save, pixels, message):
    save(room0 / "results/depth000000.png", pixels)
    with pytest.raises(DataError, match=f"depth000000.png: {message}"):
        replica.load(room0)


def test_wrong_folders(room0, tmp_path):
    for path, got in [(tmp_path / "nowhere", "nothing"), (room0 / "results", "depth000000.png, ")]:
        with pytest.raises(
            DataError, match=f"{path}: expected a folder of results/frameNNNNNN.jpg.*got {got}"
        ):
            replica.load(path)
    for file in room0.glob("results/depth*"):
        file.unlink()
    with pytest.raises(
        DataError, match="room0: expected results/frame.*, got 0 has no depth, 1 has no depth"
    ):
        replica.load(room0)


def test_a_rate_must_be_positive(room0):
    with pytest.raises(ValueError, match="rate_hz: expected a positive rate, got 0"):
        replica.load(room0, rate_hz=0.0)
