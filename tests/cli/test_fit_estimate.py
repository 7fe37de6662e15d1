"""`jaxpose fit --estimate`: a trajectory in metres and upright, sensors, and what is refused."""

import json

import numpy as np
import pytest
from helpers import hand_held, refused

from jaxpose.cli.fit import command
from jaxpose.fields import numpy_evaluator
from jaxpose.files import trajectories
from jaxpose.files.kalibr import read_camchain
from jaxpose.geometry import rigid

T0 = 1.7e9  # seconds since 1970
OFFSET_S, SCALE, DURATION_S = 0.02, 3.0, 10.0
MOUNTING = rigid.exp(np.array([0.05, -0.04, 0.02, 0.1, 0.2, -0.1]))
WORLD = rigid.exp(np.array([0.0, 0.0, 0.0, 0.4, -0.3, 0.0]))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Keyframes without a scale in a tilted world, and an IMU, as files on the clock of 1970."""
    folder, rng = tmp_path_factory.mktemp("poses"), np.random.default_rng(0)
    t = np.arange(0.0, DURATION_S, 0.25)
    _, noisy = hand_held.cameras(t, rng, MOUNTING, 0.005, 0.003)
    noisy = WORLD @ noisy
    noisy[:, :3, 3] /= SCALE
    trajectories.write_tum(folder / "poses.txt", trajectories.Trajectory(T0 + t - OFFSET_S, noisy))
    imu = hand_held.readings(DURATION_S, 100.0, rng)
    rows = np.column_stack([imu.t, imu.omega_body, imu.acceleration_body])
    lines = (f"{T0 + row[0]:.6f} " + " ".join(f"{x:.9g}" for x in row[1:]) for row in rows)
    (folder / "imu.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def found(files):
    config = command.Config(
        trajectory=files / "poses.txt",
        imu=files / "imu.txt",
        estimate=("offset", "extrinsics", "scale", "gravity", "biases"),
        position_sigma=0.002,
        out=files / "field.npz",
        kalibr=files / "chain.yaml",
    )
    return command.run(config)


def test_the_sensors_are_found(found, files):
    assert found.offset_s[0] == pytest.approx(OFFSET_S, abs=1e-3)
    assert found.scale[0] == pytest.approx(SCALE, rel=0.01)
    assert np.degrees(rigid.rotation_angle(found.T_body_cam[:3, :3], MOUNTING[:3, :3])) < 0.3
    assert found.unobserved == ()
    chain = read_camchain(files / "chain.yaml")
    np.testing.assert_allclose(chain.T_body_cam, found.T_body_cam, atol=1e-9)
    assert chain.offset_s == pytest.approx(found.offset_s[0], abs=1e-9)


def test_the_trajectory_is_metric_and_upright_on_the_poses_clock(found, files):
    """Moves of one second between keyframes, and which way is down, against the simulation."""
    t = np.linspace(0.5, 8.0, 40)
    pose = numpy_evaluator.load(files / "field.npz")
    start, end = (pose(T0 + t + step - OFFSET_S) for step in (0.0, 1.0))
    true_start, true_end = (hand_held.body(t + step)[0] @ MOUNTING for step in (0.0, 1.0))
    off = rigid.log(rigid.inverse(rigid.inverse(start) @ end) @ rigid.inverse(true_start) @ true_end)
    assert np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1))) < 0.015
    down = np.einsum("nji,j->ni", start[:, :3, :3], [0.0, 0.0, -1.0])
    true_down = np.einsum("nji,j->ni", true_start[:, :3, :3], [0.0, 0.0, -1.0])
    assert np.degrees(rigid.vector_angle(down, true_down)).max() < 0.5
    sigma = np.sqrt(
        np.diagonal(numpy_evaluator.load_covariance(files / "field.npz")(T0 + t), axis1=1, axis2=2)
    )
    assert (sigma > 1e-4).all() and (sigma < 0.03).all()


def test_the_report_is_a_table_with_sigmas(found, capsys):
    text = command.report(found)
    row = next(line for line in text.splitlines() if line.startswith("| time offset [ms]"))
    value, sigma = (float(cell) for cell in row.strip("|").split("|")[1:])
    assert value == pytest.approx(1e3 * found.offset_s[0], abs=1e-3) and 0 < sigma < 2
    assert "trajectory with covariance written to" in text and "unknown" not in text


def test_json_holds_the_same(files, capsys):
    args = [str(files / "poses.txt"), "--imu", str(files / "imu.txt"), "--estimate", "offset", "extrinsics"]
    command.main([*args, "scale", "gravity", "biases", "--position-sigma", "0.002", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["offset_s"][0] == pytest.approx(OFFSET_S, abs=1e-3)


def complaint(*args):
    return refused.complaint(command.main, *map(str, args))


def test_what_cannot_be_is_refused(files, tmp_path):
    poses, imu = files / "poses.txt", files / "imu.txt"
    assert "--estimate: expected --imu with it" in complaint(poses, "--estimate", "scale")
    assert "--kalibr: has no effect without --estimate" in complaint(
        poses, "--kalibr", tmp_path / "chain.yaml"
    )
    assert "got nothing" in complaint(poses, "--imu", tmp_path / "none.txt", "--estimate", "scale")
    assert "invalid choice 'wind'" in complaint(poses, "--imu", imu, "--estimate", "wind")
    late = tmp_path / "late.txt"
    lines = [line.split(" ", 1) for line in imu.read_text().splitlines()]
    late.write_text("\n".join(f"{float(t) + 1000:.6f} {rest}" for t, rest in lines))
    assert "IMU: expected readings between 0.000 and" in complaint(
        poses, "--imu", late, "--estimate", "scale"
    )
    assert "--position-sigma" in complaint(
        poses, "--imu", imu, "--estimate", "scale", "--position-sigma", "-1"
    )
