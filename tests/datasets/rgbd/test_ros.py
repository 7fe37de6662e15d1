"""Bags that the package rosbags writes, with known images, lens, motion and readings, read back."""

import struct
import tracemalloc

import cv2
import numpy as np
import pytest
from helpers.ros_bags import KINDS, Maker, Message
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd import ros
from jaxpose.datasets.rgbd.registry import find_format, load_recording
from jaxpose.errors import DataError

T0 = 1403715523912140001  # [ns]: more digits than a float has
STEP = 50_000_000
K, LENS = (30.0, 31.0, 15.0, 11.0), (0.1, -0.05, 0.001, 0.002, 0.01)
COLOR, DEPTH, INFO = (
    "/camera/color/image_raw",
    "/camera/aligned_depth_to_color/image_raw",
    "/camera/color/camera_info",
)
OPTICAL, BODY = "camera_color_optical_frame", "base_link"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU, TF, ODOMETRY = "sensor_msgs/msg/Imu", "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
T_BODY_CAM = np.eye(4)
T_BODY_CAM[:3, :3] = Rotation.from_euler("xyz", [-90, 0, -90], degrees=True).as_matrix()
T_BODY_CAM[:3, 3] = [0.1, 0.2, 0.3]


def stamp(k):
    return T0 + k * STEP


def smooth_poses(n):
    """T_world_body of a slow turn."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(n), [0, 0.01, 0.02])).as_matrix()
    T[:, 0, 3] = 0.01 * np.arange(n)
    return T


def messages(make, walk, *, info=True, extrinsics=True, imu=True, odometry=True, late_ns=7_000_000):
    """Colour, depth, lens, extrinsics, odometry of the body and its IMU; recorded some ms late."""
    rows, poses = [], smooth_poses(6)
    for k in range(6):
        at = stamp(k) + late_ns
        rows.append(Message(COLOR, IMAGE, at, make.image(stamp(k), OPTICAL, "rgb8", walk.rgb[k])))
        depth = make.image(stamp(k) + 3_000_000, OPTICAL, "16UC1", walk.counts[k])
        rows.append(Message(DEPTH, IMAGE, at + 1, depth))
        if info:
            rows.append(
                Message(INFO, CAMERA_INFO, at, make.camera_info(stamp(k), OPTICAL, K, (32, 24), D=LENS))
            )
        if odometry:
            message = make.odometry(stamp(k), "odom", BODY, poses[k])
            rows.append(Message("/odom", ODOMETRY, at, message))
    if extrinsics:
        rows.append(Message("/tf_static", TF, T0, make.tf(T0, BODY, OPTICAL, T_BODY_CAM)))
    if imu:
        for j in range(60):
            at = T0 + 5_000_000 * j
            rows.append(Message("/imu", IMU, at, make.imu(at, BODY, (j, 0, 0), (0, 0, 9.81))))
    return rows


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_reads_back(tmp_path, walk, metres, kind):
    make = Maker(kind)
    path = make.write(tmp_path, messages(make, walk))
    assert find_format(path) == "ros"
    if path.is_file():
        assert find_format(tmp_path) == "ros"  # the folder of a single bag
    recording = load_recording(path)
    assert recording.name == "walk"
    assert recording.camera == (*K, 32, 24, LENS)
    assert recording.t0_ns == T0
    np.testing.assert_allclose(recording.t, 0.05 * np.arange(6), atol=1e-12)
    for k in (0, 1, 2, 5, 3):  # in order, ahead and back
        rgb, depth = recording.read(k)
        np.testing.assert_array_equal(rgb, walk.rgb[k])
        np.testing.assert_allclose(depth, metres(walk.counts[k], 1000), rtol=1e-6)
    np.testing.assert_allclose(recording.T_world_cam, smooth_poses(6) @ T_BODY_CAM, atol=1e-12)
    np.testing.assert_allclose(recording.T_body_cam, T_BODY_CAM, atol=1e-12)
    np.testing.assert_allclose(recording.imu.t, 0.005 * np.arange(60), atol=1e-12)
    np.testing.assert_array_equal(recording.imu.omega_body[:, 0], np.arange(60))
    np.testing.assert_allclose(recording.imu.acceleration_body[:, 2], 9.81)
    assert any("ground truth: /odom, poses of base_link" in note for note in recording.notes)


# --- images -------------------------------------------------------------------------------------------------


def with_images(make, walk, color, depth):
    """The messages with other images: functions of the frame's number to kind and content."""
    rows = [row for row in messages(make, walk, imu=False) if row.topic not in (COLOR, DEPTH)]
    for k in range(6):
        rows += [Message(COLOR, *_split(color(k), k)), Message(DEPTH, *_split(depth(k), k))]
    return rows


def _split(content, k):
    return (COMPRESSED if hasattr(content, "format") else IMAGE), stamp(k), content


def compressed_depth(depth_m, a, b):
    """As compressed_depth_image_transport writes metres: a / depth + b in 16 bits behind 12 bytes."""
    counts = np.where(depth_m > 0, np.round(a / np.maximum(depth_m, 1e-9) + b), 0).astype(np.uint16)
    return struct.pack("<iff", 0, a, b) + cv2.imencode(".png", counts)[1].tobytes()


def test_encodings_of_colour(tmp_path, walk):
    for encoding, pixels, wanted in [
        ("bgr8", lambda k: walk.rgb[k][..., ::-1], lambda k: walk.rgb[k]),
        ("bgra8", lambda k: np.dstack([walk.rgb[k][..., ::-1], walk.rgb[k][..., :1]]), lambda k: walk.rgb[k]),
        ("mono8", lambda k: walk.rgb[k][..., 0], lambda k: np.repeat(walk.rgb[k][..., :1], 3, axis=2)),
    ]:
        make = Maker("ros1")
        color = lambda k, e=encoding, p=pixels, m=make: m.image(stamp(k), OPTICAL, e, p(k), padding=5)
        depth = lambda k, m=make: m.image(stamp(k), OPTICAL, "16UC1", walk.counts[k].astype(">u2"))
        (tmp_path / encoding).mkdir()
        recording = ros.load(make.write(tmp_path / encoding, with_images(make, walk, color, depth)))
        np.testing.assert_array_equal(recording.read(3).rgb, wanted(3))
        assert recording.read(3).depth[5, 5] == np.float32(walk.counts[3][5, 5] / 1000)


def test_a_pattern_of_colours_is_the_one_that_ros_means(tmp_path, walk):
    red = np.zeros((24, 32), np.uint8)
    red[::2, ::2] = 200  # rggb: the first pixel of the first row is red
    make = Maker("mcap")
    color = lambda k: make.image(stamp(k), OPTICAL, "bayer_rggb8", red)
    depth = lambda k: make.image(stamp(k), OPTICAL, "16UC1", walk.counts[k])
    rgb = ros.load(make.write(tmp_path, with_images(make, walk, color, depth))).read(0).rgb
    assert rgb[4:-4, 4:-4, 0].min() > 150 and rgb[4:-4, 4:-4, 1:].max() == 0


def test_compressed_images_and_depth_in_metres(tmp_path, walk, metres):
    make = Maker("sqlite3")
    png = lambda k: cv2.imencode(".png", walk.rgb[k][..., ::-1])[1].tobytes()
    color = lambda k: make.compressed(stamp(k), OPTICAL, "rgb8; png compressed bgr8", png(k))
    known = lambda k: np.minimum(metres(walk.counts[k], 1000), 9.9).astype(np.float32)
    quantised = lambda k: make.compressed(
        stamp(k), OPTICAL, "32FC1; compressedDepth png", compressed_depth(known(k), 10100.0, 1 - 1010.0)
    )
    recording = ros.load(make.write(tmp_path, with_images(make, walk, color, quantised)))
    np.testing.assert_array_equal(recording.read(2).rgb, walk.rgb[2])
    depth = recording.read(2).depth
    known_2 = known(2)
    np.testing.assert_array_equal(depth > 0, known_2 > 0)
    kept = known_2 > 0  # to half a count of a / z + b
    assert np.abs(10100 / depth[kept] - 10100 / known_2[kept]).max() <= 0.51


def test_depth_of_32_bits_and_compressed_16(tmp_path, walk, metres):
    make = Maker("ros1")
    color = lambda k: make.image(stamp(k), OPTICAL, "rgb8", walk.rgb[k])
    holes = metres(walk.counts[1], 1000).astype(np.float32)
    holes[0, :3] = [np.nan, np.inf, -1]
    depth = lambda k: make.image(stamp(k), OPTICAL, "32FC1", holes)
    (tmp_path / "a").mkdir()
    got = ros.load(make.write(tmp_path / "a", with_images(make, walk, color, depth))).read(0).depth
    np.testing.assert_array_equal(got[0, :3], 0)
    np.testing.assert_array_equal(got[1:], holes[1:])
    data = lambda k: b"\0" * 12 + cv2.imencode(".png", walk.counts[k])[1].tobytes()
    depth = lambda k: make.compressed(stamp(k), OPTICAL, "16UC1; compressedDepth", data(k))
    (tmp_path / "b").mkdir()
    got = ros.load(make.write(tmp_path / "b", with_images(make, walk, color, depth))).read(4).depth
    np.testing.assert_allclose(got, metres(walk.counts[4], 1000), rtol=1e-6)


# --- lenses -------------------------------------------------------------------------------------------------


def with_info(make, walk, **lens):
    rows = [row for row in messages(make, walk, imu=False) if row.topic != INFO]
    return [*rows, Message(INFO, CAMERA_INFO, T0, make.camera_info(T0, OPTICAL, K, (32, 24), **lens))]


def test_a_rational_lens_that_the_camera_has_is_kept_and_another_is_undone(tmp_path, walk):
    make = Maker("ros1")
    (tmp_path / "kept").mkdir()
    (tmp_path / "undone").mkdir()
    lens = with_info(make, walk, model="rational_polynomial", D=(*LENS, 0, 0, 0))
    assert ros.load(make.write(tmp_path / "kept", lens)).camera.distortion == LENS
    D = (0.9, 0.1, 0, 0, 0.02, 0.1, 0.1, 0.01)
    lens = with_info(make, walk, model="rational_polynomial", D=D)
    recording = ros.load(make.write(tmp_path / "undone", lens))
    assert recording.camera.distortion == () and any("is undone" in note for note in recording.notes)
    # The pixel that a ray falls on through the lens, by OpenCV's own projection, is where its colour is from.
    ray = np.array([[(28 - K[2]) / K[0], (20 - K[3]) / K[1], 1.0]])
    matrix = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    ((u, v),) = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), matrix, np.array(D))[0][:, 0]
    depth = recording.read(1).depth
    assert depth[20, 28] == np.float32(walk.counts[1][round(v), round(u)] / 1000)
    assert (round(u), round(v)) != (28, 20)


@pytest.mark.parametrize("D", [(0.1, -0.02, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)])
def test_a_fisheye_is_undone_even_if_it_states_no_coefficients(tmp_path, walk, D):
    make = Maker("mcap")
    recording = ros.load(make.write(tmp_path, with_info(make, walk, model="equidistant", D=D)))
    assert recording.camera.distortion == () and any("is undone" in note for note in recording.notes)
    x, y = (28 - K[2]) / K[0], (20 - K[3]) / K[1]
    angle = np.arctan(np.hypot(x, y))
    bent = angle * (1 + D[0] * angle**2 + D[1] * angle**4) / np.hypot(x, y)
    u, v = round(K[0] * x * bent + K[2]), round(K[1] * y * bent + K[3])
    assert recording.read(1).depth[20, 28] == np.float32(walk.counts[1][v, u] / 1000)


def test_a_lens_without_a_model_is_refused(tmp_path, walk):
    make = Maker("mcap")
    path = make.write(tmp_path, with_info(make, walk, model="omnidirectional", D=(0.1, 0, 0, 0)))
    with pytest.raises(
        DataError, match="camera_info: expected a distortion_model of plumb_bob, .*'omnidirectional'"
    ):
        ros.load(path)


# --- depth of its own camera --------------------------------------------------------------------------------


def test_depth_in_another_frame_is_registered_by_tf_static(tmp_path):
    """A wall 2 m before a depth camera that stands 0.2 m to the left, seen by colour."""
    make, n = Maker("ros1"), 3
    T, camera = np.eye(4), ((30, 30, 20, 15), (40, 30))
    T[0, 3] = -0.2
    rows = [
        Message("/tf_static", TF, T0, make.tf(T0, OPTICAL, "depth_optical", T)),
        Message("/color/camera_info", CAMERA_INFO, T0, make.camera_info(T0, OPTICAL, *camera)),
        Message("/depth/camera_info", CAMERA_INFO, T0, make.camera_info(T0, "depth_optical", *camera)),
    ]
    wall = np.full((30, 40), 2000, np.uint16)
    wall[:, 25:] = 1000
    for k in range(n):
        rgb = np.full((30, 40, 3), k, np.uint8)
        rows.append(Message("/color/image", IMAGE, stamp(k), make.image(stamp(k), OPTICAL, "rgb8", rgb)))
        rows.append(
            Message("/depth/image", IMAGE, stamp(k), make.image(stamp(k), "depth_optical", "16UC1", wall))
        )
    recording = ros.load(make.write(tmp_path, rows))
    depth = recording.read(0).depth
    # 30 px * 0.2 m: 3 px at 2 m, 6 px at 1 m, both to the left; beyond the right edge nothing was seen.
    np.testing.assert_array_equal(depth[10, :19], 2)
    np.testing.assert_array_equal(depth[10, 19:34], 1)
    np.testing.assert_array_equal(depth[10, 34:], 0)
    with pytest.raises(DataError, match="no transform in /tf_static"):
        (tmp_path / "b").mkdir()
        ros.load(make.write(tmp_path / "b", rows[1:]))


def test_colour_larger_than_its_depth_is_resized(tmp_path, walk):
    make = Maker("ros1")
    color = lambda k: make.image(stamp(k), OPTICAL, "rgb8", np.repeat(np.repeat(walk.rgb[k], 2, 0), 2, 1))
    depth = lambda k: make.image(stamp(k), OPTICAL, "16UC1", walk.counts[k])
    rows = with_images(make, walk, color, depth)
    rows = [row for row in rows if row.topic != INFO]
    rows.append(Message(INFO, CAMERA_INFO, T0, make.camera_info(T0, OPTICAL, (60, 62, 30.5, 22.5), (64, 48))))
    recording = ros.load(make.write(tmp_path, rows))
    assert recording.camera == (30, 31, 15, 11, 32, 24, ())
    np.testing.assert_array_equal(recording.read(2).rgb, walk.rgb[2])


# --- topics -------------------------------------------------------------------------------------------------


def test_topics_are_listed_and_chosen(tmp_path, walk):
    make = Maker("mcap")
    rows = messages(make, walk)
    for k in range(6):
        infrared = make.image(stamp(k), OPTICAL, "mono8", walk.rgb[k][..., 1])
        rows.append(Message("/camera/infra1/image_rect_raw", IMAGE, stamp(k), infrared))
    path = make.write(tmp_path, rows)
    recording = load_recording(path)
    np.testing.assert_array_equal(recording.read(0).rgb, walk.rgb[0])
    assert "chooses among /camera/infra1/image_rect_raw (mono8 32x24, 6 images)" in recording.notes[0]
    grey = load_recording(path, topics=("/camera/infra1/image_rect_raw",))
    np.testing.assert_array_equal(grey.read(0).rgb[..., 2], walk.rgb[0][..., 1])
    with pytest.raises(DataError, match=r"expected a topic /imu0, got /camera.* the nearest is /imu$"):
        load_recording(path, topics=("/imu0",))


def test_gyroscope_and_accelerometer_on_topics_of_their_own(tmp_path, walk):
    make = Maker("ros1")
    rows = messages(make, walk, imu=False)
    for j in range(60):
        at = T0 + 5_000_000 * j
        rows.append(Message("/gyro/sample", IMU, at, make.imu(at, BODY, (0, j, 0), (0, 0, 0))))
    for j in range(30):
        at = T0 + 2_500_000 + 10_000_000 * j
        rows.append(Message("/accel/sample", IMU, at, make.imu(at, BODY, (0, 0, 0), (2 * j, 0, 9.81))))
    recording = ros.load(make.write(tmp_path, rows))
    np.testing.assert_allclose(recording.imu.t, 0.005 * np.arange(1, 59), atol=1e-12)
    np.testing.assert_array_equal(recording.imu.omega_body[:, 1], np.arange(1, 59))
    np.testing.assert_allclose(recording.imu.acceleration_body[:, 0], np.arange(1, 59) - 0.5, atol=1e-6)


def test_poses_of_tf_where_no_topic_has_them(tmp_path, walk):
    make = Maker("ros1")
    rows = messages(make, walk, odometry=False, imu=False)
    poses = smooth_poses(6)
    rows += [Message("/tf", TF, stamp(k), make.tf(stamp(k), "world", BODY, poses[k])) for k in range(6)]
    recording = ros.load(make.write(tmp_path, rows))
    np.testing.assert_allclose(recording.T_world_cam, poses @ T_BODY_CAM, atol=1e-12)
    assert "ground truth: /tf from world to camera_color_optical_frame" in recording.notes


# --- gaps, and what cannot be used --------------------------------------------------------------------------


def test_gaps_are_left_out_and_counted(tmp_path, walk):
    make = Maker("sqlite3")
    rows = messages(make, walk, odometry=False)
    depths = [row for row in rows if row.topic == DEPTH]
    colors = [row for row in rows if row.topic == COLOR]
    rows.remove(depths[2])  # a lost frame
    rows.append(colors[3]._replace(recorded_ns=colors[3].recorded_ns + 5))  # one that came twice
    poses = smooth_poses(6)
    poses[4, 0, 3] = np.nan
    for k in range(6):
        message = make.pose_stamped(stamp(k), "world", poses[k])
        rows.append(Message("/vrpn/pose", "geometry_msgs/msg/PoseStamped", stamp(k), message))
    recording = ros.load(make.write(tmp_path, rows))
    np.testing.assert_allclose(recording.t, [0, 0.05, 0.15, 0.2, 0.25], atol=1e-12)
    np.testing.assert_array_equal(recording.read(2).rgb, walk.rgb[3])
    np.testing.assert_array_equal(recording.read(3).rgb, walk.rgb[4])
    notes = "; ".join(recording.notes)
    assert "1 images left out, of the timestamp of another" in notes
    assert "1 of 6 colour images left out, no depth of their own within 0.02 s" in notes
    assert "1 of 6 poses of /vrpn/pose left out, with NaN" in notes
    assert "poses of camera_color_optical_frame, as it does not say" in notes


def test_an_imu_without_extrinsics_is_left_out_aloud(tmp_path, walk):
    make = Maker("mcap")
    recording = ros.load(make.write(tmp_path, messages(make, walk, extrinsics=False)))
    assert recording.imu is None and recording.T_world_cam is None
    notes = "; ".join(recording.notes)
    assert "IMU /imu left out: no transform from base_link to camera_color_optical_frame" in notes
    assert "/odom left out: no transform from base_link" in notes


@pytest.mark.parametrize(
    "drop, message",
    [
        (DEPTH, "walk.bag: expected topics of colour and of depth, got no depth in /camera/color/image_raw "),
        (COLOR, "walk.bag: expected topics of colour and of depth, got no colour"),
        (INFO, "walk.bag: expected a CameraInfo of /camera/color/image_raw, got none"),
    ],
)
def test_a_missing_topic_is_named(tmp_path, walk, drop, message):
    make = Maker("ros1")
    path = make.write(tmp_path, [row for row in messages(make, walk) if row.topic != drop])
    with pytest.raises(DataError, match=message):
        ros.load(path)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.02, 0.5, 0.97])
def test_a_truncated_bag_is_one_line(tmp_path, walk, kind, share):
    make = Maker(kind)
    path = make.write(tmp_path, messages(make, walk))
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix in (".db3", ".mcap"))
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(DataError) as error:
        recording = ros.load(path)
        for k in range(6):
            recording.read(k)
    assert str(error.value).startswith(str(tmp_path)) and "\n" not in str(error.value)


def test_images_that_cannot_be_decoded_are_named(tmp_path, walk):
    make = Maker("ros1")
    rows = messages(make, walk)
    bad = make.image(stamp(3), OPTICAL, "rgb8", walk.rgb[3])
    bad.data = bad.data[:100]
    at = next(
        i for i, row in enumerate(rows) if row.topic == COLOR and row.content.header.stamp == bad.header.stamp
    )
    rows[at] = rows[at]._replace(content=bad)
    recording = ros.load(make.write(tmp_path, rows))
    recording.read(2)
    with pytest.raises(
        DataError, match=r"image_raw: message 3: expected 32x24 pixels of rgb8, got 100 bytes"
    ):
        recording.read(3)


@pytest.mark.parametrize("topic", [COLOR, DEPTH])
def test_a_size_that_the_bytes_do_not_have_is_refused_before_it_is_used(walk, tmp_path, topic):
    make = Maker("ros1")
    rows = messages(make, walk)
    for row in rows:
        if row.topic == topic:
            row.content.width, row.content.height = 2**25, 16
    with pytest.raises(
        DataError, match=f"{topic}: expected 33554432x16 pixels of .*, got .* bytes in rows of"
    ):
        ros.load(make.write(tmp_path, rows))


def test_without_the_package_the_extra_is_named(tmp_path, walk, monkeypatch):
    make = Maker("ros1")
    path = make.write(tmp_path, messages(make, walk))
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(DataError, match=r'needs the package rosbags: pip install -e ".\[ros\]"'):
        ros.load(path)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_length_in_a_bag_allots_no_more_than_the_bag_holds(tmp_path, walk, kind):
    """An index that begins 3 bytes late: what is there is read as a length of gigabytes or exabytes."""
    make = Maker(kind)
    path = make.write(tmp_path, messages(make, walk))
    file = path if path.is_file() else next(path.glob("*.mcap"))
    content = bytearray(file.read_bytes())
    at = content.index(b"index_pos=") + 10 if kind == "ros1" else len(content) - 28  # of the footer
    (place,) = struct.unpack_from("<Q", content, at)
    struct.pack_into("<Q", content, at, place + 3)
    file.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(DataError, match="expected a ROS bag: .*, got a damaged one"):
        ros.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
