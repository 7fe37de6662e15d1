"""Kalibr's camchain: what is written is a YAML file that says the same, and what others wrote is read."""

import numpy as np
import pytest

from jaxpose.datasets.rgbd.imu_csv import read_mounting
from jaxpose.errors import DataError
from jaxpose.files.kalibr import CameraImu, read_camchain, write_camchain
from jaxpose.geometry import rigid

# the layout of Kalibr's own output, with numbers of our own
THEIRS = """cam0:
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.01]
  - [0.0, 0.0, -1.0, -0.02]
  - [1.0, 0.0, 0.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  timeshift_cam_imu: -0.0071
cam1:
  T_cam_imu:
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: 0.5
"""


def test_the_first_camera_of_a_chain_is_read(tmp_path):
    file = tmp_path / "camchain.yaml"
    file.write_text(THEIRS)
    T_body_cam, offset_s = read_camchain(file)
    # x of the camera is -y of the IMU, y is -z, z is x; its origin follows
    np.testing.assert_allclose(T_body_cam[:3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(T_body_cam[:3, 3], [-0.03, 0.01, -0.02], atol=1e-12)
    assert offset_s == -0.0071
    np.testing.assert_array_equal(read_mounting(file).T_body_cam, T_body_cam)
    assert read_mounting(file).offset_s == offset_s


def test_what_is_written_is_read(tmp_path):
    found = CameraImu(rigid.exp(np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])), 0.0123)
    write_camchain(tmp_path / "chain.yaml", found)
    again = read_camchain(tmp_path / "chain.yaml")
    np.testing.assert_allclose(again.T_body_cam, found.T_body_cam, atol=1e-10)
    assert again.offset_s == found.offset_s
    lines = (tmp_path / "chain.yaml").read_text().splitlines()
    assert lines[0] == "cam0:" and lines[1] == "  T_cam_imu:" and lines[-1] == "  timeshift_cam_imu: 0.0123"


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("- [0.0, -1.0, 0.0, 0.01]", "- [0.0, -1.0, 0.0]", "T_cam_imu: expected 4x4 finite numbers, got [["),
        (
            "- [0.0, -1.0, 0.0, 0.01]",
            "- [0.0, -2.0, 0.0, 0.01]",
            "expected T_cam_imu to be a rigid transform",
        ),
        (
            "- [0.0, -1.0, 0.0, 0.01]",
            "- [0.0, nan, 0.0, 0.01]",
            "T_cam_imu: expected 4x4 finite numbers, got nan",
        ),
        (
            "timeshift_cam_imu: -0.0071",
            "timeshift_cam_imu: soon",
            "timeshift_cam_imu: expected a finite number from -1e+06 to 1e+06, got 'soon'",
        ),
    ],
)
def test_what_is_no_chain_is_refused(tmp_path, old, new, complaint):
    file = tmp_path / "camchain.yaml"
    file.write_text(THEIRS.replace(old, new))
    with pytest.raises(DataError) as error:
        read_camchain(file)
    assert str(error.value).startswith(f"{file}: {complaint}")
