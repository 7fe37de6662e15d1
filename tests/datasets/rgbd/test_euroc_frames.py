"""EuRoC's images and depth, with ground truth and IMU on their clock."""

import shutil

import numpy as np
import pytest
from helpers.asl import T0, truth_line, write_sequence
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.datasets import images
from jaxpose.datasets.rgbd import euroc
from jaxpose.datasets.rgbd.euroc_files import read_camera_sheet
from jaxpose.errors import DataError


@pytest.fixture
def sequence(tmp_path):
    return write_sequence(tmp_path)


STAMPS = [T0 + 1000000000 + 50000007 * k for k in range(6)]  # of the images, from 1 s after the IMU's first
VELOCITY, RATE = np.array([0.3, -0.2, 0.1]), np.array([0.2, 0.5, -0.4])  # m/s and rad/s
T_BODY_CAM = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0, 0, 0, 1],
    ]
)
CAMERA_SHEET = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{pose}]
rate_hz: 20
resolution: [32, 24]
camera_model: pinhole
intrinsics: [20.5, 21.5, 15.25, 11.75] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def body_at(seconds):
    """T_world_body of a body that moves and turns steadily."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(RATE * seconds).as_matrix()
    T[:3, 3] = VELOCITY * seconds
    return T


def write_frames(folder, timestamps, images, save):
    for timestamp, image in zip(timestamps, images, strict=True):
        save(folder / f"data/{timestamp}.png", image)
    lines = ["#timestamp [ns],filename", *(f"{timestamp},{timestamp}.png" for timestamp in timestamps)]
    (folder / "data.csv").write_text("\r\n".join(lines) + "\r\n")


@pytest.fixture
def vicon(sequence, walk, save):
    """The made-up recording with two cameras.

    Ground truth at 200 Hz from 1.02 s on, and depth for all images.
    """
    mav0 = sequence / "mav0"
    write_frames(mav0 / "cam0", STAMPS, walk.rgb[..., 0], save)
    write_frames(mav0 / "cam1", STAMPS[:4], walk.rgb[:4, ..., 1], save)
    sheet = CAMERA_SHEET.format(pose=", ".join(map(repr, T_BODY_CAM.ravel().tolist())))
    (mav0 / "cam0/sensor.yaml").write_text(sheet)
    (mav0 / "cam1/sensor.yaml").write_text(sheet)
    write_frames(mav0 / "depth0", STAMPS, walk.counts, save)
    lines = ["#timestamp"]
    for timestamp in range(T0 + 1020000000, T0 + 1400000000, 5000000):
        T = body_at((timestamp - T0) * 1e-9)
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        lines.append(truth_line(timestamp, T[:3, 3].tolist(), (float(w), float(x), float(y), float(z))))
    (mav0 / "state_groundtruth_estimate0/data.csv").write_text("\n".join(lines))
    return sequence


def test_a_sheet_whose_lists_are_texts(tmp_path):
    pose = " ".join(map(str, T_BODY_CAM.ravel()))
    text = CAMERA_SHEET.format(pose="0").replace("data: [0]", f'data: "{pose}"')
    (tmp_path / "a.yaml").write_text(text.replace("[32, 24]", "'32, 24'"))
    camera, T = read_camera_sheet(tmp_path / "a.yaml")
    np.testing.assert_array_equal(T, T_BODY_CAM)
    assert (camera.width, camera.height) == (32, 24)


def test_frames_with_given_depth(vicon, walk, metres):
    for path in (vicon, vicon / "mav0"):
        recording = euroc.load(path)
        assert recording.name == vicon.name
        assert [(path / file).is_file() for file in recording.files] == [True] * 6
    distortion = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    assert recording.camera == (20.5, 21.5, 15.25, 11.75, 32, 24, distortion)
    np.testing.assert_allclose(recording.t, np.arange(6) * 0.050000007, rtol=1e-12)
    for i in range(6):
        rgb, depth = recording.read(i)
        np.testing.assert_array_equal(rgb, walk.rgb[i, ..., :1].repeat(3, axis=-1))
        np.testing.assert_allclose(depth, metres(walk.counts[i], 1000), rtol=1e-6)
    assert recording.notes == (
        f"1 frames without a usable pose (no ground truth near its timestamp): {STAMPS[0]}",
        "cam1 with 4 images is not used",
    )


def test_truth_is_interpolated_to_the_images(vicon):
    recording = euroc.load(vicon)
    assert np.isnan(recording.T_world_cam[0]).all()
    for i in range(1, 6):
        expected = body_at((STAMPS[i] - T0) * 1e-9) @ T_BODY_CAM
        np.testing.assert_allclose(recording.T_world_cam[i], expected, atol=1e-9)


def test_truth_is_not_interpolated_over_a_gap(vicon):
    file = vicon / "mav0/state_groundtruth_estimate0/data.csv"
    lines = file.read_text().splitlines()
    away = [line for line in lines[1:] if 1.07 < (int(line.split(",")[0]) - T0) * 1e-9 < 1.23]
    file.write_text("\n".join(line for line in lines if line not in away))
    missing = np.isnan(euroc.load(vicon).T_world_cam).all((1, 2))
    np.testing.assert_array_equal(missing, [1, 0, 1, 1, 1, 0])
    # A timestamp that the ground truth has is known, however far the next one is.
    rest = [line for line in lines if line not in away]
    T = body_at((STAMPS[2] - T0) * 1e-9)
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    at = sum(int(line.split(",")[0]) < STAMPS[2] for line in rest[1:]) + 1
    rest.insert(at, truth_line(STAMPS[2], T[:3, 3].tolist(), (w, x, y, z)))
    file.write_text("\n".join(rest))
    recording = euroc.load(vicon)
    np.testing.assert_allclose(recording.T_world_cam[2], T @ T_BODY_CAM, atol=1e-9)
    assert np.isnan(recording.T_world_cam[[0, 3, 4]]).all()


def test_imu_is_on_the_clock_of_the_frames(vicon):
    recording = euroc.load(vicon)
    np.testing.assert_allclose(recording.imu.t, [-1, -1 + 0.005000007], rtol=1e-12)
    np.testing.assert_array_equal(recording.imu.omega_body, [[1, 2, 3], [1.5, 0, 0]])
    T_body_imu = euroc.load_imu(vicon).T_body_imu
    np.testing.assert_allclose(T_body_imu @ recording.T_body_cam, T_BODY_CAM, atol=1e-12)
    np.testing.assert_array_equal(recording.gravity_world, [0, 0, -9.80665])


def test_frames_without_depth_are_left_out(vicon, walk):
    file = vicon / "mav0/depth0/data.csv"
    file.write_text("\n".join(file.read_text().splitlines()[:2] + file.read_text().splitlines()[4:]))
    recording = euroc.load(vicon)
    np.testing.assert_allclose(recording.t, np.array([0, 3, 4, 5]) * 0.050000007, rtol=1e-12)
    np.testing.assert_array_equal(recording.read(1).rgb[..., 0], walk.rgb[3, ..., 0])
    assert recording.notes[0] == (
        f"2 of 6 frames left out, no depth of their timestamp: {STAMPS[1]}, {STAMPS[2]}"
    )


@pytest.mark.parametrize("place", ["data.ply", "mav0/pointcloud0/data.ply"])
def test_depth_of_the_scan(vicon, place):
    """A wall 3 m along the axis of the camera at the second image, which is straight for that image."""
    shutil.rmtree(vicon / "mav0/depth0")
    (vicon / place).parent.mkdir(exist_ok=True)
    T_world_cam = body_at((STAMPS[1] - T0) * 1e-9) @ T_BODY_CAM
    x, y = np.meshgrid(np.arange(-6, 6, 0.05), np.arange(-6, 6, 0.05))
    wall_cam = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 3.0), np.ones(x.size)])
    points = (wall_cam @ T_world_cam.T)[:, :3].astype("<f4")
    points[0] = np.nan
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    (vicon / place).write_bytes(head.encode() + points.tobytes())
    recording = euroc.load(vicon)
    assert len(recording.t) == 5 and np.isfinite(recording.T_world_cam).all()
    np.testing.assert_allclose(recording.read(0).depth, 3, atol=1e-4)
    assert recording.t0_ns == STAMPS[1] and recording.t[0] == 0
    assert recording.imu.t[0] == (T0 - STAMPS[1]) * 1e-9
    assert recording.notes == (
        f"depth from the {len(points) - 1} points of data.ply, taken to be in the frame of the ground truth",
        "1 points with NaN or infinity ignored",
        f"1 of 6 frames left out, no true pose to see the cloud from: {STAMPS[0]}",
        "cam1 with 4 images is not used",
    )
    (vicon / place).write_bytes(head.encode() + (points + np.float32(100)).tobytes())
    with pytest.raises(DataError, match="data.ply: expected points in the view of cam0, got none"):
        euroc.load(vicon)
    shutil.rmtree(vicon / "mav0/state_groundtruth_estimate0")
    with pytest.raises(DataError, match="data.ply: expected true poses to project the cloud with, got none"):
        euroc.load(vicon)


def test_frames_without_truth(vicon):
    shutil.rmtree(vicon / "mav0/state_groundtruth_estimate0")
    recording = euroc.load(vicon)
    assert recording.T_world_cam is None and "no state_groundtruth_estimate0" in recording.notes[0]


def test_without_depth_it_says_where_it_looked(vicon):
    shutil.rmtree(vicon / "mav0/depth0")
    with pytest.raises(
        DataError, match=r"mav0: expected depth in depth0/data.csv, or a point cloud in point"
    ):
        euroc.load(vicon)


SHEET = CAMERA_SHEET.format(pose="1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1")


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("cam0/data.csv", None, "cam0/data.csv: expected a file, got none"),
        (
            "cam0/data.csv",
            "#header\n",
            "cam0/data.csv: expected lines of a timestamp and a file name, got none",
        ),
        (
            "cam0/data.csv",
            "#h\nx,a.png\n",
            "cam0/data.csv:2: expected a timestamp in ns and a file name, got 'x",
        ),
        ("cam0/data.csv", "5\n", "cam0/data.csv:1: expected a timestamp in ns and a file name"),
        ("cam0/data.csv", "5,a.png\n5,b.png\n", "cam0/data.csv:2: expected a timestamp after 0.000000005 s"),
        ("cam0/data.csv", "5,a.png\n", "cam0/data.csv: expected the files that it lists, got none of 1"),
        ("cam0/sensor.yaml", None, "cam0/sensor.yaml: expected a file, got none"),
        (
            "cam0/sensor.yaml",
            SHEET.replace("radial-tangential", "equidistant"),
            "cam0/sensor.yaml: distortion_model: expected one of radial-tangential, .*, got 'equidistant'",
        ),
        (
            "cam0/sensor.yaml",
            SHEET.replace("distortion_m", "m"),
            "distortion_model: expected .* no such entry",
        ),
        (
            "cam0/sensor.yaml",
            SHEET.replace("[32, 24]", "[24, 32]"),
            "yaml: expected the images' res.*, 32x24",
        ),
        ("cam0/sensor.yaml", SHEET.replace("20.5,", ""), "yaml: intrinsics: expected 4 finite numbers"),
        ("depth0/data.csv", f"5,{STAMPS[0]}.png\n", "depth0/data.csv: expected timestamps of cam0, got 5"),
        (
            "depth0/data.csv",
            f"{STAMPS[0]},a.png\n",
            "depth0/data.csv: expected the files that it lists, got none of 1: a.png",
        ),
    ],
)
def test_unusable_frames(vicon, file, content, message):
    path = vicon / "mav0" / file
    path.unlink() if content is None else path.write_text(content)
    with pytest.raises(DataError, match=message) as error:
        euroc.load(vicon)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.full((24, 32), 7, np.uint8), "expected depth in mm, one channel of 16 bits, got uint8"),
        (np.full((20, 32), 7, np.uint16), "expected 32x24, the size of .*, got 32x20"),
    ],
)
def test_depth_of_the_wrong_kind(vicon, save, pixels, message):
    save(vicon / f"mav0/depth0/data/{STAMPS[0]}.png", pixels)
    with pytest.raises(DataError, match=f"{STAMPS[0]}.png: {message}"):
        euroc.load(vicon)


@pytest.mark.data
def test_real_stereo_pairs(data_dir):
    """Five pairs of V1_01: the baseline of the VI-Sensor, 11 cm, and the same wall in both images."""
    path = data_dir / "euroc_V1_01_easy"
    left, right = euroc.load_camera(path), euroc.load_camera(path, "cam1")
    assert left.stamps_ns == right.stamps_ns and len(left.files) == 5
    assert left.camera[:6] == (458.654, 457.296, 367.215, 248.375, 752, 480)
    assert right.camera.distortion == (-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05)
    T_left_right = np.linalg.inv(left.T_body_cam) @ right.T_body_cam
    np.testing.assert_allclose(T_left_right[:3, 3], [0.110, 0, 0], atol=1e-3)
    rgb = [images.read_color(camera.files[0]) for camera in (left, right)]
    assert all(image.shape == (480, 752, 3) and image.std() > 20 for image in rgb)
    assert (rgb[0][..., 0] == rgb[0][..., 2]).all()
    with pytest.raises(DataError, match="mav0: expected depth in depth0/data.csv, or a point cloud"):
        euroc.load(path)


@pytest.mark.data
def test_real_frames_with_depth(data_dir, tmp_path):
    """The real folder with made depth beside it.

    Ground truth that is nearly at rest, IMU before and after.
    """
    path = tmp_path / "V1_01_easy"
    shutil.copytree(data_dir / "euroc_V1_01_easy", path)
    timestamps = euroc.load_camera(path).stamps_ns
    for timestamp in timestamps:
        file = path / f"mav0/depth0/data/{timestamp}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((480, 752), 2000, np.uint16)).save(file)
    shutil.copy(path / "mav0/cam0/data.csv", path / "mav0/depth0/data.csv")
    recording = euroc.load(path)
    np.testing.assert_allclose(recording.t, np.arange(5) * 0.05, atol=1e-6)
    body = np.array([[0.878895, 2.1834, 0.948427]])  # the ground truth's first line
    centre = (recording.T_world_cam @ np.linalg.inv(recording.T_body_cam))[:, :3, 3]
    np.testing.assert_allclose(centre, body.repeat(5, axis=0), atol=1e-3)
    assert recording.imu.t[0] == 0 and recording.imu.t[-1] > 145
    # At rest the IMU reads the reaction to gravity: up.
    up = (recording.T_world_cam @ np.linalg.inv(recording.T_body_cam))[0, :3, :3]
    assert (up @ recording.imu.acceleration_body[:40].mean(axis=0))[2] == pytest.approx(9.8, abs=0.2)


@pytest.mark.parametrize("model", ["radtan", '"radial-tangential"', "plumb_bob", "'radial_tangential'"])
@pytest.mark.parametrize(
    "layout",
    [
        lambda rows: "T_BS: [" + ", ".join(f"[{', '.join(row)}]" for row in rows) + "]",
        lambda rows: "T_BS:\n" + "".join(f"  - [{', '.join(row)}]\n" for row in rows),
        lambda rows: "T_BS:\n  data:\n" + "".join(f"  - {x}\n" for row in rows for x in row),
        lambda rows: "T_BS:\n  data: [" + ",\n    ".join(f"'{x}'" for row in rows for x in row) + "]",
    ],
)
def test_a_sheet_says_the_same_in_every_layout_of_yaml(tmp_path, layout, model):
    rows = [[repr(x) for x in row] for row in T_BODY_CAM.tolist()]
    rest = CAMERA_SHEET[CAMERA_SHEET.index("rate_hz") :].replace("radial-tangential", model)
    rest = rest.replace(
        "intrinsics: [20.5, 21.5, 15.25, 11.75]", "intrinsics:\n- 20.5\n- 21.5\n- 15.25\n- 11.75"
    )
    (tmp_path / "sensor.yaml").write_text(f"{layout(rows)}\n{rest}")
    camera, T_body_cam = read_camera_sheet(tmp_path / "sensor.yaml")
    np.testing.assert_array_equal(T_body_cam, T_BODY_CAM)
    assert camera[:4] == (20.5, 21.5, 15.25, 11.75) and len(camera.distortion) == 4


def test_listed_images_that_are_not_there_are_counted(vicon, walk):
    mav0 = vicon / "mav0"
    (mav0 / f"cam0/data/{STAMPS[1]}.png").unlink()
    (mav0 / f"depth0/data/{STAMPS[3]}.png").unlink()
    (mav0 / f"cam0/data/{STAMPS[4]}.png").rename(mav0 / f"cam0/data/{STAMPS[4]}.PNG")
    recording = euroc.load(vicon)
    np.testing.assert_allclose(
        recording.t, [(STAMPS[k] - STAMPS[0]) * 1e-9 for k in (0, 2, 4, 5)], atol=1e-12
    )
    np.testing.assert_array_equal(recording.read(2).rgb[..., 0], walk.rgb[4, ..., 0])
    assert recording.notes[:2] == (
        f"cam0: 1 of 6 files that data.csv lists are not there: {STAMPS[1]}.png",
        f"depth0: 1 of 6 files that data.csv lists are not there: {STAMPS[3]}.png",
    )
