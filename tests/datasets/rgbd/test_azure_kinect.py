"""Azure Kinect's mkv: its calibration, depth registered by a lens with k4 to k6, its IMU."""

import numpy as np
import pytest
from helpers import azure_kinect
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd import registry
from jaxpose.datasets.rgbd.rational import pixel_rays, undistortion
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

COUNT = 3
T_COLOR_DEPTH = rigid.make(
    Rotation.from_rotvec([0.1, 0.02, -0.01]).as_matrix(), np.array([-0.032, -0.002, 0.004])
)
T_IMU_DEPTH = rigid.make(Rotation.from_rotvec([1.5, 0.1, 1.4]).as_matrix(), np.array([0.0, 0.02, 0.05]))
READINGS = [(10_000 * j, (0.5 * j, 0.0, 9.8), (0.0, 0.01 * j, 0.0)) for j in range(9)]


def recorded(folder, **changes):
    column = np.arange(azure_kinect.COLOR[0]) / 3
    rgb = [np.broadcast_to(column[:, None] + k, (360, 640, 3)).astype(np.uint8) for k in range(COUNT)]
    counts = [np.full(azure_kinect.DEPTH[::-1], 2000 + 100 * k, np.uint16) for k in range(COUNT)]
    stated = azure_kinect.calibration(T_COLOR_DEPTH, T_IMU_DEPTH)
    given = {"rgb": rgb, "counts": counts, "readings": READINGS, "stated": stated} | changes
    return azure_kinect.write(folder / "walk.mkv", **given)


def test_frames_are_those_of_a_pinhole_at_the_color_camera(tmp_path):
    """A wall across the depth camera's axis is a plane of the color camera, wherever the lens bends it to."""
    file = recorded(tmp_path)
    assert registry.find_format(file) == registry.find_format(tmp_path) == "azure_kinect"
    read = registry.load_recording(file)
    np.testing.assert_allclose(read.t, [0, 0.033333, 0.066666], atol=1e-9)
    # 640x360 is the middle of a grid of 640x480, made as wide as depth's 320x288.
    wanted = Camera(0.47 * 320, 0.63 * 240, 0.49 * 320 - 0.5, 0.52 * 240 - 30 - 0.5, 320, 180)
    np.testing.assert_allclose(read.camera[:6], wanted[:6])
    normal = T_COLOR_DEPTH[:3, 2]  # of the wall, in the color camera's axes
    v, u = np.mgrid[:180, :320]
    rays = np.stack([(u - wanted.cx) / wanted.fx, (v - wanted.cy) / wanted.fy, np.ones(u.shape)], axis=-1)
    for k in range(COUNT):
        rgb, depth = read.read(k)
        seen = depth > 0
        assert seen.mean() > 0.4  # color sees more than depth
        distance = 2.0 + 0.1 * k + normal @ T_COLOR_DEPTH[:3, 3]
        off = np.abs(depth - distance / (rays @ normal))[seen]
        assert np.median(off) < 1e-3 and off.max() < 2e-2  # pixels' own width on a slanted wall
        middle = rgb[int(wanted.cy), int(wanted.cx)].astype(float)
        np.testing.assert_allclose(middle, (2 * wanted.cx + 0.5) / 3 + k, atol=1.5)


def test_rays_lead_back_by_the_formula():
    """OpenCV's documentation, "Camera Calibration and 3D Reconstruction": the rational model."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens = np.array([0.5, -0.1, 1e-4, 2e-4, 0.02, 0.4, -0.05, 0.01])
    camera = Camera(250.0, 252.0, 160.0, 144.0, 320, 288)
    rays = pixel_rays(camera, lens)
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    bent = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = 250 * (x * bent + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 160
    v = 252 * (y * bent + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 144
    np.testing.assert_allclose(u, np.arange(320)[None] + np.zeros((288, 1)), atol=1e-4)
    np.testing.assert_allclose(v, np.arange(288)[:, None] + np.zeros((1, 320)), atol=1e-4)
    edge = pixel_rays(Camera(12.0, 12.0, 32.0, 24.0, 64, 48), np.array([-0.3, 0, 0, 0, 0, 0, 0, 0]))
    assert np.isnan(edge[0, 0]).all() and np.isfinite(edge[24, 32]).all()  # no ray bends that far out


def test_a_fisheye_is_undone_by_its_formula():
    """OpenCV's documentation, "Fisheye camera model"."""
    k = np.array([0.05, -0.01, 0.002, 0.0])
    camera = Camera(30.0, 31.0, 31.5, 23.5, 64, 48)
    rays = pixel_rays(camera, k, fisheye=True)
    r = np.hypot(rays[..., 0], rays[..., 1])
    theta = np.arctan(r)
    bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6) / np.maximum(r, 1e-12)
    seen = np.isfinite(bent)
    assert seen.mean() > 0.9
    u, v = 30 * rays[..., 0] * bent + 31.5, 31 * rays[..., 1] * bent + 23.5
    np.testing.assert_allclose(u[seen], np.broadcast_to(np.arange(64), (48, 64))[seen], atol=0.1)
    np.testing.assert_allclose(v[seen], np.broadcast_to(np.arange(48)[:, None], (48, 64))[seen], atol=0.1)
    # The pinhole's image takes each pixel from where the lens has its ray.
    maps = undistortion(camera, k, fisheye=True)
    x, y = (50 - 31.5) / 30, (40 - 23.5) / 31
    r = np.hypot(x, y)
    theta = np.arctan(r)
    bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6) / r
    assert maps.column[40, 50] == pytest.approx(30 * x * bent + 31.5, abs=1e-3)
    assert maps.row[40, 50] == pytest.approx(31 * y * bent + 23.5, abs=1e-3)


def test_the_imu_is_on_the_frames_clock(tmp_path):
    read = registry.load_recording(recorded(tmp_path))
    assert read.imu is not None
    np.testing.assert_allclose(read.imu.t, 0.01 * np.arange(9), atol=1e-9)
    np.testing.assert_allclose(read.imu.acceleration_body, [force for _, force, _ in READINGS])
    # The gyroscope's readings are 11 us later.
    np.testing.assert_allclose(read.imu.omega_body[1:8, 1], 0.01 * (np.arange(1, 8) - 0.0011), atol=1e-6)
    np.testing.assert_allclose(read.T_body_cam, T_IMU_DEPTH @ np.linalg.inv(T_COLOR_DEPTH), atol=1e-9)
    assert (
        "no IMU in the file" in registry.load_recording(recorded(tmp_path, drop=("IMU",), readings=[])).notes
    )


def test_what_cannot_be_used_is_named(tmp_path):
    stated = azure_kinect.calibration(T_COLOR_DEPTH, T_IMU_DEPTH)
    for changes, message in (
        ({"drop": ("DEPTH",)}, "expected tracks COLOR and DEPTH, got COLOR, IMU"),
        ({"drop": ("calibration",)}, "expected calibration.json attached, got none"),
        ({"stated": stated[:50]}, "calibration.json:1: expected a calibration, got"),
        (
            {"stated": stated.replace(b"PV0", b"PV1")},
            "expected a camera CALIBRATION_CameraLocationPV0, got none",
        ),
        ({"stated": stated.replace(b"BrownConrady", b"Theta")}, "ModelType: expected one of"),
        ({"stated": stated.replace(b'"Rotation": [1.0', b'"Rotation": [7.0')}, "Rt: expected a rotation"),
        ({"counts": [np.zeros(azure_kinect.DEPTH[::-1], np.uint16)] * COUNT}, "expected depth, got only 0"),
    ):
        with pytest.raises(DataError, match=message):
            registry.load_recording(recorded(tmp_path, **changes))
    whole = recorded(tmp_path).read_bytes()
    for share in (0.2, 0.9):
        (tmp_path / "walk.mkv").write_bytes(whole[: int(share * len(whole))])
        try:
            read = registry.load_recording(tmp_path / "walk.mkv")
            [read.read(i) for i in range(len(read.t))]
        except DataError as error:
            assert "\n" not in str(error) and "walk.mkv: expected" in str(error)
