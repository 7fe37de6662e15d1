"""The noisy-pose command: what it starts from, its fields and studies, its run folder, killed and resumed."""

import json
import re
from dataclasses import replace
from functools import partial

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refused
from helpers.killed import whole_and_killed
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import splrep
from scipy.spatial.transform import Rotation

from jaxpose import fields
from jaxpose.datasets.photos import blender
from jaxpose.datasets.photos.sigmas import read_sigmas, write_sigmas
from jaxpose.datasets.photos.transforms_json import write_transforms
from jaxpose.datasets.synthetic import pose_noise
from jaxpose.datasets.synthetic.orbit import orbit
from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments import training_loop
from jaxpose.experiments.noisy_nerf import pipeline as noisy_nerf
from jaxpose.experiments.noisy_nerf import registration
from jaxpose.experiments.noisy_nerf.model import _SMOKE, build, splined
from jaxpose.experiments.noisy_nerf.options import _STUDIES, Config, load, studies
from jaxpose.experiments.noisy_nerf.report import report, table
from jaxpose.experiments.progress import silent
from jaxpose.experiments.training_loop import NetConfig
from jaxpose.fields import numpy_evaluator
from jaxpose.files import atomic, trajectories
from jaxpose.files.camera_json import read_camera
from jaxpose.geometry import rigid

FILES = {
    "config.json", "settings.json", "results.json", "checkpoint.npz", "start.npz", "trajectory.txt",
    "reference.txt", "cameras.png", "held_out.png", "curves.png", "transforms_train.json",
    "transforms_test.json", "train", "held_out", "field.npz", "camera.json",
}  # fmt: skip


def smoke(**changes):
    return Config(smoke=True, test_pose_steps=2, **changes)


complaint = partial(refused.complaint, noisy_nerf.main)


# --- what a training starts from -------------------------------------------------------------------------


@pytest.mark.parametrize("side", ["world", "camera"])
def test_noise_is_on_the_side_and_as_large_as_stated(side):
    problem = load(smoke(noise_translation=0.1, noise_rotation_deg=30.0, side=side, seed=3))
    ground_truth = problem.train.T_world_cam
    assert problem.extent == 8
    to_start = (
        problem.T_start @ np.linalg.inv(ground_truth)
        if side == "world"
        else np.linalg.inv(ground_truth) @ problem.T_start
    )
    off = to_start if side == "camera" else np.linalg.inv(to_start)  # world-to-camera: T_c,w . T_noise
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() == pytest.approx(0.8)
    assert np.degrees(rigid.rotation_angle(off[:, :3, :3], np.eye(3))).max() == pytest.approx(30)
    assert side in problem.metadata["noise"] and "seed 3" in problem.metadata["noise"]
    assert_array_equal(
        load(smoke(noise_translation=0.1, noise_rotation_deg=30.0, side=side, seed=3)).T_start,
        problem.T_start,
    )
    assert (
        np.abs(load(smoke(noise_translation=0.1, side=side, seed=4)).T_start - problem.T_start).max() > 0.01
    )


def test_other_starts():
    none, unknown = load(smoke(noise="none")), load(smoke(noise="unknown"))
    assert_array_equal(none.T_start, none.train.T_world_cam)
    at_rest = np.tile(np.eye(4), (8, 1, 1))
    at_rest[:, 2, 3] = -(unknown.train.near + unknown.train.far) / 2  # the origin in the middle of the depths
    assert_allclose(unknown.T_start, at_rest, rtol=1e-12)
    independent = load(smoke(noise="independent", noise_sigma=0.01))
    assert 0 < np.abs(independent.T_start - none.T_start).max() < 0.2
    assert len(load(smoke(every=2)).train.t) == 4


@pytest.mark.parametrize("masked", [False, True])
def test_pixels_without_mask_do_not_count(masked):
    """A scene of one colour learns that colour, though half of each image shows another."""
    problem = load(smoke(noise="none"))
    rgb = np.full_like(problem.train.rgb, 255)
    rgb[:, : rgb.shape[1] // 2] = 0
    mask = np.zeros(rgb.shape[:3], bool)
    mask[:, rgb.shape[1] // 2 :] = True
    config = smoke(noise="none", pose="per_frame")
    photographs = problem.train._replace(rgb=rgb, mask=mask if masked else None)
    model = build(config, problem._replace(train=photographs))
    state = model.trainer.start(jax.random.key(0))
    state, losses = model.trainer.advance(state, model.views, 100)
    assert (float(losses[-20:].mean()) < 0.06) == masked


@pytest.mark.parametrize("pose", ["posenet", "per_frame", "bspline", "spline_reset"])
def test_every_field_starts_at_the_noisy_poses(pose):
    config = smoke(pose=pose)
    problem = load(config)
    model = build(config, problem)
    poses = training_loop.pose_reader(model.field, problem.train.t)(model.field.init(jax.random.key(0)))
    assert_allclose(poses, problem.T_start, atol=2e-3)


@pytest.mark.parametrize(
    "changes",
    [
        {"pose": "per_frame", "side": "camera"},
        {"pose": "spline_reset"},
        {"pose": "bspline", "side": "camera"},
        {"net": NetConfig(window=(0.1, 0.6))},
        {"net": NetConfig(coupled=True, activation="softplus"), "side": "camera"},
    ],
    ids=["per_frame", "spline_reset", "bspline", "window", "coupled"],
)
def test_every_field_is_a_file_for_numpy(tmp_path, changes):
    """To what float32 leaves of a field over 8 scene units; `test_io_field` holds them to 1e-9 in float64."""
    config = smoke(noise_rotation_deg=20.0, **changes)
    problem = load(config)
    model = build(config, problem)
    leaves, tree = jax.tree.flatten(model.field.init(jax.random.key(0)))
    rng = np.random.default_rng(0)
    leaves = [leaf + jnp.asarray(0.1 * rng.normal(size=leaf.shape), leaf.dtype) for leaf in leaves]
    params = jax.tree.unflatten(tree, leaves)
    span = model.field.span
    fields.save(tmp_path / "field.npz", model.field, params)
    t = np.linspace(span[0] - 0.1, span[1] + 0.1, 41).astype(np.float32)
    poses = np.asarray(jax.jit(jax.vmap(model.field.pose, (None, 0)))(params, jnp.asarray(t)))
    assert_allclose(numpy_evaluator.load(tmp_path / "field.npz")(t), poses, atol=1e-5)


def test_a_table_reset_to_a_spline():
    t = np.linspace(0, 5, 60)
    clean = np.stack([np.sin(t + k) for k in range(6)], axis=-1)
    rough = clean + 0.05 * np.random.default_rng(0).normal(size=clean.shape)
    smooth = np.asarray(splined(jnp.asarray(rough, jnp.float32), t, 25, 60 * 0.05**2))
    assert np.abs(smooth - clean).max() < 0.6 * np.abs(rough - clean).max()
    # scipy's older routine finds the same bound with its own choice of knots.
    for found, column in zip(smooth.T, rough.T, strict=True):
        squares = ((found - column) ** 2).sum()
        assert squares == pytest.approx(60 * 0.05**2, rel=0.05)
        assert len(splrep(t, column, s=60 * 0.05**2)[0]) < 25 + 8
    few = np.asarray(splined(jnp.asarray(rough, jnp.float32), t, 2, 1e-3))
    assert ((few - rough) ** 2).sum() > 1.5 * ((smooth - rough) ** 2).sum(), "two knots cannot follow"


def test_studies_are_the_papers_tables():
    base = Config(seed=5)
    sizes = {name: len(studies(base, name)) for name in _STUDIES}
    assert sizes == {"fields": 4, "encoding": 9, "size": 4, "spline": 6, "ablations": 18}
    configs = {name: studies(base, name) for name in _STUDIES}
    assert all(
        run.seed == 5 and label.isidentifier() for some in configs.values() for label, run in some.items()
    )
    assert configs["encoding"]["sin5"].net == NetConfig() == configs["size"]["layers8_width256"].net


# --- the run folder --------------------------------------------------------------------------------------


def numbers(results):
    """What must not depend on how a run was cut into pieces."""
    keys = ("rotation_error_deg", "translation_error", "centre_error", "psnr", "ssim", "test_time_refined")
    history = np.array(results["history"], float)[:, :4]
    return {key: results[key] for key in keys} | {"history": history.tolist()}


@pytest.mark.slow
def test_a_killed_run_resumed_has_the_numbers_of_a_whole_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("jaxpose.experiments.noisy_nerf.model._SMOKE", build_three_chunks())
    monkeypatch.setattr("jaxpose.experiments.training_loop._SAVE_EVERY_S", 0.0)
    whole = noisy_nerf.run(smoke(pose="spline_reset", out=tmp_path / "whole"))
    assert {path.name for path in whole.folder.iterdir()} == FILES
    assert json.loads((whole.folder / "results.json").read_text()) == json.loads(
        json.dumps(atomic._plain(whole.results))
    )

    class Killed(Exception):
        pass

    def kill(update):
        if update.phase == "training" and update.done == 200:
            raise Killed

    out = tmp_path / "cut"
    with pytest.raises(Killed):
        noisy_nerf.run(smoke(pose="spline_reset", out=out), kill)
    assert (out / "checkpoint.npz").exists() and not (out / "results.json").exists()
    again = ["--smoke", "--test-pose-steps", "2", "--pose", "spline_reset", "--out", str(out), "--resume"]
    noisy_nerf.main(again)
    said = capsys.readouterr()
    assert "SMOKE" in said.out and str(out) in said.out and "| spline_reset" in said.out
    resumed = json.loads((out / "results.json").read_text())
    assert numbers(resumed) == numbers(json.loads((whole.folder / "results.json").read_text()))
    assert "expected --seed 0, as it began, got 1" in complaint(*again, "--seed", 1)
    changed = (out / "results.json").stat().st_mtime_ns
    noisy_nerf.main(again)
    assert (out / "results.json").stat().st_mtime_ns == changed, "a finished run is not done again"
    (out / "results.json").unlink()
    (out / "checkpoint.npz").write_bytes(b"half a file")
    assert "checkpoint.npz: expected a checkpoint" in complaint(*again)


def build_three_chunks():
    return replace(_SMOKE, steps=300, rays=16)


@pytest.mark.slow
def test_sigkill_in_the_middle_changes_no_number(tmp_path):
    args = "--orbit-views 10 --image-width 24 --rays 256 --test-pose-steps 2"
    whole, killed = whole_and_killed("noisy_nerf", args, 500, tmp_path)
    assert numbers(killed) == numbers(whole)


def test_what_a_run_leaves(tmp_path):
    outcome = noisy_nerf.run(smoke(out=tmp_path / "run", noise_translation=0.05))
    results = outcome.results
    trajectory, reference = (
        trajectories.read_tum(outcome.folder / f"{name}.txt") for name in ("trajectory", "reference")
    )
    problem = load(smoke(noise_translation=0.05))
    assert_allclose(reference.T, problem.train.T_world_cam, atol=1e-12)
    assert_allclose(trajectory.t, problem.train.t)
    errors = trajectory_error.pose_errors(trajectory.T, reference.T)
    assert errors.rotation_deg == pytest.approx(results["rotation_error_deg"], rel=1e-6)
    assert errors.translation == pytest.approx(results["translation_error"], rel=1e-6)
    # The refined poses are a data set that this project, and others, can load.
    train, held_out = blender.load(outcome.folder)
    assert_allclose(train.T_world_cam, trajectory.T, atol=1e-9)
    assert_array_equal(train.rgb, problem.train.rgb)
    assert_allclose(held_out.T_world_cam, problem.held_out.T_world_cam, atol=1e-9)
    assert_allclose(np.load(outcome.folder / "start.npz")["T_world_cam"], problem.T_start)
    assert results["lpips"] is None and "n/a" in report(*outcome), (
        "images of 24 pixels are too small for LPIPS"
    )
    loaded = noisy_nerf.load_run(outcome.folder)
    poses = training_loop.pose_reader(loaded.model.field, loaded.problem.train.t)(loaded.state.pose)
    assert trajectory_error.pose_errors(poses, reference.T).rotation_deg == pytest.approx(
        errors.rotation_deg, rel=1e-4
    )
    t = np.linspace(0, problem.train.t[-1], 30).astype(np.float32)
    anywhere = jax.jit(jax.vmap(loaded.model.field.pose, (None, 0)))(loaded.state.pose, jnp.asarray(t))
    aligned = trajectory_error.align(
        trajectory_error.procrustes(poses, reference.T), np.asarray(anywhere, np.float64)
    )
    assert_allclose(numpy_evaluator.load(outcome.folder / "field.npz")(t), aligned, atol=3e-5)
    camera, images, folder, *_ = read_camera(outcome.folder / "camera.json")
    assert camera == problem.train.camera and images == problem.train.files and folder == outcome.folder
    density, _ = loaded.model.scene.query(loaded.state.scene, jnp.zeros(3), jnp.ones(3))
    assert np.isfinite(density) and float(loaded.state.scene["progress"]) == 1
    assert results["test_time_refined"]["psnr"] > 0 and results["wall_s"] > 0 and results["versions"]["jax"]


@pytest.mark.slow
def test_a_shutter_is_known_ignored_or_estimated(tmp_path):
    """A readout of 0.48 s and an exposure of 0.5 s, of 1.25 s between photographs."""
    found = {}
    for shutter in ("known", "ignore", "estimate"):
        moving = {"line_delay_us": 2e4, "exposure_ms": 500.0, "shutter": shutter}
        outcome = noisy_nerf.run(smoke(out=tmp_path / shutter, **moving))
        found[shutter] = outcome.results["shutter"]
        assert (f"({shutter})" in report(*outcome)) == (shutter != "ignore")
    assert found["known"] == {"shutter": "known", "line_delay_us": 2e4, "exposure_ms": 500.0}
    assert found["ignore"] == {"shutter": "ignore", "line_delay_us": 0.0, "exposure_ms": 0.0}
    assert found["estimate"]["line_delay_us"] != 0 and found["estimate"]["exposure_ms"] != 312.5  # the start
    assert set(noisy_nerf.load_run(tmp_path / "estimate").state.pose) == {"field", "shutter"}


@pytest.mark.parametrize("far", [7.5, np.inf])
def test_a_registration_is_read_as_it_was_written(tmp_path, far):
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = 1, 2, 3
    covariance = np.arange(1, 4)[:, None, None] * np.eye(6)
    covariance[1] = np.nan
    written = registration.Registered(
        T,
        np.array([True, False, True]),
        (0.0, 1.0, 2.0),
        (3.0, 2.0, 1.0),
        0.5,
        far,
        12,
        0.25,
        True,
        np.array([[0.5, 0.6, 0.7], [1.0, 1.1, 1.2], [2.0, 1.5, 1.2]]),
        covariance,
        np.nan if far > 8 else 1.25,
    )
    assert written.varied
    registration.save(tmp_path / "registration.npz", written)
    for found, wanted in zip(registration.load(tmp_path / "registration.npz", 3), written, strict=True):
        np.testing.assert_array_equal(found, wanted)
    with pytest.raises(DataError, match="registration.npz: T_world_cam: expected 4"):
        registration.load(tmp_path / "registration.npz", 4)


@pytest.mark.slow
@pytest.mark.parametrize(("noise_deg", "kept"), [(0.0, True), (3.0, False)])
def test_stated_poses_stay_where_photographs_agree_with_them(noise_deg, kept):
    """Calibrated ones are not exchanged for poses by features; those of a rough guess are."""
    problem = load(Config(noise="none", orbit_views=40, image_width=64))
    turned = pose_noise.correlated(problem.train.t, translation=0.0, rotation_deg=noise_deg, seed=1)
    rough = problem._replace(T_start=problem.train.T_world_cam @ turned)
    found = registration.register(Config(noise="none"), rough, silent)
    assert found is not None and found.given == kept
    assert not found.varied  # the orbit is exposed alike
    if kept:
        np.testing.assert_array_equal(found.T_world_cam, rough.T_start)
    else:
        error = lambda T: trajectory_error.pose_errors(T, problem.train.T_world_cam).rotation_deg
        assert error(rough.T_start) > 1.5 and error(found.T_world_cam) < 1.2


@pytest.mark.slow
def test_rough_poses_of_files_give_way_and_held_out_views_are_on_the_trajectory(tmp_path):
    photographs, _ = orbit(40, 64)
    turned = pose_noise.correlated(photographs.t, translation=0.0, rotation_deg=8.0, seed=1)
    for name, rgb in zip(photographs.files, photographs.rgb, strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        imageio.imwrite(tmp_path / name, rgb)
    rough = photographs._replace(T_world_cam=photographs.T_world_cam @ turned)
    write_transforms(tmp_path / "transforms.json", rough)
    config = Config(data=tmp_path, noise="none", image_width=64, steps=300, rays=256, test_pose_steps=0)
    outcome = noisy_nerf.run(replace(config, out=tmp_path / "run"))
    assert outcome.results["registration"]["given_poses_kept"] is False
    assert "where the trajectory is" in outcome.results["protocol"]["image_metrics"]
    truth = dict(zip(photographs.files, photographs.T_world_cam, strict=True))
    train, _ = blender.load(tmp_path)
    true = np.stack([truth[name] for name in train.files])
    found = trajectories.read_tum(outcome.folder / "trajectory.txt").T
    error = lambda T: trajectory_error.pose_errors(T, true).rotation_deg
    assert error(train.T_world_cam) > 3 and error(found) < 1.5
    # Seen from their stated poses, 3 degrees off, they would not be recognised.
    assert outcome.results["psnr"] > 19 and "the poses of the data agree" not in report(*outcome)


@pytest.mark.slow
def test_stated_sigmas_weigh_poses_and_come_out_smaller(tmp_path):
    """A quarter is known to 0.5% of the orbit, others to 5%: all end where the sure ones are."""
    photographs, _ = orbit(40, 64)
    truth = photographs.T_world_cam
    for name, rgb in zip(photographs.files, photographs.rgb, strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        imageio.imwrite(tmp_path / name, rgb)
    random, sure = np.random.default_rng(0), np.arange(40) % 4 == 0
    sigma = np.where(sure, 0.1, 1.0)[:, None] * [0.4, 0.4, 0.4, 0.1, 0.1, 0.1]
    off = rigid.exp(sigma * random.uniform(-1, 1, (40, 6)) * np.sqrt(3))
    write_transforms(tmp_path / "transforms.json", photographs._replace(T_world_cam=truth @ off))
    write_sigmas(tmp_path / "known.csv", photographs.files, sigma[:, [0, 3]])
    config = Config(data=tmp_path, noise="none", pose_sigmas=tmp_path / "known.csv", image_width=64)
    outcome = noisy_nerf.run(replace(config, steps=100, rays=256, test_pose_steps=0, out=tmp_path / "run"))
    assert outcome.results["registration"]["given_poses_kept"] is False
    assert 0.7 < outcome.results["registration"]["stated_off"] < 1.4
    train, _ = blender.load(tmp_path)
    row = {name: k for k, name in enumerate(photographs.files)}
    true = truth[[row[name] for name in train.files]]
    found = trajectories.read_tum(outcome.folder / "trajectory.txt").T
    error = lambda T: np.abs(rigid.log(rigid.inverse(T) @ true))  # in the world as it is, without alignment
    assert np.median(error(train.T_world_cam)[:, :3]) > 0.2
    sigmas, _ = read_sigmas(outcome.folder / "sigmas.csv", train.files)
    for columns, of in ((slice(0, 3), 0), (slice(3, 6), 1)):
        times = np.sqrt(np.mean(error(found)[:, columns] ** 2)) / np.median(sigmas[:, of])
        assert 0.3 < times < 2.5
    assert np.median(sigmas[:, 0]) < 0.04
    assert "sigmas  " in report(*outcome) and "times their sigmas off, by features\n" in report(*outcome)


@pytest.mark.slow
def test_photographs_exposed_differently_are_brought_to_one_exposure(tmp_path):
    """Over 1.2 stops, in every colour by itself, which no file states."""
    photographs, _ = orbit(40, 64)
    random = np.random.default_rng(0)
    brighter = np.exp(random.uniform(-0.4, 0.4, (40, 1)) + random.uniform(-0.1, 0.1, (40, 3)))
    seen = np.clip(photographs.rgb * brighter[:, None, None], 0, 255).round().astype(np.uint8)
    for file, rgb in zip(photographs.files, seen, strict=True):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        imageio.imwrite(tmp_path / file, rgb)
    write_transforms(tmp_path / "transforms.json", photographs)
    config = Config(data=tmp_path, noise="none", image_width=64, steps=200, rays=256, test_pose_steps=10)
    outcome = noisy_nerf.run(replace(config, out=tmp_path / "run"))
    assert outcome.results["registration"]["exposure_stops"] == pytest.approx(1.1, abs=0.2)
    assert "stops: photographs are brought to one" in report(*outcome)
    assert outcome.results["psnr"] > 18 and outcome.results["test_time_refined"]["psnr"] > 18


@pytest.mark.slow
def test_poses_by_features_and_a_scene_of_planes(tmp_path, monkeypatch):
    """Half of the orbit, small; killed and resumed it ends with the same numbers, and is read again."""
    config = Config(
        orbit_views=50, image_width=72, steps=200, rays=512, test_pose_steps=0, out=tmp_path / "whole"
    )
    whole = noisy_nerf.run(config).results
    assert whole["start"]["rotation_error_deg"] > 5
    assert whole["registration"]["photographs"] >= 48 and whole["registration"]["noise_px"] < 0.5
    assert whole["registration"]["rotation_error_deg"] < 2 and whole["rotation_error_deg"] < 2
    assert whole["psnr"] > 18

    def killed(update):
        if update.phase == "training" and update.done == 100:
            raise KeyboardInterrupt

    monkeypatch.setattr("jaxpose.experiments.training_loop._SAVE_EVERY_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        noisy_nerf.run(replace(config, out=tmp_path / "half"), killed)
    found = []
    resumed = noisy_nerf.run(
        replace(config, out=tmp_path / "half", resume=True), lambda u: found.append(u.phase)
    )
    assert not any(phase.startswith("matching") for phase in found)
    for key in ("rotation_error_deg", "translation_error", "psnr", "registration"):
        assert resumed.results[key] == whole[key]
    loaded = noisy_nerf.load_run(tmp_path / "whole")
    poses = training_loop.pose_reader(loaded.model.field, loaded.problem.train.t)(loaded.state.pose)
    error = training_loop.mean_errors(poses, loaded.problem.train.T_world_cam)[0]
    assert error == pytest.approx(whole["rotation_error_deg"], rel=1e-3)


def test_a_study_is_of_fields_that_find_poses_by_themselves():
    assert "--study: expected --preset joint or paper" in complaint("--study", "fields")


@pytest.mark.slow
def test_a_study_puts_runs_side_by_side(tmp_path, monkeypatch):
    every = _STUDIES["fields"]
    two = lambda config: {name: every(config)[name] for name in ("per_frame", "bspline")}
    monkeypatch.setitem(_STUDIES, "fields", two)
    seen = []
    outcome = noisy_nerf.run(
        smoke(study="fields", preset="joint", out=tmp_path / "both"), lambda update: seen.append(update.phase)
    )
    assert {path.name for path in outcome.folder.iterdir()} == {
        "per_frame", "bspline", "table.md", "curves.png", "config.json", "results.json",
    }  # fmt: skip
    assert [phase for phase in seen if phase.startswith("training")] == [
        "training per_frame",
        "training bspline",
    ]
    assert set(outcome.results["runs"]) == {"per_frame", "bspline"}
    assert table(outcome.results["runs"]) in report(*outcome)
    assert (
        json.loads((outcome.folder / "bspline" / "results.json").read_text())["training"]["pose"] == "bspline"
    )


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "noise", "views"), [("nerf_synthetic_lego", "independent", 8), ("llff_fern", "unknown", 8)]
)
def test_real_photographs(data_dir, tmp_path, scene, noise, views):
    config = smoke(data=data_dir / scene, noise=noise, out=tmp_path / "run", pose="per_frame")
    results = noisy_nerf.run(config).results
    assert results["data"]["images"] == views
    estimate, reference = (
        trajectories.read_tum(tmp_path / "run" / f"{name}.txt").T for name in ("trajectory", "reference")
    )
    written = json.loads((tmp_path / "run" / "transforms.json").read_text())["frames"]
    matrices = np.array([frame["transform_matrix"] for frame in written])
    assert_allclose(matrices * [1, -1, -1, 1], estimate, atol=1e-6)  # OpenGL's axes
    # The angle that is left, by scipy, after the rotation that brings the camera centres together.
    centres = [T[:, :3, 3] - T[:, :3, 3].mean(0) for T in (reference, estimate)]
    turned = Rotation.align_vectors(*centres)[0] * Rotation.from_matrix(estimate[:, :3, :3])
    left = turned.inv() * Rotation.from_matrix(reference[:, :3, :3])
    assert results["rotation_error_deg"] == pytest.approx(np.degrees(left.magnitude()).mean(), abs=0.01)
    if scene == "nerf_synthetic_lego":  # the first images, their poses as the file has them
        frames = json.loads((data_dir / scene / "transforms_train.json").read_text())["frames"][:views]
        matrices = np.array([frame["transform_matrix"] for frame in frames])
        assert_allclose(reference, matrices * [1, -1, -1, 1], atol=1e-6)
        # Noise of 0.15 rad about each axis turns a camera by 0.15 sqrt(8 / pi) in the mean; of 8 cameras.
        assert results["start"]["rotation_error_deg"] == pytest.approx(13.7, rel=0.4)


@pytest.mark.data
def test_unknown_poses_start_before_the_middle_of_disparity(data_dir):
    problem = load(smoke(data=data_dir / "llff_fern", noise="unknown"))
    assert_allclose(problem.T_start[:, :3, 3], [[0, 0, -2]] * 8, rtol=1e-6)  # of disparities 1 to 0


def fern_from_nothing(data_dir, folder, steps):
    settings = Config(
        data=data_dir / "llff_fern",
        noise="unknown",
        preset="joint",
        steps=steps,
        test_pose_steps=0,
        out=folder,
    )
    results = noisy_nerf.run(settings).results
    assert results["start"]["translation_error_percent"] > 25
    return results


@pytest.mark.data
@pytest.mark.slow
def test_unknown_poses_of_a_forward_facing_scene_are_found_by_features(data_dir, tmp_path):
    fern = Config(
        data=data_dir / "llff_fern", noise="unknown", steps=600, test_pose_steps=0, out=tmp_path / "r"
    )
    results = noisy_nerf.run(fern).results
    assert results["registration"]["photographs"] == 18
    assert results["registration"]["rotation_error_deg"] < 1.2
    assert results["translation_error_percent"] < 2 and results["rotation_error_deg"] < 3


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.hour
def test_unknown_poses_of_a_forward_facing_scene_are_found_by_colours(data_dir, tmp_path):
    results = fern_from_nothing(data_dir, tmp_path, 5000)
    assert results["translation_error_percent"] < 2.5 and results["rotation_error_deg"] < 6


def test_photographs_without_poses(tmp_path):
    """A run without ground truth: no errors of poses, the poses found as files, training views to look at."""
    problem = load(smoke())
    for i, rgb in enumerate(problem.train.rgb):
        (tmp_path / "photos").mkdir(exist_ok=True)
        imageio.imwrite(tmp_path / "photos" / f"p{i}.png", rgb)
    data = tmp_path / "photos"
    line = complaint("--data", data, "--out", tmp_path / "out", "--smoke")
    assert "p0.png: expected a focal length in its EXIF, got none: --focal-px says it" in line
    line = complaint("--data", data, "--out", tmp_path / "out", "--smoke", "--focal-px", "30")
    assert "photos: expected poses for --noise correlated, got none: --noise unknown" in line
    config = smoke(data=data, noise="unknown", focal_px=30.0, out=tmp_path / "out")
    folder, results = noisy_nerf.run(config)
    assert results["rotation_error_deg"] is None and results["start"]["centre_error"] is None
    assert 0 < results["psnr"] < 60 and results["held_out"] == []
    of_the_orbit = {"transforms_train.json", "transforms_test.json", "train", "held_out"}
    expected = FILES - of_the_orbit - {"reference.txt", "held_out.png"} | {"training.png", "transforms.json"}
    assert {path.name for path in folder.iterdir()} == expected
    text = report(folder, results)
    assert "n/a" in text and "no poses are known" in text and "nan" not in text
    T = trajectories.read_tum(folder / "trajectory.txt").T
    assert len(T) == 8 and json.loads((folder / "results.json").read_text())["data"]["extent"] is None
    assert "trained on" in results["protocol"]["image_metrics"]


# --- what is not possible --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--pose", "spline"], r"spline"),
        (["--steps", "150"], r"--steps: expected a multiple of 100, got 150"),
        (["--every", "0"], r"--every: expected at least 1, got 0"),
        (["--noise-rotation-deg", "200"], r"--noise-rotation-deg: expected at most 180, got 200"),
        (["--noise-translation", "-0.1"], r"--noise-translation: expected at least 0, got -0.1"),
        (["--noise-sigma", "nan"], r"--noise-sigma: expected at least 0, got nan"),
        (["--spline-smoothing", "0"], r"--spline-smoothing: expected a positive number, got 0"),
        (["--pose", "per_frame", "--net.width", "9"], r"--net.width: has no effect with --pose per_frame"),
        (["--spline-knots", "9"], r"--spline-knots: has no effect with --pose posenet"),
        (["--noise-sigma", "1"], r"--noise-sigma: has no effect with --noise correlated"),
        (["--data", "nowhere"], r"nowhere: expected a folder of photographs, or orbit, got nothing"),
        (["--pose-sigmas", "nowhere.csv", "--smoke"], r"nowhere.csv"),
        (
            ["--pose-sigmas", "a/sigmas.csv", "--out", "a"],
            r"--out: expected another place than the input, got a",
        ),
        (["--pose-sigmas", "a", "--noise", "unknown"], r"--pose-sigmas: has no effect with --noise unknown"),
        (["--pose-sigmas", "a", "--preset", "joint"], r"--pose-sigmas: has no effect with --preset joint"),
        (["--resume"], r"--resume: expected --out DIR or --name NAME"),
        (["--exposure-ms", "-1"], r"--exposure-ms: expected at least 0, got -1"),
        (["--line-delay-us", "inf"], r"--line-delay-us: expected a finite number, got inf"),
        (
            ["--shutter", "ignore"],
            r"--shutter ignore: expected the orbit with --line-delay-us or",
        ),
        (
            ["--shutter", "estimate", "--pose", "per_frame"],
            r"expected --pose posenet or bspline, got per",
        ),
        (["--smoke", "--every", "5"], r"expected at least 4 images to train on, got 2"),
    ],
)
def test_bad_options_are_one_line(args, expected, tmp_path):
    out = [] if {"--resume", "--out"} & set(args) else ["--out", tmp_path / "out"]
    line = complaint(*args, *out)
    assert line.startswith("noisy_nerf: ")
    assert re.search(expected, line), line
    assert not (tmp_path / "out").exists()


def test_a_folder_of_nothing_names_what_was_expected(tmp_path):
    (tmp_path / "data").mkdir()
    line = complaint("--data", tmp_path / "data", "--out", tmp_path / "out")
    assert "transforms" in line and "poses_bounds.npy" in line
