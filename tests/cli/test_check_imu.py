"""`jaxpose check` on readings and ground truth: faults put into some that are right, each named."""

from typing import Any

import numpy as np
import pytest
from helpers.checks import FLIP, T0_NS, checked, faults, inverted, named_tests
from scipy.spatial.transform import Rotation

from jaxpose.cli.check import command as check
from jaxpose.cli.check.command import Config, exit_code


def turning(t):
    angles = np.stack([0.6 * np.sin(1.1 * t), 0.4 * np.sin(1.7 * t + 1), 1.5 * np.sin(0.5 * t)], -1)
    return Rotation.from_euler("xyz", angles)


def position(t):
    return np.stack([np.sin(t), 0.5 * np.cos(0.8 * t), 0.2 * np.sin(2 * t)], -1)


def acceleration(t):
    return np.stack([-np.sin(t), -0.32 * np.cos(0.8 * t), -0.8 * np.sin(2 * t)], -1)


def euroc(folder, *, change=lambda T: T, gyro=1.0, force=1.0, late_s=0.0, roll=0, mounting=None, ns=10**9):
    """An ASL folder of 30 s: readings at 100 Hz, ground truth at 50 Hz, faults as they are asked for."""
    t, h = np.arange(0, 30, 0.01), 1e-4
    omega = (turning(t - h).inv() * turning(t + h)).as_rotvec() / (2 * h) + [0.01, -0.02, 0.05]
    up = acceleration(t) + [0, 0, 9.81]
    forces = turning(t).inv().apply(up)
    if mounting is not None:
        omega, forces = mounting.inv().apply(omega), mounting.inv().apply(forces)
    rows = np.column_stack([gyro * omega, force * forces])
    write_csv(folder / "mav0/imu0/data.csv", t + late_s, rows, ns)
    (folder / "mav0/imu0/sensor.yaml").write_text(
        "T_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
        "gyroscope_noise_density: 1e-4\ngyroscope_random_walk: 1e-5\n"
        "accelerometer_noise_density: 1e-3\naccelerometer_random_walk: 1e-4\n"
    )
    t = np.arange(0, 30, 0.02)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turning(t).as_matrix(), position(t)
    T = change(T)
    wxyz = np.roll(Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True), roll, axis=1)
    rows = np.column_stack([T[:, :3, 3], wxyz, np.zeros((len(t), 9))])
    write_csv(folder / "mav0/state_groundtruth_estimate0/data.csv", t, rows, ns)
    return folder


def write_csv(file, t, rows, ns):
    file.parent.mkdir(parents=True)
    timestamps = [(T0_NS + round(s * 1e9)) // (10**9 // ns) for s in t]
    lines = [
        ",".join(map(str, [timestamp, *row]))
        for timestamp, row in zip(timestamps, rows.tolist(), strict=True)
    ]
    file.write_text("#timestamp [ns],...\n" + "\n".join(lines) + "\n")


def test_a_good_imu_has_no_fault(tmp_path):
    result = checked(euroc(tmp_path))
    assert result.format.startswith("EuRoC") and faults(result) == ""
    numbers: dict[str, Any] = {
        k: v for f in result.facts if f.name == "IMU and poses" for k, v in f.numbers.items()
    }
    assert numbers["correlation"] > 0.999 and abs(numbers["offset_s"]) < 1e-3
    assert numbers["rotation_deg"] < 0.5 and numbers["gyro_ratio"] == pytest.approx(1, abs=0.01)
    assert numbers["gyro_bias"] == pytest.approx(np.linalg.norm([0.01, -0.02, 0.05]), abs=5e-3)


@pytest.mark.parametrize(
    ("fault", "test", "words"),
    [
        ({"gyro": 180 / np.pi}, "gyroscope unit", "in deg/s"),
        ({"force": 1 / 9.80665}, "accelerometer unit", "in g; multiply by 9.80665"),
        ({"force": -1.0}, "gravity", "change the sign"),
        ({"late_s": 0.05}, "clock offset", "50.0 ms late"),
        ({"late_s": -0.3}, "clock offset", "300.0 ms early"),
        ({"change": inverted}, "IMU and poses", "invert the poses"),
        ({"roll": -1}, "quaternion order", "quaternions in the order xyzw"),
        ({"change": lambda T: FLIP @ T}, "gravity", "down"),
    ],
)
def test_faults_of_an_imu_are_named(tmp_path, fault, test, words):
    result = checked(euroc(tmp_path, **fault))
    assert test in named_tests(result) and words in faults(result), faults(result)
    assert exit_code(result) == 2


def test_microseconds_are_read_and_said(tmp_path):
    result = checked(euroc(tmp_path, ns=10**6))
    assert faults(result) == ""
    assert sum("timestamps are in us, by their size and steps" in note for note in result.notes) == 2


def test_a_turned_imu_is_named_with_its_rotation(tmp_path):
    mounting = Rotation.from_euler("z", 90, degrees=True)
    result = checked(euroc(tmp_path, mounting=mounting))
    assert "IMU rotation" in named_tests(result) and "90.0 deg" in faults(result)
    assert "[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]" in faults(result).replace("-0.0", "0.0")


def test_truth_of_motion_capture_is_read(tmp_path):
    folder = euroc(tmp_path, late_s=0.05) / "mav0"
    (folder / "state_groundtruth_estimate0").rename(folder / "mocap0")
    rows = [line.split(",")[:8] for line in (folder / "mocap0/data.csv").read_text().splitlines()]
    (folder / "mocap0/data.csv").write_text("\n".join(map(",".join, rows)))
    assert named_tests(checked(tmp_path)) == ["clock offset"]


def test_without_truth_the_readings_are_still_checked(tmp_path):
    folder = euroc(tmp_path) / "mav0"
    (folder / "state_groundtruth_estimate0/data.csv").unlink()
    result = checked(tmp_path)
    assert faults(result) == "" and any("no ground truth to compare" in note for note in result.notes)
    (folder / "imu0/data.csv").unlink()
    (folder / "imu0/sensor.yaml").unlink()
    assert exit_code(checked(tmp_path)) == 1


def without_truth(folder):
    (folder / "mav0/state_groundtruth_estimate0/data.csv").unlink()
    return folder


def swapped(folder):
    file = folder / "mav0/imu0/data.csv"
    head, *lines = file.read_text().splitlines()
    rows = [line.split(",") for line in lines]
    file.write_text("\n".join([head, *(",".join([r[0], *r[4:], *r[1:4]]) for r in rows)]))
    return folder


def weightless(folder):
    file, t = folder / "mav0/imu0/data.csv", np.arange(0, 30, 0.01)
    head, *lines = file.read_text().splitlines()
    rows = [line.split(",")[:4] for line in lines]
    forces = turning(t).inv().apply(acceleration(t)).tolist()
    text = [",".join([*row, *map(str, f)]) for row, f in zip(rows, forces, strict=True)]
    file.write_text("\n".join([head, *text]))
    return folder


@pytest.mark.parametrize(
    ("fault", "change", "test", "words"),
    [
        ({}, None, None, ""),
        ({"gyro": 180 / np.pi}, None, "gyroscope unit", "in deg/s"),
        ({"force": 1 / 9.80665}, None, "accelerometer unit", "in g; multiply by 9.80665"),
        ({"force": -1 / 9.80665}, None, "accelerometer unit", "in g; multiply by 9.80665"),
        ({}, swapped, "gyroscope and accelerometer", "swap the columns"),
        ({}, weightless, "gravity", "gravity was removed"),
    ],
)
def test_readings_alone_say_what_is_wrong_with_them(tmp_path, fault, change, test, words):
    folder = without_truth(euroc(tmp_path, **fault))
    file = (change(folder) if change else folder) / "mav0/imu0/data.csv"
    for result in (checked(folder), checked(file)):
        assert named_tests(result) == ([test] if test else []) and words in faults(result), faults(result)
    assert checked(file).format == "IMU readings"


def test_an_imu_file_of_ones_own_beside_poses(tmp_path):
    folder = euroc(tmp_path, force=-1.0) / "mav0"
    poses, readings = folder / "state_groundtruth_estimate0/data.csv", folder / "imu0/data.csv"
    result = check.run(Config(poses, imu_file=readings))
    assert named_tests(result) == ["gravity"] and "change the sign" in faults(result)
    assert "mounting not stated" in " ".join(fact.text for fact in result.facts)


def test_gaps_are_no_clean_bill(tmp_path):
    file = euroc(tmp_path) / "mav0/imu0/data.csv"
    lines = file.read_text().splitlines()
    lines[7] = lines[7].replace(",", ",nan,", 1).rsplit(",", 1)[0]
    file.write_text("\n".join([*lines, lines[-1]]))
    result = checked(tmp_path)
    assert named_tests(result) == ["missing readings"] and "2 of 3001 lines" in faults(result)


def test_readings_a_century_apart_take_no_more_room_than_others(tmp_path):
    folder = without_truth(euroc(tmp_path))
    file = folder / "mav0/imu0/data.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines, "4500000000000000000," + lines[-1].split(",", 1)[1]]))
    assert "gaps" in " ".join(checked(folder).notes) + faults(checked(folder))


@pytest.mark.parametrize("count", [1, 2])
def test_poses_that_are_too_few_to_test_readings_are_told(tmp_path, count):
    file = euroc(tmp_path) / "mav0/state_groundtruth_estimate0/data.csv"
    file.write_text("\n".join(file.read_text().splitlines()[: 1 + count]) + "\n")
    assert "overlap too little with the IMU" in " ".join(checked(tmp_path).notes)
