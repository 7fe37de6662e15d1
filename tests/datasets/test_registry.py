"""The format of a folder is found by its files, and a wrong folder is told what was expected."""

import json
from typing import get_args

import numpy as np
import pytest

from jaxpose.datasets.rgbd import plain
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.errors import DataError
from jaxpose.experiments import imu_slam, rgbd_slam
from jaxpose.experiments.slam.source import load

LAYOUTS = {
    "ros": ["walk.bag"],
    "azure_kinect": ["walk.mkv"],
    "record3d": ["metadata", "rgbd/0.jpg", "rgbd/0.depth"],
    "stray_scanner": ["rgb.mp4", "odometry.csv", "camera_matrix.csv", "depth/000000.png"],
    "arkitscenes": ["lowres_wide/1_2.5.png", "lowres_depth/1_2.5.png", "lowres_wide.traj"],
    "polycam": ["keyframes/images/1.jpg", "keyframes/depth/1.png", "keyframes/cameras/1.json"],
    "nerfstudio": ["transforms.json", "images/1.png", "depth/1.png"],
    "sevenscenes": ["frame-000000.color.png", "frame-000000.depth.png", "camera-intrinsics.txt"],
    "tum": ["rgb.txt", "depth.txt", "groundtruth.txt", "rgb/1.png", "depth/1.png"],
    "replica": ["traj.txt", "results/frame000000.jpg", "results/depth000000.png"],
    "scannet": ["color/0.jpg", "depth/0.png", "pose/0.txt", "intrinsic/intrinsic_depth.txt"],
    "euroc": ["mav0/cam0/data.csv", "mav0/imu0/data.csv", "data.ply"],
    "icl_nuim": ["associations.txt", "livingRoom2.gt.freiburg", "rgb/1.png", "depth/1.png"],
    "sun3d": ["image/0000001-000000000000.jpg", "depth/0000001-000000000000.png", "intrinsics.txt"],
    "plain": ["color/0.jpg", "depth/0.png", "poses.txt", "camera-intrinsics.txt"],
}


# Of files that are known by their content.
MAGIC = {
    "walk.bag": b"#ROSBAG V2.0\n",
    "walk.mkv": b"\x1aE\xdf\xa3 k4arecord",
    "transforms.json": b'{"frames": [{"depth_file_path": "1"}]}',
}


def touch(folder, files):
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(MAGIC.get(file, b""))


@pytest.mark.parametrize("name", LAYOUTS)
def test_formats_are_told_apart_and_their_loader_is_asked(tmp_path, name):
    touch(tmp_path, LAYOUTS[name])
    assert rgbd_registry.find_format(tmp_path) == rgbd_registry.find_format(str(tmp_path)) == name
    with pytest.raises(DataError, match=r"[/:] expected |: [\w.]+: expected "):
        rgbd_registry.load_recording(tmp_path)


@pytest.mark.parametrize("name", ["tum", "plain"])
def test_a_list_of_pairs_makes_no_icl_nuim_of_other_layouts(tmp_path, name):
    """Users of TUM's associate.py keep its pairs beside the images."""
    touch(tmp_path, [*LAYOUTS[name], "associations.txt"])
    assert rgbd_registry.find_format(tmp_path) == name


@pytest.mark.parametrize(
    "name, files",
    [
        ("sevenscenes", ["seq-01/frame-000000.color.png"]),
        ("tum", ["rgb.txt"]),
        ("replica", ["results/frame000000.jpg"]),
        ("scannet", ["frames/color/0.jpg"]),
        ("euroc", ["imu0/data.csv"]),
        ("icl_nuim", ["associations.txt"]),
        ("plain", ["depth/0.png", "rgb/0.png"]),
    ],
)
def test_a_part_of_a_layout_is_enough(tmp_path, name, files):
    touch(tmp_path, files)
    assert rgbd_registry.find_format(tmp_path) == name


def test_every_format_has_a_layout():
    assert set(LAYOUTS) == set(get_args(rgbd_registry.Format))


def refusal(path):
    with pytest.raises(DataError) as error:
        rgbd_registry.load_recording(path)
    assert str(error.value).startswith(f"{path}: expected a recording (") and "\n" not in str(error.value)
    for layout in rgbd_registry.LAYOUTS.values():
        assert layout.title in str(error.value)
    return str(error.value).partition(", got ")[2]


def test_a_wrong_path_is_told_what_is_there(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "desk.zip").write_bytes(b"PK\x03\x04")
    assert refusal(tmp_path / "empty") == "an empty folder"
    assert refusal(tmp_path / "file") == "a file"
    assert refusal(tmp_path / "desk.zip") == "a zip archive to be unpacked first"
    assert refusal(tmp_path / "nowhere") == "nothing"
    assert refusal(tmp_path) == "desk.zip, empty, file"


@pytest.mark.parametrize(
    "files, got",
    [
        (
            ["notes.txt", "intrinsics.json"],
            "a plain folder; Open3D, RealSense and Redwood captures (plain), without color or ",
        ),
        (["frame-0001.color.png"], "7-Scenes, BundleFusion (sevenscenes), without frame-*.depth.png"),
    ],
)
def test_a_wrong_folder_is_told_the_nearest_format_and_what_it_lacks(tmp_path, files, got):
    touch(tmp_path, files)
    assert f": the nearest is {got}" in refusal(tmp_path)


def test_a_folder_of_recordings_names_them(tmp_path):
    touch(tmp_path / "desk", LAYOUTS["tum"])
    touch(tmp_path / "walk", LAYOUTS["ros"])
    assert refusal(tmp_path) == "a folder of recordings, name one: desk (tum), walk (ros)"


def test_topics_are_of_bags_only(desk):
    with pytest.raises(DataError, match="expected a ROS bag to choose topics of, got a plain folder"):
        rgbd_registry.load_recording(desk, topics=("/imu",))


@pytest.fixture
def desk(tmp_path, walk, save):
    folder = tmp_path / "desk"
    for i in range(6):
        save(folder / f"color/{i}.png", walk.rgb[i])
        save(folder / f"depth/{i}.png", walk.counts[i])
    (folder / "intrinsics.json").write_text(json.dumps({"fx": 30, "fy": 31, "cx": 15, "cy": 11}))
    (folder / "poses.txt").write_text(
        "".join(" ".join(f"{x:.17g}" for x in pose.ravel()) + "\n" for pose in walk.T_world_cam)
    )
    return folder


def test_a_format_that_is_named_is_taken(desk):
    touch(desk, ["rgb.txt"])
    assert rgbd_registry.find_format(desk) == "tum"
    recording = rgbd_registry.load_recording(desk, "plain", rate_hz=10.0)
    np.testing.assert_allclose(recording.t, np.arange(6) / 10)
    np.testing.assert_array_equal(recording.T_world_cam, plain.load(desk).T_world_cam)


def test_the_commands_find_the_format(desk):
    source = load(rgbd_slam.Config(data=desk, recorded_hz=10.0))
    assert source.metadata["format"] == "plain" and source.metadata["rate_hz"] == pytest.approx(10)
    assert source.recording.imu is None
    touch(desk, ["rgb.txt"])
    assert load(rgbd_slam.Config(data=desk, format="plain")).metadata["format"] == "plain"
    imu = load(imu_slam.Config(data=desk, format="plain")).imu
    assert "simulated at 200 Hz" in imu and "gravity 0 0 -9.81 m/s^2" in imu


def test_the_commands_take_the_recording_s_own_imu(desk, walk, save):
    timestamp = lambda k: 1403715273262142976 + 50_000_000 * k
    mav0 = desk.parent / "V1_01_easy" / "mav0"
    for kind, pixels in (("cam0", walk.rgb), ("depth0", walk.counts)):
        for k in range(6):
            save(mav0 / kind / f"data/{timestamp(k)}.png", pixels[k])
        (mav0 / kind / "data.csv").write_text(
            "".join(f"{timestamp(k)},{timestamp(k)}.png\n" for k in range(6))
        )
    pose = "T_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    (mav0 / "cam0/sensor.yaml").write_text(
        f"{pose}resolution: [32, 24]\nintrinsics: [30, 31, 15, 11]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
    )
    (mav0 / "imu0").mkdir()
    (mav0 / "imu0/sensor.yaml").write_text(
        f"{pose}gyroscope_noise_density: 1e-4\ngyroscope_random_walk: 1e-5\n"
        "accelerometer_noise_density: 2e-3\naccelerometer_random_walk: 3e-3\n"
    )
    lines = [f"{timestamp(0) + 5_000_000 * k},{k},0,0,0,0,9.8\n" for k in range(60)]
    (mav0 / "imu0/data.csv").write_text("".join(lines))
    with pytest.raises(
        DataError, match="V1_01_easy: --imu combined expected readings around frame 1, which has"
    ):
        load(imu_slam.Config(data=mav0.parent, start=1))
    assert load(rgbd_slam.Config(data=mav0.parent, start=1)).recording.T_world_cam is None
    (mav0 / "state_groundtruth_estimate0").mkdir()
    lines = [f"{timestamp(0) + 5_000_000 * k},1,2,3,1,0,0,0,{','.join('0' * 9)}\n" for k in range(60)]
    (mav0 / "state_groundtruth_estimate0/data.csv").write_text("".join(lines))
    source = load(imu_slam.Config(data=mav0.parent, start=1))
    assert source.metadata["format"] == "euroc"
    assert source.imu == "200 Hz, the recording's own, as read"
    np.testing.assert_allclose(source.recording.t, (1 + np.arange(5)) * 0.05, atol=1e-9)  # the clock stays
    np.testing.assert_allclose(source.recording.imu.t, np.arange(60) * 0.005, atol=1e-9)
    np.testing.assert_array_equal(source.recording.imu.omega_body[:, 0], np.arange(60))
