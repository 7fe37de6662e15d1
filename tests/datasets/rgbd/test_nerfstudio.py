"""A folder of nerfstudio's with depth, written here, read back."""

import json

import numpy as np
import pytest

from jaxpose.cli.check.command import Config, run
from jaxpose.datasets.rgbd import nerfstudio
from jaxpose.datasets.rgbd.registry import find_format, has_timestamps, load_recording
from jaxpose.errors import DataError

FLIP = np.diag([1.0, -1, -1, 1])
CAMERA = {"fl_x": 30.0, "fl_y": 31.0, "cx": 15.5, "cy": 11.5, "w": 32, "h": 24, "camera_model": "OPENCV"}
LENS = {"k1": 0.1, "k2": -0.05, "p1": 0.001, "p2": 0.002}


def write(folder, walk, save, *, header=None, frame=lambda k: {}, depth="png"):
    frames = []
    for k in range(6):
        save(folder / f"images/frame_{k:05d}.png", walk.rgb[k])
        if depth == "png":
            save(folder / f"depth/{k}.png", walk.counts[k])
        else:
            (folder / "depth").mkdir(exist_ok=True)
            np.save(folder / f"depth/{k}.npy", np.where(walk.counts[k] == 65535, 0, walk.counts[k]) / 1000)
        pose = (walk.T_world_cam[k] @ FLIP).tolist()
        names = {"file_path": f"images/frame_{k:05d}.png", "depth_file_path": f"depth/{k}.{depth}"}
        frames.append({**names, "transform_matrix": pose, **frame(k)})
    content = {**CAMERA, **(header or {}), "frames": frames[::-1]}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_a_folder_reads_back(tmp_path, walk, save, metres):
    folder = write(tmp_path, walk, save, header=LENS)
    assert find_format(folder) == "nerfstudio" and not has_timestamps(folder, "nerfstudio")
    recording = load_recording(folder, rate_hz=10.0)
    assert recording.camera == (30, 31, 15, 11, 32, 24, (0.1, -0.05, 0.001, 0.002, 0))
    np.testing.assert_allclose(recording.t, np.arange(6) / 10)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-12)
    for k in (0, 5):
        np.testing.assert_array_equal(recording.read(k).rgb, walk.rgb[k])
        np.testing.assert_allclose(recording.read(k).depth, metres(walk.counts[k], 1000), rtol=1e-6)
    assert run(Config(folder)).format == "RGB-D recording (nerfstudio)"


def test_times_arrays_and_missing_frames(tmp_path, walk, save, metres):
    folder = write(tmp_path, walk, save, frame=lambda k: {"timestamp": 5.0 - k / 4}, depth="npy")
    (folder / "images/frame_00004.png").unlink()
    (folder / "images/frame_00001.png").rename(folder / "images/FRAME_00001.PNG")
    assert has_timestamps(folder, "nerfstudio")
    recording = nerfstudio.load(folder)
    np.testing.assert_allclose(recording.t, [0, 0.5, 0.75, 1.0, 1.25])
    np.testing.assert_array_equal(recording.read(3).rgb, walk.rgb[1])
    np.testing.assert_allclose(recording.read(3).depth, metres(walk.counts[1], 1000), rtol=1e-6)
    assert "1 of 6 frames left out, without colour or depth: images/frame_00004.png" in recording.notes


@pytest.mark.parametrize(
    "header, frame, message",
    [
        ({"camera_model": "OPENCV_FISHEYE"}, {}, "camera_model: expected .*OPENCV"),
        ({"fl_x": -3}, {}, "fl_x: expected a finite number above 0, got -3"),
        ({"w": 64}, {}, "expected the size of the images, 32x24, got 64x24"),
        ({"k4": 0.1}, {}, "expected a lens of k1 k2 p1 p2 k3, got k4 0.1"),
        ({}, {"transform_matrix": [[1, 2]]}, "transform_matrix: expected 4x4 finite numbers"),
        ({}, {"transform_matrix": 0.5}, "transform_matrix: expected 4x4 finite numbers"),
        ({}, {"file_path": 3}, "file_path: expected"),
    ],
)
def test_unusable_files_are_named(tmp_path, walk, save, header, frame, message):
    folder = write(tmp_path, walk, save, header=header, frame=lambda k: frame)
    with pytest.raises(DataError, match=f"transforms.json: {message}"):
        nerfstudio.load(folder)


def test_numbers_that_no_float_holds_are_named(tmp_path, walk, save):
    folder = write(tmp_path, walk, save, frame=lambda k: {"timestamp": 1e308 + k * 1e300})
    with pytest.raises(
        DataError, match=r"transforms.json: expected timestamps until the year 2200, got 1e\+308 s"
    ):
        nerfstudio.load(folder)
    folder = write(tmp_path, walk, save, header={"cx": -1.7e308})  # the mean of two of them is infinite
    with pytest.raises(DataError, match="expected a camera's fx fy cx cy, got 30 31 -inf 11"):
        nerfstudio.load(folder)
