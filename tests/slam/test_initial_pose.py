"""Where the first camera stands in the world: by ground truth, or upright by what an accelerometer reads."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.datasets.types import Accelerometer, Recording
from jaxpose.geometry.camera import Camera
from jaxpose.imu import Imu
from jaxpose.slam.initial_pose import first_force, first_pose

G = 9.80665
START = 7.0  # [s] of the first frame
T = START + np.arange(-1000, 1001) / 200
MOUNTING = np.eye(4)
MOUNTING[:3, :3] = Rotation.from_rotvec([0.4, 1.0, -0.6]).as_matrix()
MOUNTING[:3, 3] = 0.1, 0.2, -0.1
RATE_BODY = np.array([0.5, -0.3, 0.4])  # [rad/s]


def turning(first, gravity_world=(0.0, 0.0, -G), bias=(0.0, 0.0, 0.0)):
    """Readings of a body that turns steadily, `first` (`R_world_body`) at the first frame."""
    R_world_body = first * Rotation.from_rotvec((T - START)[:, None] * RATE_BODY)
    force = R_world_body.inv().apply(-np.asarray(gravity_world))
    return Imu(T, np.tile(RATE_BODY + bias, (len(T), 1)), force)


def recording(**known):
    no_image = lambda i: pytest.fail("no image is needed")
    return Recording("r", Camera(1.0, 1.0, 0.0, 0.0, 1, 1), START + np.arange(5) / 5, no_image, **known)


def camera_seen_from(heading_deg, down_deg, roll_deg):
    """`R_world_cam` of a camera turned from x to the left, bent down, and rolled."""
    level = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along x, its y down
    turn = Rotation.from_euler("ZYX", [heading_deg, down_deg, roll_deg], degrees=True)
    return turn.as_matrix() @ level


def test_the_truth_comes_first():
    T_world_cam = np.tile(np.eye(4), (5, 1, 1))
    T_world_cam[:, :3, 3] = 1.0, 2.0, 3.0
    imu = turning(Rotation.identity())
    found = first_pose(recording(T_world_cam=T_world_cam, imu=imu))
    np.testing.assert_array_equal(found.T_world_cam, T_world_cam[0])
    assert found.notes == ()
    T_world_cam[0] = np.nan
    assert "upright" in first_pose(recording(T_world_cam=T_world_cam, imu=imu)).notes[0]


@pytest.mark.parametrize("heading_deg", [0.0, 130.0])
def test_a_camera_stands_as_it_was_held_but_for_its_heading(heading_deg):
    R_world_cam = camera_seen_from(heading_deg, 35.0, -20.0)
    R_world_body = Rotation.from_matrix(R_world_cam @ MOUNTING[:3, :3].T)
    found = first_pose(recording(imu=turning(R_world_body), T_body_cam=MOUNTING))
    np.testing.assert_allclose(found.T_world_cam[:3, :3], camera_seen_from(0.0, 35.0, -20.0), atol=1e-4)
    np.testing.assert_array_equal(found.T_world_cam[:3, 3], np.zeros(3))


def test_a_gyroscope_s_bias_turns_before_and_after_alike():
    R_world_cam = camera_seen_from(0.0, 35.0, -20.0)
    imu = turning(Rotation.from_matrix(R_world_cam), bias=(0.03, -0.02, 0.03))
    up = first_pose(recording(imu=imu)).T_world_cam[:3, :3].T[:, 2]
    assert np.rad2deg(np.arccos(up @ R_world_cam[2])) < 0.1  # the bias turns by 5.4 degrees in 2 s
    after = imu.t >= START
    late = Imu(imu.t[after], imu.omega_body[after], imu.acceleration_body[after])
    up = first_pose(recording(imu=late)).T_world_cam[:3, :3].T[:, 2]
    assert 0.5 < np.rad2deg(np.arccos(up @ R_world_cam[2])) < 3


@pytest.mark.parametrize("down_deg", [-90.0, 90.0])
def test_a_camera_that_looks_straight_up_or_down(down_deg):
    imu = turning(Rotation.from_matrix(camera_seen_from(40.0, down_deg, 0.0)))
    R_world_cam = first_pose(recording(imu=imu)).T_world_cam[:3, :3]
    np.testing.assert_allclose(R_world_cam[:, 2], [0, 0, -np.sign(down_deg)], atol=1e-4)
    np.testing.assert_allclose(R_world_cam[:, 1], [-1, 0, 0], atol=1e-4)  # the upper edge ahead


@pytest.mark.parametrize("gravity_world", [(0.0, G, 0.0), (-G, 0.0, 0.0)])
def test_gravity_points_where_the_recording_says(gravity_world):
    gravity_world = np.array(gravity_world)
    first = Rotation.from_rotvec([0.7, -0.2, 0.5])
    found = first_pose(recording(imu=turning(first, gravity_world), gravity_world=gravity_world))
    down_cam = first.inv().apply(gravity_world)
    np.testing.assert_allclose(found.T_world_cam[:3, :3] @ down_cam, gravity_world, atol=1e-3)
    assert np.linalg.det(found.T_world_cam[:3, :3]) == pytest.approx(1)


def test_an_accelerometer_alone_is_taken_around_the_frame():
    R_world_cam = camera_seen_from(0.0, 35.0, -20.0)
    force = np.where(np.abs(T - START)[:, None] < 0.51, R_world_cam.T @ [0, 0, G], [0.0, 0.0, 100.0])
    found = first_pose(recording(accelerometer=Accelerometer(T, force)))
    np.testing.assert_allclose(found.T_world_cam[:3, :3], R_world_cam, atol=1e-12)


def test_readings_that_hold_no_gravity_tell_nothing():
    imu = turning(Rotation.identity())
    in_g = imu._replace(acceleration_body=imu.acceleration_body / G)
    before = Imu(imu.t - 20, *imu[1:])
    for known in ({}, {"imu": in_g}, {"imu": before}, {"accelerometer": Accelerometer(before.t, before[2])}):
        found = first_pose(recording(**known))
        np.testing.assert_array_equal(found.T_world_cam, np.eye(4))
        assert found.notes == ("the world's frame is the first camera's",)
    assert first_force(recording(imu=before)) is None
