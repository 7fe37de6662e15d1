"""Poses in UTM coordinates: worked on near the origin, and back without a digit lost."""

import numpy as np
from helpers.checks import AROUND

from jaxpose.datasets.origin import far_origin, moved
from jaxpose.datasets.types import Recording
from jaxpose.experiments.slam.source import _near_origin
from jaxpose.geometry.camera import Camera

UTM = np.array([453_217.123456789, 5_411_932.987654321, 312.5])


def test_far_poses_come_near_and_go_back_with_all_digits():
    far = moved(AROUND.T, UTM)
    far[3] = np.nan
    origin = far_origin(far, 1e3)
    near = moved(far, -origin)
    assert np.nanmax(np.abs(near[:, :3, 3])) < 10 and (origin == np.round(origin)).all()
    np.testing.assert_array_equal(moved(near, origin), far)
    assert not far_origin(AROUND.T, 1e3).any() and not far_origin(None, 1e3).any()
    assert not far_origin(np.full((2, 4, 4), np.nan), 1e3).any()


def test_a_recording_far_away_is_tracked_near_the_origin():
    camera, read = Camera(1.0, 1.0, 0.0, 0.0, 1, 1), lambda i: None
    recording = Recording("far", camera, AROUND.t - AROUND.t[0], read, moved(AROUND.T, UTM))  # pyright: ignore
    found, origin = _near_origin(recording)
    assert found.T_world_cam is not None and np.abs(found.T_world_cam[:, :3, 3]).max() < 10
    np.testing.assert_array_equal(moved(found.T_world_cam, origin), recording.T_world_cam)
    assert "relative to 453219 5411933 314" in found.notes[0]
    near, none = _near_origin(recording._replace(T_world_cam=AROUND.T))
    assert near.T_world_cam is AROUND.T and near.notes == () and not none.any()
