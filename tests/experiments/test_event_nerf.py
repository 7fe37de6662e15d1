"""The event command: what it starts from, its run folder, killed and resumed, what it refuses."""

import re
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refused
from helpers.killed import whole_and_killed
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.datasets.synthetic import event_orbit, orbit
from jaxpose.evaluation import trajectory_error
from jaxpose.events import log_intensity, mosaic_mask
from jaxpose.experiments import training_loop
from jaxpose.experiments.event_nerf import options
from jaxpose.experiments.event_nerf import pipeline as event_nerf
from jaxpose.experiments.event_nerf.evaluation import corrected, find_truth
from jaxpose.experiments.event_nerf.options import Config, load, studies
from jaxpose.experiments.event_nerf.report import report, table
from jaxpose.fields import numpy_evaluator
from jaxpose.files import trajectories

FILES = {
    "config.json", "settings.json", "results.json", "checkpoint.npz", "trajectory.txt", "reference.txt",
    "start.txt", "field.npz", "camera.json", "events.png", "pose_errors.png", "held_out.png",
}  # fmt: skip


def smoke(**changes) -> Config:
    return Config(**{"smoke": True, **changes})


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A smoke run, and what it reported as it went."""
    seen = []
    outcome = event_nerf.run(smoke(out=tmp_path_factory.mktemp("event_nerf") / "run"), seen.append)
    return outcome, seen


# --- what it starts from ---------------------------------------------------------------------------------


def test_the_orbits_events_add_up_to_what_its_sensor_sees():
    recording = event_orbit.event_orbit(16, poses=60)
    events, camera = recording.events, recording.camera
    mask = mosaic_mask("rggb", 16, 16)
    texture = orbit.paint(0)
    total = np.zeros((16, 16))
    np.add.at(total, (events.y, events.x), events.polarity)
    images = [
        orbit.image(camera, jnp.asarray(T, jnp.float32), texture, event_orbit.BACKGROUND)
        for T in recording.T_world_cam[[0, -1]]
    ]
    first, last = (log_intensity((np.asarray(image) * mask).sum(-1)) for image in images)
    assert_allclose(first, last, atol=1e-3)  # a whole turn
    assert recording.cyclic and recording.threshold == 0.25
    # Spread of the thresholds, blind times and false events let it drift, but not far.
    assert np.abs(0.25 * total).mean() < 0.5
    assert len(recording.t) == 61 and recording.held_out is not None
    assert_array_equal(recording.held_out.T_world_cam, orbit.orbit_poses(recording.held_out.t))


def test_positions_are_linear_between_the_known_and_orientations_are_kept():
    problem = load(smoke(known=6))
    ground_truth, T = problem.recording.T_world_cam, problem.start.T
    assert_allclose(T[:, :3, :3], ground_truth[:, :3, :3])
    known = np.arange(0, 61, 10)
    assert_allclose(T[known], ground_truth[known])
    assert_allclose(T[5, :3, 3], (ground_truth[0, :3, 3] + ground_truth[10, :3, 3]) / 2)
    off = np.linalg.norm(T[:, :3, 3] - ground_truth[:, :3, 3], axis=1)
    assert off.max() > 4 * (1 - np.cos(np.pi / 6)) * 0.8  # the sagitta of a sixth of the circle
    assert load(smoke()).metadata["poses"].startswith("positions known at 10 instants")
    assert load(smoke(axis_offset_deg=1.0)).metadata["poses"].startswith("known at all 61 instants")


def test_a_wrong_axis_turns_every_camera_alike_about_its_own_y_axis():
    problem = load(smoke(axis_offset_deg=2.85))
    turn = np.linalg.inv(problem.recording.T_world_cam) @ problem.start.T
    assert_allclose(turn, np.broadcast_to(turn[0], turn.shape), atol=1e-12)
    cosine, sine = np.cos(np.radians(2.85)), np.sin(np.radians(2.85))
    assert_allclose(turn[0][:3, :3], [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], atol=1e-12)


# --- what it leaves --------------------------------------------------------------------------------------


def test_what_a_run_leaves(finished):
    outcome, seen = finished
    assert {path.name for path in outcome.folder.iterdir()} == FILES
    trained = [update for update in seen if update.phase == "training"]
    assert trained[-1].done == trained[-1].total == 100 and np.isfinite(float(trained[-1].state["loss"]))
    results = outcome.results
    problem = load(smoke())
    ground_truth = find_truth(problem)
    assert ground_truth is not None
    loaded = event_nerf.load_run(outcome.folder)
    poses = training_loop.pose_reader(loaded.model.field, ground_truth.t)(loaded.state.pose)
    errors = trajectory_error.pose_errors(poses, ground_truth.T_world_cam)
    assert errors.rotation_deg == pytest.approx(results["rotation_error_deg"], rel=1e-4)
    assert errors.translation == pytest.approx(results["translation_error"], rel=1e-4)
    at_start = trajectory_error.pose_errors(ground_truth.T_start, ground_truth.T_world_cam)
    assert at_start.translation == pytest.approx(results["start"]["translation_error"], rel=1e-6)
    reference, start = (
        trajectories.read_tum(outcome.folder / f"{name}.txt") for name in ("reference", "start")
    )
    inside = (problem.recording.t >= problem.span[0]) & (problem.recording.t <= problem.span[1])
    assert_allclose(reference.T, problem.recording.T_world_cam[inside], atol=1e-9)
    assert_allclose(start.T, problem.start.T, atol=1e-9)
    trajectory = trajectories.read_tum(outcome.folder / "trajectory.txt")
    field = numpy_evaluator.load(outcome.folder / "field.npz")
    assert_allclose(field(trajectory.t), trajectory.T, atol=5e-5)
    assert results["lpips"] is None and results["psnr"] > 0
    assert table({"posenet": results}) in report(*outcome)
    assert problem.recording.notes[0] in report(*outcome)


def test_resuming_a_finished_run_returns_it_and_one_of_other_settings_is_refused(finished, capsys):
    outcome, _ = finished
    again = event_nerf.run(smoke(out=outcome.folder, resume=True))
    assert again.results["loss" if "loss" in again.results else "psnr"] == outcome.results["psnr"]
    line = complaint("--smoke", "--out", outcome.folder, "--resume", "--known", "6")
    assert "expected --known None, as it began, got 6" in line


@pytest.mark.slow
def test_a_trajectory_that_is_not_refined_stays(tmp_path):
    results = event_nerf.run(smoke(pose="linear", loss="window", out=tmp_path / "run")).results
    assert results["translation_error"] == pytest.approx(results["start"]["translation_error"], rel=1e-6)
    assert results["training"]["loss"] == "window" and results["training"]["net"] is None


def test_studies_vary_one_thing_for_both_trajectories():
    runs = studies(Config(seed=3), "known")
    assert list(runs) == [f"known{n}_{pose}" for n in (20, 10, 6) for pose in ("linear", "posenet")]
    assert (runs["known6_linear"].known, runs["known6_linear"].pose) == (6, "linear")
    assert {config.seed for config in runs.values()} == {3}
    offsets = [config.axis_offset_deg for config in studies(Config(), "offset").values()]
    assert offsets == [1, 1, 2, 2, 2.85, 2.85]


@pytest.mark.slow
def test_a_study_puts_runs_side_by_side(tmp_path, monkeypatch):
    monkeypatch.setattr(options, "_STUDY_KNOWN", (10,))
    outcome = event_nerf.run(smoke(study="known", out=tmp_path / "both"))
    assert list(outcome.results["runs"]) == ["known10_linear", "known10_posenet"]
    assert (outcome.folder / "table.md").read_text().strip() in report(*outcome)


@pytest.mark.slow
def test_sigkill_in_the_middle_changes_no_number(tmp_path):
    whole, killed = whole_and_killed("event_nerf", "--image-width 16 --events 64", 400, tmp_path)
    for key in ("rotation_error_deg", "translation_error", "psnr", "ssim"):
        assert killed[key] == whole[key]


def test_the_correction_undoes_a_slope_and_an_offset_of_log_intensity():
    generator = np.random.default_rng(0)
    ground_truth = generator.uniform(0.4, 0.9, (3, 8, 8, 3))
    level = np.array([0.9, 0.8, 1.1]) * np.log(ground_truth**2.2 + 0.1) + np.array([0.05, -0.1, 0.02])
    rendered = (np.exp(level) - 0.1) ** (1 / 2.2)
    assert np.abs(rendered - ground_truth).max() > 0.02
    assert_allclose(corrected(rendered, ground_truth, 0.1), ground_truth, atol=1e-9)
    flat = np.full_like(ground_truth, 0.5)
    means = np.exp(np.log(ground_truth**2.2 + 0.1).mean((0, 1, 2))) - 0.1
    assert_allclose(corrected(flat, ground_truth, 0.1)[0, 0, 0], means ** (1 / 2.2))


@pytest.mark.data
@pytest.mark.slow
def test_real_events_with_known_poses(data_dir, tmp_path):
    results = event_nerf.run(smoke(data=data_dir / "ecd_slider_depth", out=tmp_path / "run")).results
    assert results["frames"]["psnr"] > 0 and results["psnr"] is None
    assert results["data"]["events"] == 50_000


@pytest.mark.data
@pytest.mark.slow
def test_real_events_with_unknown_poses(data_dir, tmp_path):
    config = smoke(data=data_dir / "ecd_slider_depth", poses="unknown", out=tmp_path / "run")
    outcome = event_nerf.run(config)
    found = outcome.results["displacement"]
    assert found["start_direction_error_deg"] < 5
    contrast = {at["multiple"]: at["contrast"] for at in found["contrasts"]}
    assert contrast[1] > max(contrast[0], contrast[-1])
    assert (outcome.folder / "frames.png").exists() and "n/a" in report(*outcome)


# --- what is not possible --------------------------------------------------------------------------------


complaint = partial(refused.complaint, event_nerf.main)


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--pose", "spline"], "spline"),
        (["--known", "1"], "--known: expected at least 2, got 1"),
        (["--smoke", "--known", "100"], "--known: expected at most the 61 poses of the data, got 100"),
        (["--axis-offset-deg", "50"], "--axis-offset-deg: expected less than 45, got 50"),
        (["--threshold", "0"], "--threshold: expected a positive number, got 0"),
        (["--steps", "150"], "--steps: expected a multiple of 100, got 150"),
        (["--mosaic", "bggr"], "bggr"),
        (["--poses", "unknown"], "--poses unknown: expected --data with a short recording, got the orbit"),
        (["--poses", "unknown", "--known", "6"], "expected neither --known nor"),
        (["--data", "nowhere"], "nowhere: expected a recording of events"),
        (["--resume"], "--resume: expected --out DIR or --name NAME"),
    ],
)
def test_bad_options_are_one_line(args, expected, tmp_path):
    out = [] if "--resume" in args else ["--out", tmp_path / "out"]
    line = complaint(*args, *out)
    assert line.startswith("event_nerf: ")
    assert re.search(expected, line), line
    assert not (tmp_path / "out").exists()
