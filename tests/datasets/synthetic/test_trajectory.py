"""The room along a recorded motion: where the camera goes, its readings, their offset and filter."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.datasets.synthetic import RoomConfig, room, trajectory
from jaxpose.errors import DataError
from jaxpose.experiments.imu_slam import Config
from jaxpose.experiments.slam.source import load
from jaxpose.geometry import se3
from jaxpose.imu.simulation import simulate

T0 = 1403715523912140001
BIAS = np.array([0.02, -0.05, 0.08]), np.array([0.1, -0.2, 0.15])
SHEET = """%YAML:1.0
T_BS:
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
gyroscope_noise_density: 1.0e-4
gyroscope_random_walk: 1.0e-5
accelerometer_noise_density: 1.0e-3
accelerometer_random_walk: 1.0e-4
"""


def flight(t, *, height=1.5):
    """A circle of 1 m around (4, -3), turning with it and swaying in height; T_world_body, z up."""
    centre = jnp.stack([4 + jnp.cos(0.6 * t), -3 + jnp.sin(0.6 * t), height + 0.2 * jnp.sin(2 * t)])
    turn = jnp.stack([0.1 * jnp.sin(1.5 * t), 0.1 * jnp.cos(1.1 * t), 0.6 * t])
    return se3.make(se3.exp(jnp.concatenate([jnp.zeros(3), turn]))[:3, :3], centre)


def write(folder, *, height=1.5, first=0.5, seconds=5.0):
    """The flight in EuRoC's layout, the ground truth from `first` on, readings with a bias."""
    for name in ("imu0", "state_groundtruth_estimate0"):
        (folder / "mav0" / name).mkdir(parents=True)
    with jax.enable_x64(True):
        t = jnp.arange(0, seconds + 1e-9, 1 / 200)
        pose = lambda s: flight(s, height=height)
        imu, poses = jax.tree.map(np.asarray, jax.jit(lambda t: (simulate(pose, t), jax.vmap(pose)(t)))(t))
    omega, force = np.asarray(imu.omega_body) + BIAS[0], np.asarray(imu.acceleration_body) + BIAS[1]
    timestamps = [T0 + round(s * 1e9) for s in np.asarray(t).tolist()]
    readings = np.concatenate([omega, force], axis=1).tolist()
    rows = [",".join(map(repr, [s, *values])) for s, values in zip(timestamps, readings, strict=True)]
    (folder / "mav0/imu0/data.csv").write_text("#header\n" + "\n".join(rows) + "\n")
    (folder / "mav0/imu0/sensor.yaml").write_text(SHEET)
    quaternion = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), 1, axis=1)
    rows = [
        ",".join(map(repr, [s, *p[:3, 3].tolist(), *q, *[0.0] * 9]))
        for s, p, q in zip(timestamps, poses, quaternion.tolist(), strict=True)
        if (s - T0) / 1e9 >= first
    ]
    (folder / "mav0/state_groundtruth_estimate0/data.csv").write_text("#header\n" + "\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("flight") / "V9_99")


def test_the_motion_is_the_recorded_one_moved_to_the_middle_of_a_room_that_holds_it(flown):
    recording = room(RoomConfig(along=flown, duration_s=60.0, width=40, height=30))
    np.testing.assert_allclose(recording.t, np.arange(23) / 5, atol=1e-9)  # from 0.5 s to 4.9 s
    with jax.enable_x64(True):
        expected = np.asarray(jax.jit(jax.vmap(flight))(0.5 + jnp.asarray(recording.t)))
    found = recording.T_world_cam @ np.linalg.inv(recording.T_body_cam)
    moved = found[:, :3, 3] - expected[:, :3, 3]
    np.testing.assert_allclose(found[:, :3, :3], expected[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(moved, np.tile(moved[0], (23, 1)), atol=1e-6)  # and nothing else changed
    assert moved[0, 2] == pytest.approx(0, abs=1e-6)
    lower, upper = found[:, :3, 3].min(axis=0), found[:, :3, 3].max(axis=0)
    np.testing.assert_allclose((lower + upper)[:2], 0, atol=1e-9)
    flew = trajectory.recorded(flown, 60.0, 5.0)
    assert all(np.array(flew.room) / [2, 2, 1] >= upper + [1.4, 1.4, 1.1])
    assert "rendered" in recording.name and "V9_99" in recording.name and "rendered" in recording.notes[0]
    depth = recording.read(0).depth
    assert 0.5 < np.median(depth[depth > 0]) < 6


def test_readings_are_those_of_the_file_on_the_clock_of_the_frames(flown):
    imu = room(RoomConfig(along=flown, width=40, height=30)).imu
    with jax.enable_x64(True):
        expected = simulate(flight, 0.5 + jnp.asarray(imu.t))
        np.testing.assert_allclose(imu.omega_body, np.asarray(expected.omega_body) + BIAS[0], atol=1e-9)
        np.testing.assert_allclose(
            imu.acceleration_body, np.asarray(expected.acceleration_body) + BIAS[1], atol=1e-9
        )


@pytest.mark.slow
def test_a_filter_on_the_true_poses_takes_the_biases_off(flown):
    config = Config(room=RoomConfig(along=flown, duration_s=60.0, width=40, height=30), imu_filter=True)
    source = load(config)
    imu = source.recording.imu
    assert "Kalman" in source.imu and "true poses" in source.imu
    with jax.enable_x64(True):
        exact = simulate(flight, 0.5 + jnp.asarray(imu.t))
    late = np.asarray(imu.t) > 2.5
    off = np.abs(np.asarray(imu.omega_body) - np.asarray(exact.omega_body))[late]
    assert off.max() < 0.02 < 0.08 - 0.02  # of a bias of 0.08 rad/s
    off = np.abs(np.asarray(imu.acceleration_body) - np.asarray(exact.acceleration_body))[late]
    assert off.max() < 0.1


def test_an_offset_moves_the_stamps_and_only_those_of_real_readings(flown):
    moved = load(Config(room=RoomConfig(along=flown, width=40, height=30), imu_offset_s=0.03))
    np.testing.assert_allclose(
        moved.recording.imu.t - trajectory.recorded(flown, 5.0, 5.0).imu.t, 0.03, atol=1e-9
    )
    assert "+0.03 s" in moved.imu and "as read" in moved.imu
    for options in ({"imu_offset_s": 0.03}, {"imu_filter": True}):
        with pytest.raises(ValueError, match="--imu-.*: has no effect without --data or --room.along"):
            Config(**options)


def test_a_motion_that_no_room_can_hold_is_refused_in_one_line(tmp_path):
    with pytest.raises(DataError, match=r"low: expected a motion above the floor \(z = 0\), got z = 0\.0"):
        trajectory.recorded(write(tmp_path / "low", height=0.21), 5.0, 5.0)
    with pytest.raises(
        DataError, match="late: expected two frames at 5 Hz within IMU and ground truth, got 1"
    ):
        trajectory.recorded(write(tmp_path / "late", first=4.9), 5.0, 5.0)
    with pytest.raises(DataError, match="none/mav0/imu0|none.*expected"):
        trajectory.recorded(tmp_path / "none", 5.0, 5.0)
