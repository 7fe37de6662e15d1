"""`jaxpose check`: faults put into data that are known to be right, each named; no fault found without."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose import cli, io
from jaxpose.commands import check
from jaxpose.commands.check import Config, exit_code, report

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes to OpenGL's
T0 = 1_403_715_524.0
T0_NS = 1_403_715_524 * 10**9


def checked(path):
    return check.run(Config(Path(path)))


def faults(result):
    """What is not ok, as one text."""
    return " | ".join(f"{f.test}: {f}" for f in result.findings if f.severity != "ok")


def named_tests(result, severity="warning"):
    return [finding.test for finding in result.findings if finding.severity == severity]


def inverted(T):
    return np.linalg.inv(T)


def flipped(T):
    return T @ FLIP


# --- RGB-D recordings -------------------------------------------------------------------------------------


class Clip(NamedTuple):
    """A few frames with exact depth [m]."""

    camera: tuple
    t: np.ndarray
    depth: np.ndarray
    T_world_cam: np.ndarray


@pytest.fixture(scope="module")
def clip():
    """A camera in a room of 5 x 4 x 2.6 m with three balls in it, turning and walking; exact depth."""
    t = np.arange(21) / 4
    T = np.tile(np.eye(4), (21, 1, 1))
    turn = Rotation.from_euler("xyz", np.stack([0.15 * np.sin(2 * t), 0.35 * t, 0.1 * np.cos(t)], -1))
    T[:, :3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ turn.as_matrix()
    T[:, :3, 3] = np.stack([0.8 * np.sin(0.5 * t), 0.6 * np.cos(0.7 * t), 1.3 + 0.2 * np.sin(t)], -1)
    camera = (73.0, 73.0, 39.5, 29.5)
    v, u = np.mgrid[0:60, 0:80]
    rays = np.stack([(u - 39.5) / 73, (v - 29.5) / 73, np.ones((60, 80))], axis=-1)
    return Clip(camera, t, np.stack([cast(pose[:3, 3], rays @ pose[:3, :3].T) for pose in T]), T)


def cast(origin, rays):
    """How many times each ray reaches from the origin to the room's walls or a ball."""
    low, high = np.array([-2.5, -2, 0]), np.array([2.5, 2, 2.6])
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, (high - origin) / rays, (low - origin) / rays).min(-1)
    for centre, radius in (([1.7, 1.2, 0.6], 0.6), ([-1.6, 1.3, 1.5], 0.5), ([1.8, -1.2, 1.2], 0.5)):
        to = np.array(centre) - origin
        along, size = rays @ to, (rays**2).sum(-1)
        root = along**2 - size * (to @ to - radius**2)
        hit = (along - np.sqrt(np.maximum(root, 0))) / size
        reach = np.where((root > 0) & (hit > 0), np.minimum(reach, hit), reach)
    return reach


def write_images(folder, clip, save, per_metre):
    grey = np.full((*clip.depth.shape[1:], 3), 128, np.uint8)
    for i, depth in enumerate(clip.depth):
        save(folder / f"color/{i}.png", grey)
        save(folder / f"depth/{i}.png", np.round(depth * per_metre).astype(np.uint16))
    fx, fy, cx, cy = clip.camera[:4]
    (folder / "camera-intrinsics.txt").write_text(f"{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")


def plain(folder, clip, save, *, change=lambda T: T, per_metre=1000.0, seconds=1.0):
    """A folder of the plain layout, whose depth is read as mm."""
    write_images(folder, clip, save, per_metre)
    np.savetxt(folder / "poses.txt", change(clip.T_world_cam).reshape(-1, 16))
    np.savetxt(folder / "times.txt", (T0 + clip.t) * seconds, fmt="%.9g" if seconds == 1 else "%.0f")
    if seconds == 1:
        np.savetxt(folder / "times.txt", T0 + clip.t, fmt="%.6f")
    return folder


def tum(folder, clip, save, *, per_metre=5000.0, order=(0, 1, 2, 3), seconds=1.0):
    """A folder of TUM's layout, `order` of the quaternion's columns, stamps in units of `seconds`."""
    write_images(folder, clip, save, per_metre)
    stamps = [f"{(T0 + t) / seconds:.6f}" if seconds == 1 else f"{T0_NS + round(t * 1e9)}" for t in clip.t]
    for kind, name in (("color", "rgb"), ("depth", "depth")):
        lines = [f"{stamp} {kind}/{i}.png" for i, stamp in enumerate(stamps)]
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    quaternions = Rotation.from_matrix(clip.T_world_cam[:, :3, :3]).as_quat()[:, list(order)]
    rows = np.column_stack([clip.T_world_cam[:, :3, 3], quaternions])
    lines = [" ".join([stamp, *map(str, row)]) for stamp, row in zip(stamps, rows, strict=True)]
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_a_good_recording_has_no_fault(tmp_path, clip, save):
    result = checked(plain(tmp_path, clip, save))
    assert result.format == "RGB-D recording (plain)" and faults(result) == "" and exit_code(result) == 0
    numbers = {fact.name: fact.numbers for fact in result.facts}
    assert numbers["frames"]["count"] == 21 and numbers["frames"]["rate_hz"] == pytest.approx(4)
    assert numbers["times.txt"]["first_stamp_s"] == pytest.approx(T0) and numbers["truth"]["coverage"] == 1
    assert numbers["camera"]["fov_x_deg"] == pytest.approx(np.degrees(2 * np.arctan(40 / 73)))
    assert numbers["depth"]["coverage"] == 1
    assert numbers["depth"]["median_m"] == pytest.approx(np.median(clip.depth[::5]), rel=0.01)
    assert "OpenCV axes, and the depth's scale fit" in report(result)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ({"change": inverted}, "world-to-camera poses, OpenCV axes"),
        ({"change": flipped}, "camera-to-world poses, OpenGL axes"),
        ({"change": lambda T: FLIP @ np.linalg.inv(T)}, "world-to-camera poses, OpenGL axes"),
        (
            {"per_metre": 5000.0},
            "depth scale 5000 for 1000 (depth is 5 times too large); multiply the depth by 0.2",
        ),
        ({"per_metre": 200.0}, "5 times too small; multiply the depth by 5"),
        ({"per_metre": 1310.7}, "depth scale 6553.5 for 5000; multiply the depth by 0.763"),
        (
            {"per_metre": 5000.0, "change": inverted},
            "world-to-camera poses, OpenCV axes and depth scale 5000",
        ),
    ],
)
def test_conventions_and_scales_are_named(tmp_path, clip, save, fault, named):
    result = checked(plain(tmp_path, clip, save, **fault))
    assert named_tests(result) == ["poses and depth"] and exit_code(result) == 2
    words = faults(result).replace(": so", ";")
    assert all(part in words for part in named.split("; ")), words


def test_poses_of_other_frames_fit_no_convention(tmp_path, clip, save):
    generator = np.random.default_rng(0)
    turned = Rotation.random(len(clip.t), rng=generator).as_matrix()
    T = np.tile(np.eye(4), (len(clip.t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turned, generator.normal(size=(len(clip.t), 3))
    result = checked(plain(tmp_path, clip, save, change=lambda _: T))
    assert "no other convention fits" in faults(result)


def test_tum_in_its_own_conventions_and_in_others(tmp_path, clip, save):
    assert faults(checked(tum(tmp_path / "good", clip, save))) == ""
    result = checked(tum(tmp_path / "mm", clip, save, per_metre=1000.0))
    assert "depth scale 1000 for 5000" in faults(result)
    result = checked(tum(tmp_path / "order", clip, save, order=(3, 0, 1, 2)))
    assert "quaternions in the order wxyz, read as xyzw" in faults(result)
    result = checked(tum(tmp_path / "ns", clip, save, seconds=1e-9))
    assert set(named_tests(result)) == {"unit of time"} and "convert the stamps from ns to s" in faults(
        result
    )


def test_a_gap_in_the_frames_is_found_where_it_is(tmp_path, clip, save):
    folder = plain(tmp_path, clip, save)
    late = np.where(np.arange(21) > 9, 3.0, 0.0)
    np.savetxt(folder / "times.txt", T0 + clip.t + late, fmt="%.6f")
    result = checked(folder)
    assert "gaps" in named_tests(result) and "3.25 s at 2.25 s" in faults(result)


def test_what_a_loader_refuses_is_unusable(tmp_path, clip, save):
    folder = plain(tmp_path, clip, save)
    (folder / "poses.txt").write_text("1 2 3\n")
    result = checked(folder)
    assert exit_code(result) == 1 and "poses.txt:1" in faults(result)
    assert "unusable" in report(result)


def test_a_camera_at_rest_tells_nothing(tmp_path, clip, save):
    still = clip._replace(depth=clip.depth[[0] * 21], T_world_cam=clip.T_world_cam[[0] * 21])
    result = checked(plain(tmp_path, still, save))
    assert faults(result) == "" and any("moves too little" in note for note in result.notes)


# --- an IMU and truth -------------------------------------------------------------------------------------


def turning(t):
    angles = np.stack([0.6 * np.sin(1.1 * t), 0.4 * np.sin(1.7 * t + 1), 1.5 * np.sin(0.5 * t)], -1)
    return Rotation.from_euler("xyz", angles)


def position(t):
    return np.stack([np.sin(t), 0.5 * np.cos(0.8 * t), 0.2 * np.sin(2 * t)], -1)


def acceleration(t):
    return np.stack([-np.sin(t), -0.32 * np.cos(0.8 * t), -0.8 * np.sin(2 * t)], -1)


def euroc(folder, *, change=lambda T: T, gyro=1.0, force=1.0, late_s=0.0, roll=0, mounting=None, ns=10**9):
    """An ASL folder of 30 s: readings at 100 Hz, truth at 50 Hz, faults as they are asked for."""
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
    stamps = [(T0_NS + round(s * 1e9)) // (10**9 // ns) for s in t]
    lines = [",".join(map(str, [stamp, *row])) for stamp, row in zip(stamps, rows.tolist(), strict=True)]
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
        ({"gyro": 180 / np.pi}, "gyroscope unit", "degrees/s"),
        ({"force": 1 / 9.80665}, "accelerometer unit", "in g; multiply by 9.80665"),
        ({"force": -1.0}, "gravity", "change the sign"),
        ({"late_s": 0.05}, "clock offset", "50.0 ms late"),
        ({"late_s": -0.3}, "clock offset", "300.0 ms early"),
        ({"change": inverted}, "IMU and poses", "invert the poses"),
        ({"roll": -1}, "quaternion order", "quaternions in the order xyzw"),
        ({"change": lambda T: FLIP @ T}, "gravity", "down"),
        ({"ns": 10**6}, "unit of time", "from us to ns"),
    ],
)
def test_faults_of_an_imu_are_named(tmp_path, fault, test, words):
    result = checked(euroc(tmp_path, **fault))
    assert test in named_tests(result) and words in faults(result), faults(result)
    assert exit_code(result) == 2


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
    assert faults(result) == "" and any("no truth to compare" in note for note in result.notes)
    (folder / "imu0/data.csv").unlink()
    (folder / "imu0/sensor.yaml").unlink()
    assert exit_code(checked(tmp_path)) == 1


# --- trajectories -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def around():
    """A camera that is carried around a table and looks at it: T_world_cam, OpenCV axes."""
    t = np.arange(0, 20, 0.05)
    angle = 0.3 * t
    centre = np.stack([2 * np.cos(angle), 2 * np.sin(angle), 1.5 + 0.2 * np.sin(t)], -1)
    forward = -centre / np.linalg.norm(centre, axis=1)[:, None]
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1)[:, None]
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    T[:, :3, 3] = centre
    return io.Trajectory(T0 + t, T)


def write_rows(file, trajectory, order=(0, 1, 2, 3), seconds=1.0):
    quaternions = Rotation.from_matrix(trajectory.T[:, :3, :3]).as_quat()[:, list(order)]
    rows = np.column_stack([trajectory.t * seconds, trajectory.T[:, :3, 3], quaternions])
    file.write_text("".join(" ".join(f"{x:.6f}" for x in row) + "\n" for row in rows))
    return file


def test_a_good_trajectory_has_no_fault(tmp_path, around):
    result = checked(write_rows(tmp_path / "good.txt", around))
    assert result.format == "TUM trajectory" and faults(result) == ""
    assert result.facts[0].numbers["rate_hz"] == pytest.approx(20, rel=1e-3)
    io.write_kitti(tmp_path / "kitti.txt", around.T)
    assert faults(checked(tmp_path / "kitti.txt")) == ""
    result = checked(tmp_path)
    assert result.format == "folder of trajectories" and faults(result) == ""


@pytest.mark.parametrize(
    ("seconds", "unit"), [(1e9, "from ns to s"), (1e6, "from us to s"), (1e3, "from ms to s")]
)
@pytest.mark.parametrize("start", [0.0, T0])
def test_units_of_stamps_are_named(tmp_path, around, seconds, unit, start):
    moved = around._replace(t=around.t - T0 + start)
    result = checked(write_rows(tmp_path / "t.txt", moved, seconds=seconds))
    assert "unit of time" in named_tests(result) and unit in faults(result)


def test_an_order_of_quaternions_is_named(tmp_path, around):
    result = checked(write_rows(tmp_path / "t.txt", around, order=(3, 0, 1, 2)))
    assert named_tests(result) == ["quaternion order"] and "explains" in faults(result)
    first = around._replace(T=np.linalg.inv(around.T[0]) @ around.T)
    result = checked(write_rows(tmp_path / "first.txt", first, order=(3, 0, 1, 2)))
    assert "is then the identity" in faults(result)


def test_jumps_and_stamps_out_of_order_are_found(tmp_path, around):
    T = around.T.copy()
    T[200:, 0, 3] += 3.0
    result = checked(write_rows(tmp_path / "jump.txt", around._replace(T=T)))
    assert "jumps" in named_tests(result) and "after 9.95 s" in faults(result)
    t = around.t.copy()
    t[100] -= 1
    result = checked(write_rows(tmp_path / "back.txt", around._replace(t=t)))
    assert exit_code(result) == 1 and "1 that go backwards" in faults(result)
    t = np.repeat(around.t[::2], 2)
    result = checked(write_rows(tmp_path / "twice.txt", around._replace(t=t)))
    assert "200 of 400 that repeat" in faults(result)


# --- photographs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [(lambda T: T, ""), (flipped, "behind 100% of them"), (inverted, "invert the poses")],
)
def test_photographs_look_at_their_place(tmp_path, around, save, change, words):
    frames = []
    for i, T in enumerate(change(around.T[::40] @ FLIP)):  # Blender's axes are OpenGL's
        save(tmp_path / f"images/{i}.png", np.full((20, 32, 3), 9 * i, np.uint8))
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": T.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    result = checked(tmp_path)
    assert result.format.startswith("photographs") and words in faults(result)
    assert bool(words) == bool(faults(result))


# --- events, and the command ------------------------------------------------------------------------------


def test_events_outside_the_sensor_are_found(tmp_path):
    lines = [f"{0.001 * i:.6f} {i % 240} {i % 180} {i % 2}" for i in range(1000)]
    (tmp_path / "events.txt").write_text("\n".join(lines))
    (tmp_path / "calib.txt").write_text("199 198 132 110 -0.36 0.15 0 0 0\n")
    result = checked(tmp_path)
    assert result.format == "DAVIS events (events.txt)" and faults(result) == ""
    assert result.facts[0].numbers["count"] == 1000
    (tmp_path / "events.txt").write_text("\n".join([*lines, "1.0 346 20 2"]))
    assert "pixels of 240x180, got up to 346, 179" in faults(checked(tmp_path))
    assert "polarities" in faults(checked(tmp_path))


def test_the_command_ends_with_its_code(tmp_path, around, capsys):
    good = write_rows(tmp_path / "good.txt", around)
    cli.main(["check", str(good)])
    assert "no fault found" in capsys.readouterr().out
    bad = write_rows(tmp_path / "bad.txt", around, seconds=1e9)
    with pytest.raises(SystemExit) as stop:
        cli.main(["check", str(bad), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert stop.value.code == 2 and said["format"] == "TUM trajectory"
    assert [f["severity"] for f in said["findings"] if f["test"] == "unit of time"] == ["warning"]
    (tmp_path / "nothing").mkdir()
    for path, found in ((tmp_path / "nothing", "an empty folder"), (tmp_path / "nowhere", "nothing")):
        with pytest.raises(SystemExit) as stop:
            cli.main(["check", str(path)])
        line = str(stop.value)
        assert line.startswith("jaxpose check: ") and line.endswith(f"got {found}") and "\n" not in line


# --- real recordings --------------------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("7scenes_redkitchen", "sevenscenes"),
        ("euroc_V1_02_medium", "EuRoC"),
        ("euroc_V1_01_easy", "EuRoC"),
        ("nerf_synthetic_lego", "Blender"),
        ("llff_fern", "LLFF"),
        ("ecd_slider_depth", "DAVIS"),
        ("trajectories", "folder of trajectories"),
        ("trajectories/euroc/V1_03_difficult.csv", "EuRoC trajectory"),
        ("trajectories/tum_vi", "folder of trajectories"),
    ],
)
def test_real_data_have_no_fault(data_dir, name, form):
    result = checked(data_dir / name)
    assert form in result.format and faults(result) == ""


@pytest.mark.data
@pytest.mark.parametrize(
    ("change", "scale", "words"),
    [
        (inverted, 1.0, "world-to-camera poses, OpenCV axes"),
        (flipped, 1.0, "camera-to-world poses, OpenGL axes"),
        (lambda T: T, 5.0, "5 times too large"),
        (lambda T: T, 0.2, "multiply the depth by 5"),
    ],
)
def test_faults_put_into_a_real_clip_are_named(data_dir, tmp_path, save, change, scale, words):
    from jaxpose.data.images import open_image

    folder = data_dir / "7scenes_redkitchen" / "seq-01"
    os.symlink(data_dir / "7scenes_redkitchen" / "camera-intrinsics.txt", tmp_path / "camera-intrinsics.txt")
    for file in sorted(folder.glob("*0.color.jpg")):
        stem = file.name.split(".")[0]
        os.symlink(file, tmp_path / file.name)
        counts = open_image(folder / f"{stem}.depth.png", np.asarray)
        if scale == 1:
            os.symlink(folder / f"{stem}.depth.png", tmp_path / f"{stem}.depth.png")
        else:
            counts = np.where(counts == 65535, 0, np.minimum(counts * scale, 65534)).astype(np.uint16)
            save(tmp_path / f"{stem}.depth.png", counts)
        T = np.loadtxt(folder / f"{stem}.pose.txt")
        np.savetxt(tmp_path / f"{stem}.pose.txt", change(T))
    result = checked(tmp_path)
    assert named_tests(result) == ["poses and depth"] and words in faults(result)


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    ["fr2_desk_ORB.txt", "freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt", "tum_vi", "euroc"],
)
def test_real_quaternions_in_the_other_order_are_named(data_dir, tmp_path, name):
    source = data_dir / "trajectories" / name
    lines = (next(source.iterdir()) if source.is_dir() else source).read_text().splitlines()
    rows = [line.replace(",", " ").split() for line in lines if not line.startswith("#")]
    if source.is_dir():  # wxyz to xyzw
        text = "\n".join(",".join([*row[:4], *row[5:8], row[4], *row[8:]]) for row in rows)
    else:
        text = "\n".join(" ".join([*row[:4], row[7], *row[4:7]]) for row in rows)
    (tmp_path / "t.txt").write_text(text)
    assert named_tests(checked(tmp_path / "t.txt")) == ["quaternion order"]


@pytest.mark.data
@pytest.mark.parametrize(("frames", "words"), [(0, ""), (2, "the poses of 70 ms earlier")])
def test_poses_of_another_clock_are_named(data_dir, tmp_path, frames, words):
    folder = data_dir / "7scenes_redkitchen" / "seq-01"
    os.symlink(data_dir / "7scenes_redkitchen" / "camera-intrinsics.txt", tmp_path / "camera-intrinsics.txt")
    for i in range(240):
        for kind, j in (("color.jpg", i), ("depth.png", i), ("pose.txt", i + frames)):
            os.symlink(folder / f"frame-{j:06d}.{kind}", tmp_path / f"frame-{i:06d}.{kind}")
    result = checked(tmp_path)
    assert named_tests(result) == (["clock of poses"] if frames else []) and words in faults(result)


@pytest.mark.data
@pytest.mark.parametrize(
    ("fault", "test", "words"),
    [("degrees", "gyroscope unit", "degrees/s"), ("late", "clock offset", "ms late"), ("order", "", "xyzw")],
)
def test_faults_put_into_real_readings_are_named(data_dir, tmp_path, fault, test, words):
    source = data_dir / "euroc_V1_02_medium" / "mav0"
    for name in ("imu0", "state_groundtruth_estimate0"):
        rows = [line.split(",") for line in (source / name / "data.csv").read_text().splitlines()[1:9000]]
        for row in rows:
            if fault == "degrees" and name == "imu0":
                row[1:4] = [repr(float(x) * 180 / np.pi) for x in row[1:4]]
            if fault == "late" and name == "imu0":
                row[0] = str(int(row[0]) + 50_000_000)
            if fault == "order" and name != "imu0":
                row[4:8] = [*row[5:8], row[4]]
        (tmp_path / "mav0" / name).mkdir(parents=True)
        (tmp_path / "mav0" / name / "data.csv").write_text("\n".join(map(",".join, rows)))
    (tmp_path / "mav0/imu0/sensor.yaml").write_text((source / "imu0/sensor.yaml").read_text())
    result = checked(tmp_path)
    if fault == "order":  # by the signs, and by the gyroscope
        assert named_tests(result) == ["quaternion order", "quaternion order"]
    else:
        assert named_tests(result) == [test]
    assert words in faults(result)
