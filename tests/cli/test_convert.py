"""`jaxpose convert`: a bag, an app's capture and a folder, read again from each layout as they were."""

import numpy as np
import pytest
from helpers import phones
from helpers.refused import complaint
from helpers.ros_bags import Maker, Message
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.cli import convert
from jaxpose.cli.convert import Config
from jaxpose.datasets.rgbd import registry
from jaxpose.datasets.rgbd.imu_csv import with_imu
from jaxpose.geometry import rigid

COUNT, SIZE, T0_NS = 4, (32, 24), 1_403_715_523_912_143_101
K = (30.0, 31.0, 15.0, 11.0)
rng = np.random.default_rng(2)
RGB = rng.integers(0, 256, (COUNT, 24, 32, 3)).astype(np.uint8)
DEPTH = rng.uniform(0.5, 20.0, (COUNT, 24, 32)).astype(np.float32)
POSES = rigid.make(Rotation.from_rotvec(rng.normal(size=(COUNT, 3))).as_matrix(), rng.normal(size=(COUNT, 3)))
T_CAM_IMU = rigid.make(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([0.1, 0.0, -0.2]))


@pytest.fixture
def bag(tmp_path):
    """Colour, depth in metres, poses of all frames but one, an IMU; a lens with three coefficients."""
    maker, messages = Maker("mcap"), []
    add = lambda topic, kind, ns, content: messages.append(Message(topic, kind, ns, content))
    for k in range(COUNT):
        ns = T0_NS + 50_000_000 * k
        add("/color", "sensor_msgs/msg/Image", ns, maker.image(ns, "cam", "rgb8", RGB[k]))
        add("/depth", "sensor_msgs/msg/Image", ns, maker.image(ns, "cam", "32FC1", DEPTH[k]))
        info = maker.camera_info(ns, "cam", K, SIZE, D=(0.1, -0.02, 0.001, 0.0, 0.0))
        add("/camera_info", "sensor_msgs/msg/CameraInfo", ns, info)
        if k != 2:
            add("/pose", "geometry_msgs/msg/PoseStamped", ns, maker.pose_stamped(ns, "map", POSES[k]))
    for j in range(30):
        ns = T0_NS - 7 + 10_000_000 * j
        add("/imu", "sensor_msgs/msg/Imu", ns, maker.imu(ns, "imu", (0.1 * j, 0.2, 0.3), (0.0, 0.1, 9.8)))
    add("/tf_static", "tf2_msgs/msg/TFMessage", T0_NS, maker.tf(T0_NS, "cam", "imu", T_CAM_IMU))
    return maker.write(tmp_path, messages)


@pytest.mark.parametrize("to", ["plain", "tum", "euroc"])
def test_a_bag_is_read_again_as_it_was(bag, tmp_path, to):
    out = tmp_path / "new" / to
    result = convert.run(Config(bag, to, out))
    assert (result.frames, result.poses, result.readings) == (COUNT, 3, 30)
    assert [path.name for path in out.parent.iterdir()] == [to]
    before, after = registry.load_recording(bag), registry.load_recording(out)
    assert registry.find_format(out) == to and after.t0_ns == before.t0_ns == T0_NS
    if to != "euroc":
        assert any("--imu-file" in note for note in result.notes)
        after = with_imu(after, out / "imu.csv", out / "sensor.yaml")
    np.testing.assert_array_equal(after.t, before.t)
    known = [0, 1, 3]
    if to != "euroc":  # whose reader interpolates over 0.1 s
        np.testing.assert_array_equal(np.isnan(after.T_world_cam), np.isnan(before.T_world_cam))
    np.testing.assert_allclose(after.T_world_cam[known], before.T_world_cam[known], atol=1e-9)
    np.testing.assert_allclose(after.T_body_cam, before.T_body_cam, atol=1e-12)
    np.testing.assert_allclose(after.imu.t, before.imu.t, atol=1e-9)
    np.testing.assert_array_equal(after.imu.omega_body, before.imu.omega_body)
    np.testing.assert_array_equal(after.imu.acceleration_body, before.imu.acceleration_body)
    np.testing.assert_allclose(after.camera[:6], before.camera[:6])
    if to == "tum":
        assert after.camera.distortion == () and any("13.11 m have no depth" in note for note in result.notes)
        return
    np.testing.assert_allclose(after.camera.distortion, before.camera.distortion)
    for k in range(COUNT):
        np.testing.assert_array_equal(after.read(k).rgb, before.read(k).rgb)
        np.testing.assert_allclose(after.read(k).depth, before.read(k).depth, atol=0.501e-3)


def test_files_are_copied_as_they_are(tmp_path):
    source = tmp_path / "own"
    for name, pixels in (("color", RGB), ("depth", (1000 * DEPTH).astype(np.uint16))):
        (source / name).mkdir(parents=True)
        for k in range(COUNT):
            suffix = ".jpg" if name == "color" else ".png"
            Image.fromarray(pixels[k]).save(source / name / f"{k}{suffix}")
    (source / "intrinsics.json").write_text('{"fx": 30, "fy": 31, "cx": 15, "cy": 11, "depth_scale": 5000}')
    convert.run(Config(source, "plain", tmp_path / "a", recorded_hz=10.0))
    convert.run(Config(tmp_path / "a", "tum", tmp_path / "b"))
    for k, stamp in enumerate(["0.0", "0.1", "0.2", "0.3"]):
        bytes_of = [
            (folder / name).read_bytes()
            for folder, name in (
                (source, f"color/{k}.jpg"), (tmp_path / "b", f"rgb/{stamp}.jpg"),
                (source, f"depth/{k}.png"), (tmp_path / "b", f"depth/{stamp}.png"),
            )
        ]  # fmt: skip
        assert bytes_of[0] == bytes_of[1] and bytes_of[2] == bytes_of[3]


def test_the_world_of_a_phone_is_set_upright(tmp_path):
    """ARKit's y is up; the formats' z is."""
    from types import SimpleNamespace

    walk = SimpleNamespace(rgb=RGB, counts=(1000 * DEPTH).astype(np.uint16), T_world_cam=POSES)
    phones.record3d(tmp_path / "a.r3d", walk, K=K)
    result = convert.run(Config(tmp_path / "a.r3d", "plain", tmp_path / "out"))
    assert "the world of the poses is turned so that z points up" in result.notes
    turn = registry.load_recording(tmp_path / "out").T_world_cam @ np.linalg.inv(POSES)
    np.testing.assert_allclose(turn, np.tile(turn[0], (COUNT, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(turn[0, :3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-6)


def test_what_cannot_be_copied_costs_one_line(bag, tmp_path, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("kept")
    for args, message in (
        ([str(bag), "--to", "plain", "--out", str(tmp_path / "full")], "is empty, got one with files"),
        ([str(tmp_path / "full"), "--to", "plain", "--out", "x"], "expected a recording"),
        ([str(bag), "--to", "plain", "--out", "x", "--recorded-hz", "3"], "expected no --recorded-hz"),
    ):
        assert message in complaint(convert.main, *args)
    assert (tmp_path / "full" / "mine.txt").read_text() == "kept"
    broken = registry.load_recording(bag)._replace(read=lambda i: 1 / 0)
    monkeypatch.setattr(registry, "load_recording", lambda *args, **options: broken)
    with pytest.raises(ZeroDivisionError):
        convert.run(Config(bag, "plain", tmp_path / "half"))
    assert not (tmp_path / "half").exists() and not list(tmp_path.glob(".half*"))
