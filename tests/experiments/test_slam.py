"""The SLAM commands: smoke runs with their run folders, and bad input that ends in one line."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.refused import complaint
from PIL import Image

from jaxpose import fields
from jaxpose.cli import evaluate
from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments import imu_slam, rgbd_slam
from jaxpose.experiments.outcome import Outcome
from jaxpose.experiments.slam.evaluation import orientation_error_deg
from jaxpose.experiments.slam.report import report, table, tracking_update
from jaxpose.experiments.slam.run_files import _write_trajectory
from jaxpose.experiments.slam.source import load
from jaxpose.fields import numpy_evaluator
from jaxpose.files import atomic, trajectories
from jaxpose.files.camera_json import read_camera
from jaxpose.geometry import rigid
from jaxpose.slam import Progress

README = Path(__file__).parents[2] / "README.md"
FRAMES = 8
PICTURES = {"trajectory.png", "errors.png", "renders.png"}
FILES = PICTURES | {
    "config.json", "results.json", "trajectory.txt", "reference.txt", "field.npz", "camera.json",
    "map.npz", "mesh.ply", "points.ply", "preview.png", "settings.json",
}  # fmt: skip


@pytest.fixture(scope="module")
def recording() -> Recording:
    return room(RoomConfig(duration_s=(FRAMES - 1) / 5, width=80, height=60, holes=False))


@pytest.fixture
def folder(tmp_path, recording) -> Path:
    """A small recording in the layout of 7-Scenes, in a folder that a test may damage."""
    path = tmp_path / "office" / "seq-01"
    path.mkdir(parents=True)
    camera = recording.camera
    K = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    np.savetxt(path / "camera-intrinsics.txt", K)
    for i in range(FRAMES):
        frame = recording.read(i)
        Image.fromarray(frame.rgb).save(path / f"frame-{i:06d}.color.png")
        Image.fromarray((1000 * frame.depth).astype(np.uint16)).save(path / f"frame-{i:06d}.depth.png")
        np.savetxt(path / f"frame-{i:06d}.pose.txt", recording.T_world_cam[i])
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Outcome:
    """`imu_slam --smoke`."""
    out = tmp_path_factory.mktemp("runs") / "imu"
    return imu_slam.run(imu_slam.Config(smoke=True, out=out))


def test_run_folder_of_imu_slam(finished):
    folder, results = finished
    assert {path.name for path in folder.iterdir()} == FILES | {"inertial.png"}
    assert json.loads((folder / "results.json").read_text()) == json.loads(json.dumps(atomic._plain(results)))
    assert results["frames"] == FRAMES and results["frames_lost"] == 0
    assert results["alignment"] == "se3" and results["imu"]["mode"] == "combined"
    assert "200 Hz" in results["imu"]["readings"]
    assert results["wall_s"] > 0 and results["peak_rss_bytes"] > 2**20
    config = json.loads((folder / "config.json").read_text())
    assert config["slam"]["imu"] == "combined" and config["smoke"] is True
    for picture in PICTURES | {"inertial.png"}:
        with Image.open(folder / picture) as image:
            assert image.width >= 1000


def test_numbers_are_those_of_the_files(finished):
    folder, results = finished
    estimate, ground_truth = (
        trajectories.read_tum(folder / "trajectory.txt"),
        trajectories.read_tum(folder / "reference.txt"),
    )
    assert results["ate_rmse_m"] == pytest.approx(
        trajectory_error.ate(estimate.T, ground_truth.T).rmse, abs=1e-9
    )
    assert results["ate_rmse_m"] < 0.02
    np.testing.assert_allclose(estimate.t, np.arange(FRAMES) / 5)


def test_a_saved_field_gives_the_trajectory_at_any_time(finished):
    """With an IMU the trajectory that is written is the field, and the file says how sure it is."""
    folder, _ = finished
    field, params = fields.load(folder / "field.npz")
    estimate = trajectories.read_tum(folder / "trajectory.txt")
    times = np.concatenate([estimate.t, np.linspace(0, estimate.t[-1], 50)]).astype(np.float32)
    poses = np.asarray(jax.jit(jax.vmap(field.pose, (None, 0)))(params, jnp.asarray(times)))
    distance = np.linalg.norm(poses[:FRAMES, :3, 3] - estimate.T[:, :3, 3], axis=1)
    assert distance.max() < 1e-5
    sigma = np.sqrt(
        np.diagonal(numpy_evaluator.load_covariance(folder / "field.npz")(times), axis1=1, axis2=2)
    )
    assert sigma.shape == (len(times), 6) and (sigma > 1e-6).all() and (sigma < 0.1).all()
    np.testing.assert_allclose(numpy_evaluator.load(folder / "field.npz")(times), poses, atol=1e-6)


def test_errors_are_held_against_the_covariances(finished, tmp_path):
    """`jaxpose eval --consistency` of a run, and one line for a trajectory that does not know."""
    folder = finished.folder
    config = evaluate.Config(folder, folder / "reference.txt", consistency=True)
    found = evaluate.run(config)
    pose, second = found.consistency["poses after alignment"], found.consistency["moves of 1 s"]
    assert pose.count == FRAMES and 0 < second.count < FRAMES
    assert 0 < pose.nees < 100 and 0 < second.nees < 100
    assert f"{second.nees:.2f} of moves of 1 s" in evaluate.report(found)
    with pytest.raises(DataError, match="--consistency expected a run"):
        evaluate.run(evaluate.Config(folder / "trajectory.txt", folder / "reference.txt", consistency=True))


def test_a_camera_that_turns_in_place_is_not_called_wrong():
    """Its positions do not tell how to turn it; its orientations, all off by the same 30 degrees, do."""
    rng, turns = np.random.default_rng(0), np.zeros((40, 6))
    turns[:, 4] = np.linspace(0, 2, 40)
    true = rigid.exp(turns)
    world = rigid.exp(np.array([0.0, 0.0, 0.0, 0.5, 0.1, 0.0]))
    off = np.zeros((40, 6))
    off[7, 3], off[:, :3] = np.radians(8), 0.002 * rng.normal(size=(40, 3))
    estimate = world @ true @ rigid.exp(off)
    true[3] = np.nan
    turned = orientation_error_deg(estimate, true)
    assert np.flatnonzero(turned > 5).tolist() == [7] and turned[7] == pytest.approx(8, abs=0.3)
    assert np.isnan(turned[3]) and np.nanmedian(turned) < 0.3


def test_a_run_says_what_camera_it_had(finished):
    camera, images, *_ = read_camera(finished.folder / "camera.json")
    assert (camera.width, camera.height, images) == (80, 60, ())


def test_report_states_numbers_with_their_protocol(finished):
    text = report(*finished)
    assert f"{100 * finished.results['ate_rmse_m']:.2f} cm  SE(3) alignment, 8 of 8 frames" in text
    assert "SMOKE" in text and str(finished.folder) in text and "trajectory.png" in text
    assert f"0 of {FRAMES} frames" in text
    bias = finished.results["calibration"]["gyro_bias"]
    assert f"IMU biases        {bias[0]:.4f}" in text
    left = {"taken": False, "depths_apart": 1.5, "keyframes": 3, "moved_max_m": 0.1}
    told = report(finished.folder, finished.results | {"bundle": left | {"inflation": 5.76}})
    assert "not taken: depth images are 1.50 times" in told and "2.4 times as large as tracked" in told
    assert "as tracked," not in report(finished.folder, finished.results | {"bundle": left})  # an earlier run


@pytest.mark.slow
def test_rgbd_slam_on_a_folder(folder, tmp_path, capsys):
    out = tmp_path / "run"
    rgbd_slam.main(
        ["--data", str(folder), "--recorded-hz", "5", "--smoke", "--frame", "intrinsic", "--out", str(out)]
    )
    said = capsys.readouterr()
    assert "office/seq-01" in said.out and "IMU none" in said.out
    assert "tracking, IMU none  8/8 frames" in said.err
    assert {path.name for path in out.iterdir()} == FILES | {"freedom.png"}  # and no picture of an IMU
    results = json.loads((out / "results.json").read_text())
    dof = results["degrees_of_freedom"]
    assert dof["after_mean"] < dof["before_mean"] <= 6 and "in the intrinsic frame" in said.out
    assert results["ate_rmse_m"] < 0.02
    assert results["imu"] == {"mode": "none", "readings": "not used"}
    camera, images, where, *_ = read_camera(out / "camera.json")
    assert images == tuple(f"frame-{k:06d}.color.png" for k in range(FRAMES)) and (camera.width, where) == (
        80,
        folder,
    )


def test_the_progress_of_a_resumed_run_begins_where_it_goes_on():
    """Its first frame is not frame 0, and frames lost before count."""
    frames = SimpleNamespace(lost=np.array([True, False, True, False]), loss=np.full(4, 0.5))
    update = tracking_update("none", Progress(3, 5, SimpleNamespace(frames=frames), 0.01))
    assert (update.done, update.total) == (4, 5)
    assert update.state == {"loss": "0.50", "off": "1.0 cm", "lost": "2"}


MODES = ["none", "loose", "tight", "accelerometer", "combined"]


def assert_side_by_side(outcome):
    """Every mode has its folder and its settings, and the table its rows, in order, of its own numbers."""
    folder, results = outcome
    assert {path.name for path in folder.iterdir()} == {
        *MODES, "config.json", "results.json", "table.md", "comparison.png",
    }  # fmt: skip
    rows = (folder / "table.md").read_text().splitlines()[2:]
    for mode, row in zip(MODES, rows, strict=True):
        config = json.loads((folder / mode / "config.json").read_text())
        assert config["slam"]["imu"] == mode and config["compare"] is False
        in_memory = json.loads(atomic.json_text(results["modes"][mode]))
        assert in_memory == json.loads((folder / mode / "results.json").read_text())
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[0] == mode and cells[1] == f"{100 * results['modes'][mode]['ate_rmse_m']:.2f}"
    assert table(results["modes"]) in report(*outcome)


def test_a_comparison_takes_what_is_finished_and_puts_it_side_by_side(finished, tmp_path, figures):
    for k, mode in enumerate(MODES):
        copy = shutil.copytree(finished.folder, tmp_path / "all" / mode)
        config, settings, results = (
            json.loads((copy / f"{name}.json").read_text()) for name in ("config", "settings", "results")
        )
        config["slam"]["imu"] = settings["imu"] = results["imu"]["mode"] = mode
        results["ate_rmse_m"] = 0.01 * (k + 1)
        for name, content in (("config", config), ("settings", settings), ("results", results)):
            (copy / f"{name}.json").write_text(json.dumps(content))
    tracked = []
    config = imu_slam.Config(smoke=True, compare=True, resume=True, out=tmp_path / "all")
    outcome = imu_slam.run(config, lambda update: tracked.append(update.phase))
    assert not [phase for phase in tracked if phase.startswith("tracking")]  # all were finished
    assert_side_by_side(outcome)
    curves, bars = figures[-1].axes
    assert [text.get_text() for text in bars.get_yticklabels()] == MODES[::-1]
    estimate, ground_truth = (
        trajectories.read_tum(finished.folder / f"{name}.txt").T for name in ("trajectory", "reference")
    )
    errors = trajectory_error.ate(estimate, ground_truth).errors
    for curve in curves.lines[: len(MODES)]:
        np.testing.assert_allclose(curve.get_ydata(), 100 * errors, rtol=1e-3)


@pytest.mark.slow
def test_a_comparison_tracks_with_every_mode(tmp_path):
    outcome = imu_slam.run(imu_slam.Config(smoke=True, compare=True, out=tmp_path / "all"))
    assert_side_by_side(outcome)
    for mode in MODES:
        results = outcome.results["modes"][mode]
        assert results["imu"]["mode"] == mode and results["frames_lost"] == 0
        assert results["ate_rmse_m"] < 0.02


def test_imu_is_simulated_before_thinning(folder):
    whole = load(imu_slam.Config(data=folder, recorded_hz=5.0))
    thinned = load(imu_slam.Config(data=folder, recorded_hz=5.0, rate_hz=2.5, start=2))
    assert len(whole.recording.t) == 8 and len(thinned.recording.t) == 3
    np.testing.assert_array_equal(thinned.recording.t, whole.recording.t[2::2])  # on the same clock
    assert whole.recording.imu is not None and thinned.recording.imu is not None
    np.testing.assert_array_equal(whole.recording.imu.omega_body, thinned.recording.imu.omega_body)
    np.testing.assert_array_equal(thinned.recording.imu.t, whole.recording.imu.t)
    assert "simulated at 200 Hz" in thinned.imu and "slerp" in thinned.imu
    spline = load(imu_slam.Config(data=folder, recorded_hz=5.0, imu_rotation="spline"))
    assert spline.recording.imu is not None
    assert np.abs(spline.recording.imu.omega_body - whole.recording.imu.omega_body).max() > 1e-3


@pytest.mark.parametrize(
    "args, expected",
    [
        (["--daat", "x"], r"Unrecognized options: --daat.*--data"),
        (["--imu", "gyro"], r"invalid choice 'gyro'.*'none', 'loose', 'tight'"),
        (["--frames", "many"], r"--frames.*many"),
        (["--rate-hz", "0"], r"--rate-hz: expected a positive number, got 0"),
        (["--recorded-hz", "-3"], r"--recorded-hz: expected a positive number, got -3"),
        (["--start", "-1"], r"--start: expected at least 0, got -1"),
        (["--frames", "2"], r"--frames: expected at least 3, got 2"),
        (["--voxel", "0"], r"voxel: expected a positive number, got 0"),
        (["--room.width", "0"], r"RoomConfig.width: expected a positive number, got 0"),
        (["--rate-hz", "0.01"], r"expected two frames"),
        (["--format", "sevenscenes"], r"--format: has no effect without --data"),
        (["--recorded-hz", "30"], r"--recorded-hz: has no effect without --data"),
        (["--room.along", "x", "--data", "y"], r"--room\.along: has no effect with --data"),
        (["--room.width", "100", "--data", "y"], r"--room\.width: has no effect with --data"),
        (["--room.sensor", "stereo", "--data", "y"], r"--room\.sensor: has no effect with --data"),
        (["--room.sensor", "sonar"], r"invalid choice 'sonar'.*'axial', 'structured_light', 'stereo'"),
        (["--room.along", "x", "--room.speed", "2"], r"--room\.speed: has no effect with --room\.along"),
        (["--imu-rotation", "slerp"], r"--imu-rotation: has no effect where no IMU is simulated"),
        (
            ["--imu", "none", "--imu-noise.gyro-walk", "0"],
            r"--imu-noise\.gyro-walk: has no effect with --imu none",
        ),
        (["--compare", "--imu", "none"], r"--imu: has no effect with --compare"),
        (["--room.rate-hz", "9"], r"--room\.rate-hz: has no effect as --rate-hz sets it"),
        (["--field.width", "64"], r"--field\.width: has no effect with --track\.method gauss_newton"),
        (["--frame", "world"], r"--frame world: expected --track\.method gradient"),
        (["--track.patience", "3"], r"--track\.patience: has no effect with --track\.method gauss_newton"),
        (
            ["--track.method", "gradient", "--track.dof-weight", "1"],
            r"--track\.dof-weight: has no effect without",
        ),
        (["--map.pixels", "9"], r"--map\.pixels: has no effect with --map\.method fused"),
        (["--no-loops", "--loop.drift", "2"], r"--loop\.drift: has no effect where no loops are looked for"),
        (["--features", "none", "--no-loops"], r"--loops: has no effect without features and a fused map"),
        (
            ["--map.method", "gradient", "--refine", "all"],
            r"--refine: has no effect with --track\.method or --map",
        ),
        (["--loop.candidates", "0"], r"loop\.candidates: expected a .*number"),
        (["--map.sample.front", "9"], r"--map\.sample\.front: has no effect with --map\.method fused"),
        (["--track.sample.band", "1"], r"--track\.sample\.band: has no effect as the voxel sets it"),
        (["--field.window", "0", "1"], r"--field\.window: has no effect as tracking has no"),
        (["--field.coupled"], r"--field\.coupled: has no effect as tracking has a rate for each"),
        (["--field.span", "0", "1"], r"--field\.span: has no effect as tracking sets it"),
        (["--track.method", "gradient", "--field.activation", "relu"], r"expected softplus"),
        (["--name", "x"], r"--name: expected no --out with it"),
        (["--imu-offset-s", "nan"], r"--imu-offset-s: expected a finite number"),
        (["--data", "nowhere"], r"nowhere: expected a recording .*7-Scenes.*got nothing"),
    ],
)
def test_bad_options_are_one_line(args, expected, tmp_path):
    line = complaint(imu_slam.main, *args, "--out", tmp_path / "out")
    assert line.startswith("imu_slam: ")
    assert re.search(expected, line), line
    assert not (tmp_path / "out").exists()


def test_bad_recordings_are_one_line(folder, tmp_path):
    out = tmp_path / "out"
    ask = lambda *args, main=rgbd_slam.main: complaint(
        main, "--data", folder, "--recorded-hz", 5, "--out", out, *args
    )
    assert "expected --start below 8, the frames it has, got 8" in ask("--start", 8)
    assert "expected --frames of at most 6, those from --start 2 on, got 7" in ask(
        "--start", 2, "--frames", 7
    )
    assert "expected at least 3 frames to track, got 2" in ask("--rate-hz", 1)
    for i in range(3, FRAMES):
        (folder / f"frame-{i:06d}.pose.txt").unlink()
    line = ask("--start", 5, main=imu_slam.main)
    assert re.search(
        r"expected inertial readings between 1.000 and 1.400 s .*between 0.000 and 0.400 s", line
    ), line
    for i in range(3):
        (folder / f"frame-{i:06d}.pose.txt").unlink()
    assert "--imu combined expected true poses to simulate an IMU from" in ask(main=imu_slam.main)
    assert "--compare expected true poses" in ask("--compare")
    no_depth = Image.fromarray(np.zeros((60, 80), np.uint16))
    no_depth.save(folder / "frame-000000.depth.png")
    assert "expected depth in the first frame" in ask()  # found only when tracking starts
    for i in range(FRAMES):
        no_depth.save(folder / f"frame-{i:06d}.depth.png")
    assert "expected depth in mm" in ask()
    assert not out.exists()


def test_output_that_cannot_be_written(folder, tmp_path):
    (tmp_path / "file").write_text("mine")
    line = complaint(rgbd_slam.main, "--data", folder, "--out", tmp_path / "file" / "run")
    assert str(tmp_path / "file") in line
    assert (tmp_path / "file").read_text() == "mine"


def test_a_failed_run_takes_away_only_what_it_made(folder, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    (out / "pictures").mkdir()
    Image.fromarray(np.zeros((60, 80), np.uint16)).save(folder / "frame-000000.depth.png")
    complaint(rgbd_slam.main, "--data", folder, "--out", out)
    assert {path.name for path in out.iterdir()} == {"mine.txt", "pictures"}


def test_exit_code_and_streams():
    command = [sys.executable, "-m", "jaxpose.experiments.imu_slam", "--sed", "3"]
    bad = subprocess.run(command, capture_output=True, text=True)
    assert bad.returncode == 1 and bad.stdout == ""
    assert len(bad.stderr.splitlines()) == 1 and "--seed" in bad.stderr


def test_help_all_lists_the_options(capsys):
    with pytest.raises(SystemExit) as stop:
        imu_slam.main(["--help-all"])
    assert not stop.value.code
    said = capsys.readouterr()
    assert said.err == "" and "usage: python -m jaxpose.experiments.imu_slam" in said.out
    options = "--data --format --imu --frame --rate-hz --start --frames --seed --compare --smoke --out --name"
    for option in options.split():
        assert f" {option}" in said.out


def test_defaults():
    assert imu_slam.Config().slam.imu == "combined" and rgbd_slam.Config().slam.imu == "none"
    assert imu_slam.Config().slam == replace(rgbd_slam.Config().slam, imu="combined")


def test_a_run_is_written_on_the_clock_of_its_files(tmp_path, unchecked):
    """Timestamps since 1970, from the third frame on: to the last digit, and the field with them."""
    t0_ns, t = 1_305_031_229_528_748_123, np.arange(6) / 5 + 0.4
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    fitted = fields.fit(fields.bspline((0.0, 1.0), 5), t - t[0], poses)
    recording = SimpleNamespace(t=t, t0_ns=t0_ns, T_world_cam=poses)
    known = fields.Covariances(t - t[0], np.tile(np.eye(6), (6, 1, 1)), np.eye(6)[None])
    result = SimpleNamespace(
        T_world_cam=poses, field=fitted.field, field_params=fitted.params, covariances=known
    )
    _write_trajectory(tmp_path, SimpleNamespace(recording=recording, origin=np.zeros(3)), result)
    for name in ("trajectory", "reference"):
        first = (tmp_path / f"{name}.txt").read_text().splitlines()[1]
        assert first.split()[0] == "1305031229.928748123"
    times = t0_ns / 1e9 + t
    np.testing.assert_allclose(numpy_evaluator.load(tmp_path / "field.npz")(times), poses, atol=1e-4)
    sure = numpy_evaluator.load_covariance(tmp_path / "field.npz")
    np.testing.assert_allclose(sure(times[[0, 5]]), [np.eye(6)] * 2)
