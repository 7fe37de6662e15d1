"""README's accuracy, measured anew: each command with its defaults, against the range that README states.

What would take an hour is cut short here, and held to what the same command had reached by then; the whole of
it is marked `hour`. Records with seeds and ranges are in experiments/.
"""

import json

import pytest

from jaxpose.experiments import imu_slam, rgbd_slam
from jaxpose.experiments.event_nerf import pipeline as event_nerf
from jaxpose.experiments.noisy_nerf import pipeline as noisy_nerf
from jaxpose.experiments.planar import pipeline as planar

pytestmark = pytest.mark.slow


def test_the_room(tmp_path):
    results = imu_slam.run(imu_slam.Config(out=tmp_path / "run")).results
    assert results["frames"] == 61 and results["frames_lost"] == 0
    assert results["ate_rmse_m"] < 0.001  # README: 0.06 cm; 0.052 to 0.063 over 3 seeds
    stored = json.loads((tmp_path / "run" / "results.json").read_text())
    assert stored["ate_rmse_m"] == results["ate_rmse_m"]


@pytest.mark.data
@pytest.mark.parametrize(
    ("rate_hz", "frames"),
    [
        pytest.param(None, 400, marks=pytest.mark.hour),
        pytest.param(5.0, 67, marks=pytest.mark.hour),
        (2.0, 27),
    ],
)
def test_a_real_clip(data_dir, tmp_path, rate_hz, frames):
    """7-Scenes RedKitchen without an IMU; README: 2.31 to 2.47 cm over 3 seeds, at every rate."""
    config = rgbd_slam.Config(data=data_dir / "7scenes_redkitchen", rate_hz=rate_hz, out=tmp_path / "run")
    results = rgbd_slam.run(config).results
    assert results["frames"] == frames and results["frames_lost"] == 0
    assert results["ate_rmse_m"] < 0.026


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rate_hz", "frames", "ate_m"),
    [
        ("hololens_walk", None, 123, 0.036),  # a walk at a rate that nobody has told
        pytest.param("tum_fr1_rpy_first8s", None, 120, 0.030, marks=pytest.mark.hour),
        ("tum_fr1_rpy_first8s", 7.5, 60, 0.030),  # up to 260 deg/s
        ("icl_nuim_kt3", None, 50, 0.004),
    ],
)
def test_recordings_of_other_hands_and_sensors(data_dir, tmp_path, name, rate_hz, frames, ate_m):
    """Without an IMU, with the defaults: nothing lost, and no worse than experiments/README.md records."""
    config = rgbd_slam.Config(data=data_dir / name, rate_hz=rate_hz, out=tmp_path / "run")
    results = rgbd_slam.run(config).results
    assert results["frames"] == frames and results["frames_lost"] == 0
    assert results["ate_rmse_m"] < ate_m


@pytest.mark.data
def test_a_real_clip_with_an_imu(data_dir, tmp_path):
    config = imu_slam.Config(data=data_dir / "7scenes_redkitchen", rate_hz=2.0, out=tmp_path / "run")
    results = imu_slam.run(config).results
    assert results["frames_lost"] == 0 and results["ate_rmse_m"] < 0.0245  # README: 2.21 to 2.26 cm


@pytest.mark.parametrize(
    ("steps", "degrees", "percent"),
    [
        (500, 0.4, 0.25),
        pytest.param(4000, 0.2, 0.12, marks=pytest.mark.hour),  # README: 0.14 deg, 0.05%
    ],
)
def test_cameras_a_fifth_of_the_orbit_away_are_found(tmp_path, steps, degrees, percent):
    results = noisy_nerf.run(noisy_nerf.Config(steps=steps, test_pose_steps=0, out=tmp_path / "run")).results
    assert results["start"]["rotation_error_deg"] > 10 and results["start"]["translation_error_percent"] > 10
    assert results["rotation_error_deg"] < degrees and results["translation_error_percent"] < percent


@pytest.mark.hour
def test_a_turntable_known_at_ten_instants(tmp_path):
    results = event_nerf.run(event_nerf.Config(out=tmp_path / "run")).results
    assert results["start"]["translation_error"] == pytest.approx(0.0938, abs=1e-4)  # README: 0.094
    assert results["translation_error"] < 0.055  # README: 0.032 (0.028 to 0.051 over 3 seeds)


@pytest.mark.data
def test_patches_of_a_photograph_find_their_places(data_dir, tmp_path):
    """README: 20 of 20 motions of seed 0 end within 0.001 px; here the first two."""
    config = planar.Config(image=data_dir / "planar" / "cat.jpg", motions=2, out=tmp_path / "run")
    results = planar.run(config).results
    assert results["success_rate"] == 1 and results["corner_error_px"]["max"] < 0.01
