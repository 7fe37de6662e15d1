"""A real IMU's file beside a recording: columns and clocks, the camera's place on it, what does not agree."""

import re
from functools import partial

import numpy as np
import pytest
from helpers import refused
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd import plain
from jaxpose.datasets.rgbd.imu_csv import imu_notes, read_imu, read_mounting, with_imu
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.experiments.imu_slam import Config, main
from jaxpose.experiments.slam.source import load
from jaxpose.geometry.camera import Camera
from jaxpose.slam.initial_pose import first_pose
from jaxpose.slam.tracking.predict import readings_between

T0_NS = 1_403_715_523_912_143_104  # of the first image, with ns that a float of seconds cannot hold
FIRST_IMAGE_NS = 1_403_715_523_912_143_230  # as times.txt has it
PERIOD_NS = 5_000_000
FIRST = -20  # readings before the first image
G = 9.80665
MOUNTING = np.eye(4)
MOUNTING[:3, :3] = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
MOUNTING[:3, 3] = 0.04, -0.02, 0.1


def times_ns(count=400):
    return [T0_NS + (FIRST + k) * PERIOD_NS for k in range(count)]


def readings(walk):
    """At rest in each frame's own attitude, so that the force is gravity's: rates and forces, 400 rows."""
    R_world_body = walk.T_world_cam[:, :3, :3] @ MOUNTING[:3, :3].T
    frame = np.clip(np.round((np.arange(400) + FIRST) / 50).astype(int), 0, 5)  # images every 0.25 s
    omega = np.random.default_rng(3).normal(size=(400, 3))
    return omega, np.einsum("nij,i->nj", R_world_body[frame], [0.0, 0.0, G])


def csv(path, ns, omega, force):
    rows = [[timestamp, *w, *f] for timestamp, w, f in zip(ns, omega.tolist(), force.tolist(), strict=True)]
    path.write_text("#timestamp [ns],w,w,w,a,a,a\n" + "\n".join(",".join(map(repr, row)) for row in rows))
    return path


@pytest.fixture
def desk(tmp_path, walk, save):
    """A plain folder with timestamps of 1970 and true poses, the IMU's csv and its mounting beside it."""
    folder = tmp_path / "desk"
    for i in range(6):
        save(folder / f"color/{i}.png", walk.rgb[i])
        save(folder / f"depth/{i}.png", walk.counts[i])
    (folder / "camera-intrinsics.txt").write_text("30 0 15.5\n0 31 11.5\n0 0 1\n")
    (folder / "times.txt").write_text("".join(f"{T0_NS * 1e-9 + 0.25 * i:.9f}\n" for i in range(6)))
    np.savetxt(folder / "poses.txt", walk.T_world_cam.reshape(6, 16), fmt="%.17g")
    csv(folder / "imu.csv", times_ns(), *readings(walk))
    np.savetxt(folder / "mounting.txt", MOUNTING, fmt="%.17g", header="T_body_cam")
    return folder


def config(desk, **options):
    return Config(data=desk, imu_file=desk / "imu.csv", imu_extrinsics=desk / "mounting.txt", **options)


def test_both_layouts_give_the_same_readings(desk, walk):
    omega, force = readings(walk)
    seconds = (np.arange(400) + FIRST) * 0.005
    text = desk / "imu.txt"
    np.savetxt(text, np.column_stack([seconds, omega, force]), fmt="%.17g", header="t w w w a a a")
    for file, t0_ns in (desk / "imu.csv", T0_NS), (text, 0):
        imu = read_imu(file).since(t0_ns)
        np.testing.assert_allclose(imu.t, seconds, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(imu.omega_body, omega)
        np.testing.assert_array_equal(imu.acceleration_body, force)


def test_readings_are_on_the_clock_of_the_frames_wherever_tracking_starts(desk, walk):
    whole, later = load(config(desk)), load(config(desk, start=2))
    np.testing.assert_allclose(whole.recording.imu.t, (np.arange(400) + FIRST) * 0.005, atol=5e-7)
    np.testing.assert_array_equal(later.recording.imu.t, whole.recording.imu.t)  # nothing is shifted again
    np.testing.assert_array_equal(later.recording.t, whole.recording.t[2:])
    assert later.recording.t0_ns == whole.recording.t0_ns == FIRST_IMAGE_NS
    np.testing.assert_array_equal(later.recording.imu.omega_body, readings(walk)[0])
    np.testing.assert_allclose(whole.recording.T_body_cam, MOUNTING, atol=1e-12)
    assert whole.imu == "200 Hz, of imu.csv, as read"
    assert not any("IMU" in note for note in whole.recording.notes)
    moved = load(config(desk, imu_offset_s=-0.02))
    np.testing.assert_allclose(moved.recording.imu.t - whole.recording.imu.t, -0.02, atol=1e-9)
    assert "-0.02 s" in moved.imu


def test_one_sample_from_its_file_to_the_tracker_has_one_time(desk):
    """Whole ns in the file, seconds since the recording's origin from there on, wherever tracking starts."""
    recording = load(config(desk, start=1, rate_hz=2.0)).recording
    assert recording.imu is not None and recording.t.tolist() == [0.25, 0.75, 1.25]
    row = -FIRST + 130  # 0.65 s after the first image
    written_ns = times_ns()[row]
    assert recording.imu.t[row] == pytest.approx((written_ns - recording.t0_ns) * 1e-9, abs=1e-15)
    start, end = recording.t[:2]
    held = readings_between(recording.imu, start, end, np.eye(3), np.zeros(3), recording.gravity_world)
    inside = np.flatnonzero((recording.imu.t > start) & (recording.imu.t < end))
    k = 1 + int(np.flatnonzero(inside == row)[0])  # the first place is the frame's own
    frame_ns = recording.t0_ns + 250_000_000
    assert held.imu.t[k] == pytest.approx((written_ns - frame_ns) * 1e-9, abs=1e-8)
    np.testing.assert_allclose(held.imu.omega_body[k], recording.imu.omega_body[row], rtol=1e-6)


def test_a_mounting_is_16_numbers_or_a_data_sheet(desk):
    sheet = desk / "sensor.yaml"
    numbers = ", ".join(map(repr, MOUNTING.ravel().tolist()))
    sheet.write_text(f"%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate_hz: 20\n")
    for file in (sheet, desk / "mounting.txt"):
        np.testing.assert_allclose(read_mounting(file).T_body_cam, MOUNTING, atol=1e-12)


@pytest.mark.parametrize(
    "text, message",
    [
        ("1 0 0\n", "expected T_BS, or the 16 numbers of a 4x4 T_body_cam, got '1 0 0'"),
        ("camera: left\n", "expected T_BS, or the 16 numbers of a 4x4 T_body_cam, got 'camera: left'"),
        ("T_BS:\n  data: [1, 0]\n", "T_BS: expected 16 finite numbers, got shape (2,)"),
        ("2 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1", "expected a rotation, got a matrix 1 off one"),
        ("1 0 0 0  0 1 0 0  0 0 1 0  1 2 3 1", "expected a last row 0 0 0 1, got 1 2 3 1"),
        ("nan 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1", "got 'nan 0 0 0 0 1 0 0"),
    ],
)
def test_a_mounting_that_is_none_is_named(tmp_path, text, message):
    file = tmp_path / "mounting.txt"
    file.write_text(text)
    with pytest.raises(DataError) as error:
        read_mounting(file)
    assert str(file) in str(error.value) and message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text, message",
    [
        ("", ": expected lines of 7 columns (t wx wy wz ax ay az), got none"),
        ("0 1 2 3 4 5\n", ":1: expected 7 columns (t wx wy wz ax ay az), or a header that names them, got 6"),
        ("0 1 2 3 4 5 6\n0 1 2 3 4 5 6\n", ": expected at least 2 readings, got 1"),
        ("0 1 2 3 4 5 6\n1 1 2 3 4 5\n", ":2: expected 7 columns (t wx wy wz ax ay az), got 6"),
        ("0.1 1 2 3 4 5 6\n0 1 2 3 4 5 6\n", ":2: expected a timestamp after 0.1 s, got 0.0 s"),
        ("0 1 2 3 4 5 6\n", ": expected at least 2 readings, got 1"),
        ("0 1 2 3 4 5 x\n", ":1: expected 7 columns (t wx wy wz ax ay az), got '0 1 2 3 4 5 x'"),
        (
            "0 1 2 3 4 5 nan\n",
            ": expected lines of 7 columns (t wx wy wz ax ay az), got NaN or infinity in all",
        ),
        ("#t\n1,1,2,3,4,5\n", ":2: expected 7 columns (t wx wy wz ax ay az), or a header that names them"),
        (
            "0,1,2,3,4,5,6\n100000,1,2,3,4,5,6\n",
            "of one meaning, got 0 to 100000 in 2 lines, which may be ns or us",
        ),
    ],
)
def test_a_file_of_readings_that_is_none_is_named(tmp_path, text, message):
    file = tmp_path / "imu.txt"
    file.write_text(text)
    with pytest.raises(DataError) as error:
        read_imu(file)
    assert str(file) in str(error.value) and message in str(error.value) and "\n" not in str(error.value)


def test_readings_of_another_time_are_refused_and_gaps_told(desk, walk):
    ns, (omega, force) = times_ns(), readings(walk)
    csv(desk / "imu.csv", [timestamp + 10**10 for timestamp in ns], omega, force)
    with pytest.raises(DataError, match=r"imu\.csv: expected readings at the frames, 1403715523\.912 to "):
        load(config(desk))
    moved = load(config(desk, imu_offset_s=-10.0)).recording
    np.testing.assert_allclose(moved.imu.t[0], FIRST * 0.005, atol=5e-7)
    assert not any("IMU" in note for note in moved.notes)
    csv(desk / "imu.csv", ns[:100], omega[:100], force[:100])  # until 0.395 s
    notes = [note for note in load(config(desk)).recording.notes if "IMU" in note]
    assert len(notes) == 1 and notes[0].startswith("the IMU covers 2 of 6 frames: ")


@pytest.mark.parametrize(
    "factor, turn, found",
    [
        (1.0, 0.0, None),
        (1 / G, 0.0, r"mean force is 1 m/s\^2, 0 deg"),
        (1.0, 90.0, r"mean force is .* deg from up"),
    ],
)
def test_a_unit_and_a_mounting_that_disagree_with_gravity_are_told(desk, walk, factor, turn, found):
    omega, force = readings(walk)
    csv(desk / "imu.csv", times_ns(), omega, factor * force)
    turned = MOUNTING.copy()
    turned[:3, :3] = Rotation.from_euler("x", turn, degrees=True).as_matrix() @ MOUNTING[:3, :3]
    np.savetxt(desk / "mounting.txt", turned, fmt="%.17g")
    recording = with_imu(plain.load(desk), desk / "imu.csv", desk / "mounting.txt")
    notes = imu_notes(recording, "imu.csv")
    if found is None:
        assert notes == ()
    else:
        (note,) = notes
        assert re.search(found, note) and "check unit and extrinsics" in note


def test_without_true_poses_the_readings_say_which_way_is_down(desk, walk):
    (desk / "poses.txt").unlink()
    force = np.tile(readings(walk)[1][0], (400, 1))
    omega = np.zeros_like(force)
    csv(desk / "imu.csv", times_ns(), omega, force)
    recording = load(config(desk)).recording
    assert recording.T_world_cam is None
    assert "upright" in first_pose(recording).notes[0]
    for factor, got in (1 / G, "got 1: check the units"), (0.0, "got 0: check"):
        csv(desk / "imu.csv", times_ns(), omega, factor * force)
        expected = (
            r"expected readings around frame 0, which has no true pose, whose mean is gravity's 9.81 m/s\^2"
        )
        with pytest.raises(DataError, match=f"--imu combined {expected}, {got}"):
            load(config(desk))


def test_the_options_go_together_and_a_missing_file_is_one_line(desk):
    imu, mounting = ("--imu-file", desk / "imu.csv"), ("--imu-extrinsics", desk / "mounting.txt")
    complaint = partial(refused.complaint, main)
    assert "--imu-file: expected --imu-extrinsics FILE with it" in complaint("--data", desk, *imu)
    assert "--imu-extrinsics: expected --imu-file FILE with it" in complaint("--data", desk, *mounting)
    assert "--imu-file: expected --data DIR with it" in complaint(*imu, *mounting)
    assert "no.csv" in complaint("--data", desk, "--imu-file", desk / "no.csv", *mounting)


@pytest.mark.data
def test_a_real_flight_agrees_with_gravity_as_mounted_and_not_when_turned(data_dir):
    folder = data_dir / "euroc_V1_02_medium" / "mav0"
    rows = np.loadtxt(folder / "imu0" / "data.csv", delimiter=",", comments="#")
    imu = read_imu(folder / "imu0" / "data.csv").since(0)
    np.testing.assert_allclose(imu.t, rows[:, 0] * 1e-9, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(np.hstack([imu.omega_body, imu.acceleration_body]), rows[:, 1:])
    ground_truth = np.loadtxt(
        folder / "state_groundtruth_estimate0" / "data.csv", delimiter=",", comments="#"
    )[::40]
    ground_truth = ground_truth[ground_truth[:, 0] < rows[-1, 0]]
    T_world_body = np.tile(np.eye(4), (len(ground_truth), 1, 1))
    T_world_body[:, :3, :3] = Rotation.from_quat(ground_truth[:, [5, 6, 7, 4]]).as_matrix()
    t = (ground_truth[:, 0] - rows[0, 0]) * 1e-9
    recording = Recording(
        "V1_02", Camera(1.0, 1.0, 0.0, 0.0, 1, 1), t, lambda i: pytest.fail("no image is needed"),
        T_world_body @ MOUNTING, imu._replace(t=imu.t - rows[0, 0] * 1e-9), MOUNTING,
    )  # fmt: skip
    assert imu_notes(recording, "imu0") == ()
    (note,) = imu_notes(recording._replace(T_body_cam=np.eye(4)), "imu0")
    assert "check unit and extrinsics" in note


def written(path, text):
    path.write_text(text)
    return read_imu(path)


def test_units_of_time_are_found_by_size_and_steps(tmp_path):
    """The same 200 Hz in four units, since 1970 and since the start; between commas and blanks."""
    numbers = " 1 2 3 4 5 6"
    for start_us in (0, 1_403_715_523_912_143):
        times_us = [start_us + 5000 * k for k in range(8)]
        for unit, write in {
            "ns": lambda us: f"{1000 * us}",
            "us": lambda us: f"{us}",
            "ms": lambda us: f"{us // 1000}.{us % 1000:03d}",
            "s": lambda us: f"{us // 10**6}.{us % 10**6:06d}",
        }.items():
            lines = [write(us) + numbers for us in times_us]
            for name, mark in (("blanks", " "), ("commas", ",")):
                found = written(tmp_path / name, "\n".join(line.replace(" ", mark) for line in lines) + "\n")
                assert found.ns == [1000 * us for us in times_us], (unit, name)
                assert found.unit == unit
                assert bool(found.notes) == (unit != ("s" if mark == " " else "ns"))


def test_a_header_says_which_column_is_what_and_in_which_unit(tmp_path):
    """The accelerometer first, as phones write it; degrees and g by the header, a column of text between."""
    found = written(
        tmp_path / "phone.csv",
        "time [us],sensor,acc_x [g],acc_y [g],acc_z [g],gyr_x [deg/s],gyr_y [deg/s],gyr_z [deg/s],\n"
        "0,a,0,0,1,180,0,90,\n10000,b,0,0.5,1,0,360,0,\n",
    )
    np.testing.assert_allclose(found.omega_body, np.pi * np.array([[1, 0, 0.5], [0, 2, 0]]), atol=1e-12)
    np.testing.assert_allclose(found.acceleration_body, G * np.array([[0, 0, 1], [0, 0.5, 1]]), atol=1e-12)
    assert found.ns == [0, 10_000_000] and len(found.notes) == 2
    split = "#sec,nsec,ax,ay,az,gx,gy,gz\n7,5,1,2,3,4,5,6\n7,5000005,1,2,3,4,5,6\n"
    found = written(tmp_path / "split.csv", split)
    assert found.ns == [7_000_000_005, 7_005_000_005] and found.omega_body[0].tolist() == [4, 5, 6]


def test_gaps_of_readings_are_left_out_and_counted(tmp_path):
    rows = [f"{5_000_000 * k},1,2,3,4,5,{k}" for k in range(6)]
    rows[1] = rows[1].replace(",5,", ",nan,")
    rows[3] = rows[3].replace(",5,", ",,")
    found = written(tmp_path / "imu.csv", "\n".join([*rows, rows[-1]]) + "\n")
    assert found.acceleration_body[:, 2].tolist() == [0, 2, 4, 5] and found.gaps == 3
    assert found.notes == (
        "imu.csv: lines left out: 2 hold NaN, infinity or nothing (line 2), "
        "1 repeat the timestamp before (line 7)",
    )
