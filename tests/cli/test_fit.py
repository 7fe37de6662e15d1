"""`jaxpose fit`: a known motion, known sensors; what it measures is what was put in."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.cli import main as main_command
from jaxpose.cli.fit import candidates as fit_candidates
from jaxpose.cli.fit import command as fit
from jaxpose.cli.fit.command import Config
from jaxpose.fields import numpy_evaluator
from jaxpose.files import trajectories

SPAN = 20.0  # s
HZ = 1.2  # of the position's fastest part
TILT = Rotation.from_euler("xyz", [10, -20, 0], degrees=True)  # of the world against the vertical
GYRO_BIAS = np.array([0.01, -0.02, 0.03])
DENSITIES = 2e-4, 3e-3


def position(t):
    return np.stack([np.sin(t), 0.1 * np.sin(2 * np.pi * HZ * t), 0.3 * np.cos(0.7 * t)], -1)


def acceleration(t):
    rates = np.array([1.0, 2 * np.pi * HZ, 0.7])
    return -(rates**2) * position(t)


def turn(t):
    """About a fixed axis, so that the body rate is the derivative of the angle times the axis."""
    return 0.8 * np.sin(0.9 * t)[:, None] * np.array([0.6, 0.0, 0.8])


def rate(t):
    return 0.72 * np.cos(0.9 * t)[:, None] * np.array([0.6, 0.0, 0.8])


def poses(t):
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(turn(t)).as_matrix(), position(t)
    return T


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A TUM file at 50 Hz and an EuRoC folder at 200 Hz, which begins a second later.

    Timestamps since 1970.
    """
    folder = tmp_path_factory.mktemp("fit")
    t0 = 1_403_715_524.0
    t = np.arange(0, SPAN, 0.02)
    trajectories.write_tum(folder / "ground truth.txt", trajectories.Trajectory(t0 + t, poses(t)))
    rng = np.random.default_rng(0)
    t = np.arange(1, SPAN + 1, 0.005)
    sigmas = [density * np.sqrt(200) for density in DENSITIES]
    gyro = rate(t) + GYRO_BIAS + sigmas[0] * rng.normal(size=(len(t), 3))
    gravity = TILT.apply([0, 0, -9.81])
    force = Rotation.from_rotvec(turn(t)).inv().apply(acceleration(t) - gravity)
    force += sigmas[1] * rng.normal(size=(len(t), 3))
    imu = folder / "mav0" / "imu0"
    imu.mkdir(parents=True)
    timestamps = [int(t0) * 10**9 + round(s * 1e9) for s in t]
    rows = [
        ",".join([str(timestamp), *map(repr, (*w.tolist(), *a.tolist()))])
        for timestamp, w, a in zip(timestamps, gyro, force, strict=True)
    ]
    (imu / "data.csv").write_text("#timestamp [ns],w,a\n" + "\n".join(rows) + "\n")
    (imu / "sensor.yaml").write_text(
        "T_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
        f"gyroscope_noise_density: {DENSITIES[0]}\ngyroscope_random_walk: 0.0\n"
        f"accelerometer_noise_density: {DENSITIES[1]}\naccelerometer_random_walk: 0.0\n"
    )
    return folder


def small(folder, **changes):
    config = Config(
        folder / "ground truth.txt", posenet_octaves=(2,), posenet_layers=3, posenet_width=32, steps=300
    )
    return replace(config, bspline_hz=(1.0, 10.0), **changes)


@pytest.fixture(scope="module")
def result(recording):
    return fit.run(small(recording, imu=recording, out=recording / "best.npz"))


def test_the_fields_are_what_was_asked_for(result):
    names = [field.name for field in result.fields]
    assert names == ["PoseNet F=2 3x32", "B-spline 1 knots/s", "B-spline 10 knots/s"]
    assert (result.poses, result.held_out) == (1000, 100)
    assert result.fields[2].parameters == 7 * (round(10 * result.span_s) + 3)
    assert result.span_s == pytest.approx(SPAN - 0.02, abs=1e-4) and result.rate_hz == pytest.approx(50)


def test_the_fast_spline_is_best_and_the_slow_one_too_slow(result):
    slow, fast = result.fields[1:]
    assert result.best == fast.name
    assert fast.translation_m.median < 5e-4 and fast.rotation_deg.median < 0.02
    assert slow.translation_m.median > 0.03  # half of the 0.1 m at 1.2 Hz, which it cannot follow
    assert slow.name in result.too_slow and fast.name not in result.too_slow


def test_readings_are_explained_to_their_noise(result):
    sensor, inertial = result.sensor, result.fields[2].inertial
    assert sensor.stated == pytest.approx([density * np.sqrt(200) for density in DENSITIES])
    assert sensor.measured == pytest.approx(sensor.stated, rel=0.05)
    assert inertial.omega_rms < 1.5 * sensor.stated[0]
    assert inertial.samples == sensor.readings == 3797  # of 4000: from 1 s to the last pose at 19.98 s
    assert np.abs(inertial.gyro_bias - GYRO_BIAS).max() < 1e-3
    assert np.abs(inertial.gravity_world - TILT.apply([0, 0, -9.81])).max() < 0.1
    assert any("203 of 4000 inertial readings" in note for note in result.notes)


def test_the_written_field_is_the_best_one(result, recording):
    t = np.array([3.3, 7.77])
    T = numpy_evaluator.load(recording / "best.npz")(1_403_715_524.0 + t)
    assert np.abs(T - poses(t)).max() < 2e-3


@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_bandwidth_is_that_of_the_motion(noise_m):
    t = np.arange(0, 60, 0.01)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, 0, 3] = 0.2 * np.sin(2 * np.pi * 1.5 * t)
    T[:, :3, 3] += noise_m * np.random.default_rng(0).normal(size=(len(t), 3))
    assert fit_candidates.bandwidth_hz(trajectories.Trajectory(t, T)) == pytest.approx(1.5, abs=0.15)


def test_the_report_and_its_json(result, recording, capsys):
    text = fit.report(result)
    assert "| B-spline 10 knots/s |" in text and re.search(r"best +\|", text) and "too slow" in text
    assert "95% of the power" in text and "every tenth" in text and "biases and gravity fitted" in text
    tiny = ["--posenet-octaves", "0", "--posenet-layers", "1", "--bspline-hz", "--steps", "9"]
    main_command.main(["fit", str(recording / "ground truth.txt"), *tiny, "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["best"] == "PoseNet F=0 1x256" and said["fields"][0]["rotation_deg"]["median"] > 0


def test_formats_without_stamps_need_a_rate(tmp_path):
    t = np.arange(0, 10, 0.1)
    trajectories.write_kitti(tmp_path / "kitti.txt", poses(t))
    config = Config(
        tmp_path / "kitti.txt",
        recorded_hz=10.0,
        posenet_octaves=(0,),
        posenet_layers=1,
        bspline_hz=(8.0,),
        steps=9,
    )
    result = fit.run(config)
    assert result.span_s == pytest.approx(9.9) and len(result.fields) == 1
    assert any("no B-spline of 8 knots/s" in note for note in result.notes)


@pytest.mark.data
@pytest.mark.slow
def test_real_motion_is_carried_to_millimetres(data_dir):
    file = data_dir / "trajectories" / "tum_vi" / "dataset-room1_512_16.csv"
    result = fit.run(Config(file, posenet_octaves=(), bspline_hz=(10.0,), steps=500))
    (field,) = result.fields
    assert field.translation_m.median < 5e-3 and field.rotation_deg.median < 0.2


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["nowhere.txt"], r"nowhere.txt: expected a trajectory file or a run folder, got nothing"),
        (["short.txt"], r"short.txt.*expected at least 20 poses to fit, got 5"),
        (["kitti.txt"], r"kitti.txt: expected --recorded-hz"),
        (["ground truth.txt", "--recorded-hz", "5"], r"ground truth.txt: expected no --recorded-hz"),
        (["ground truth.txt", "--imu", "nowhere"], r"nowhere: expected a folder in the EuRoC"),
        (["ground truth.txt", "--bspline-hz", "-1"], r"--bspline-hz: expected a positive number, got -1"),
        (["ground truth.txt", "--posenet-octaves", "--bspline-hz"], r"--bspline-hz: expected a field to fit"),
        (["ground truth.txt", "--imu", "late"], r"late: expected an IMU on the clock of the poses"),
    ],
)
def test_bad_calls_are_one_line(args, expected, tmp_path, recording, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    t = np.arange(0, 4, 0.1)
    trajectories.write_tum("ground truth.txt", trajectories.Trajectory(t, poses(t)))
    trajectories.write_tum("short.txt", trajectories.Trajectory(t[:5], poses(t[:5])))
    trajectories.write_kitti("kitti.txt", poses(t))
    (tmp_path / "late").symlink_to(recording)
    with pytest.raises(SystemExit) as stop:
        main_command.main(["fit", *args])
    line = str(stop.value)
    assert line.startswith("jaxpose") and "\n" not in line and re.search(expected, line), line


def test_help_names_everything():
    done = subprocess.run(
        [sys.executable, "-m", "jaxpose", "fit", "--help"], capture_output=True, text=True, check=True
    )
    for word in ("TRAJECTORY", "--imu", "--posenet-octaves", "--bspline-hz", "--out"):
        assert word in done.stdout
