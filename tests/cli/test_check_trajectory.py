"""`jaxpose check` on trajectories, photographs and events, and how the command ends."""

import json

import numpy as np
import pytest
from helpers.checks import AROUND, FLIP, T0, checked, faults, flipped, inverted, named_tests, write_rows
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from jaxpose.cli import main as main_command
from jaxpose.cli.check.command import exit_code
from jaxpose.cli.check.poses import Quaternions, check_poses
from jaxpose.files import trajectories


def test_a_good_trajectory_has_no_fault(tmp_path):
    result = checked(write_rows(tmp_path / "good.txt", AROUND))
    assert result.format == "TUM trajectory" and faults(result) == ""
    assert result.facts[0].numbers["rate_hz"] == pytest.approx(20, rel=1e-3)
    trajectories.write_kitti(tmp_path / "kitti.txt", AROUND.T)
    assert faults(checked(tmp_path / "kitti.txt")) == ""
    result = checked(tmp_path)
    assert result.format == "folder of trajectories" and faults(result) == ""


@pytest.mark.parametrize(("seconds", "unit"), [(1e9, "ns"), (1e6, "us"), (1e3, "ms")])
@pytest.mark.parametrize("start", [0.0, T0])
def test_units_of_stamps_are_read_and_said(tmp_path, seconds, unit, start):
    moved = AROUND._replace(t=AROUND.t - T0 + start)
    result = checked(write_rows(tmp_path / "t.txt", moved, seconds=seconds))
    if (start, unit) == (0.0, "ms"):  # 50 s apart, or 50 ms
        assert "which may be s or ms" in faults(result) and exit_code(result) == 1
        return
    assert faults(result) == "" and any(f"timestamps are in {unit}" in note for note in result.notes)
    assert result.facts[0].numbers["rate_hz"] == pytest.approx(20, rel=1e-3)
    assert result.facts[0].numbers["unit"] == unit


def test_an_order_of_quaternions_is_named(tmp_path):
    result = checked(write_rows(tmp_path / "t.txt", AROUND, order=(3, 0, 1, 2)))
    assert named_tests(result) == ["quaternion order"] and "explains" in faults(result)
    first = AROUND._replace(T=np.linalg.inv(AROUND.T[0]) @ AROUND.T)
    result = checked(write_rows(tmp_path / "first.txt", first, order=(3, 0, 1, 2)))
    assert "is then the identity" in faults(result)


def test_jumps_and_stamps_out_of_order_are_found(tmp_path):
    T = AROUND.T.copy()
    T[200:, 0, 3] += 3.0
    result = checked(write_rows(tmp_path / "jump.txt", AROUND._replace(T=T)))
    assert "jumps" in named_tests(result) and "after 9.95 s" in faults(result)
    t = AROUND.t.copy()
    t[100] -= 1
    result = checked(write_rows(tmp_path / "back.txt", AROUND._replace(t=t)))
    assert exit_code(result) == 1 and "expected a timestamp after" in faults(result)
    assert not named_tests(result, "ok")
    t = np.repeat(AROUND.t[::2], 2)
    result = checked(write_rows(tmp_path / "twice.txt", AROUND._replace(t=t)))
    assert "200 of 400 that repeat" in faults(result)


@pytest.mark.parametrize(
    ("change", "words"),
    [(lambda T: T, ""), (flipped, "behind 100% of them"), (inverted, "invert the poses")],
)
def test_photographs_look_at_their_place(tmp_path, save, change, words):
    frames = []
    for i, T in enumerate(change(AROUND.T[::40] @ FLIP)):  # Blender's axes are OpenGL's
        save(tmp_path / f"images/{i}.png", np.full((20, 32, 3), 9 * i, np.uint8))
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": T.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    result = checked(tmp_path)
    assert result.format.startswith("photographs") and words in faults(result)
    assert bool(words) == bool(faults(result))


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


def test_the_command_ends_with_its_code(tmp_path, capsys):
    good = write_rows(tmp_path / "good.txt", AROUND)
    main_command.main(["check", str(good)])
    assert "no fault found" in capsys.readouterr().out
    bad = write_rows(tmp_path / "bad.txt", AROUND, order=(3, 0, 1, 2))
    with pytest.raises(SystemExit) as stop:
        main_command.main(["check", str(bad), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert stop.value.code == 2 and said["format"] == "TUM trajectory"
    assert [f["severity"] for f in said["findings"] if f["test"] == "quaternion order"] == ["warning"]
    (tmp_path / "nothing").mkdir()
    for path, found in ((tmp_path / "nothing", "an empty folder"), (tmp_path / "nowhere", "nothing")):
        with pytest.raises(SystemExit) as stop:
            main_command.main(["check", str(path)])
        line = str(stop.value)
        assert line.startswith("jaxpose check: ") and line.endswith(f"got {found}") and "\n" not in line


def test_random_motions_raise_no_alarm_about_quaternions():
    """Smooth rotations and positions that have nothing to do with each other, in the order of the format."""
    alarms = 0
    for seed in range(120):
        rng = np.random.default_rng(seed)
        slow = rng.uniform(5, 60)
        smooth = lambda: gaussian_filter1d(rng.normal(size=(400, 3)), slow, axis=0) * slow**0.5  # noqa: B023
        R = Rotation.from_rotvec(smooth() * rng.uniform(0.2, 2)) * Rotation.random(rng=rng)
        T = np.tile(np.eye(4), (400, 1, 1))
        T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), smooth() * rng.uniform(0.2, 2)
        found = check_poses(np.arange(400) / 20, T, Quaternions(R.as_quat(), "xyzw"))
        alarms += any(f.test == "quaternion order" and f.severity != "ok" for f in found.findings)
    assert alarms == 0
