"""Planar alignment: ground truth it draws, the warps it optimises, and the command with its run folder."""

import json
import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from helpers import refused
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.interpolate import CubicSpline

from jaxpose.errors import DataError
from jaxpose.experiments.planar import alignment, pyramid
from jaxpose.experiments.planar import pipeline as planar
from jaxpose.experiments.planar import task as planar_task
from jaxpose.experiments.planar import warps as planar_warps
from jaxpose.experiments.planar.report import report, table
from jaxpose.experiments.planar.task import Photo
from jaxpose.fields import PoseNetConfig, bspline
from jaxpose.files import atomic
from jaxpose.geometry import se3
from jaxpose.scenes._image import ImageConfig, image

POSES = ("posenet", "per_frame", "spline_reset", "bspline")
NET = PoseNetConfig(layers=2, width=16)
FILES = {"config.json", "results.json", "corner_errors.png", "motions", "motion_00.png", "motion_01.png"}


def ramp(width=96, height=64):
    """A photograph whose colours are its coordinates: (x + 1) / 2, (y + 1) / 2 and a product of the two."""
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    x, y = 2 * x / max(width, height), 2 * y / max(width, height)
    return Photo(np.stack([(x + 1) / 2, (y + 1) / 2, 0.5 + x * y / 2], axis=-1), min(width, height) // 2)


def blobs(width=96, height=64, seed=3):
    """A smooth photograph that looks like nothing else anywhere."""
    generator = np.random.default_rng(seed)
    small = Image.fromarray(generator.integers(0, 256, (8, 12, 3), np.uint8))
    return np.asarray(small.resize((width, height), Image.Resampling.BICUBIC))


@pytest.fixture
def photograph(tmp_path) -> Path:
    path = tmp_path / "blobs.png"
    Image.fromarray(blobs()).save(path)
    return path


# --- the ground truth
# ------------------------------------------------------------------------------------------


def test_photographs_are_read_as_they_are_or_reduced(tmp_path, photograph):
    photo = planar_task.read_photo(photograph)
    assert_array_equal(np.round(photo.rgb * 255), blobs())
    assert photo.crop == 32 and photo.unit == 48
    Image.fromarray(np.full((700, 1280), 51, np.uint8)).save(tmp_path / "grey.png")
    reduced = planar_task.read_photo(tmp_path / "grey.png")
    assert reduced.rgb.shape == (350, 640, 3) and reduced.crop == 175
    assert_allclose(reduced.rgb, 0.2)


@pytest.mark.parametrize(("setup", "patches"), [("paper", 7), ("homography", 5)])
def test_motions_lie_inside_the_image_and_start_at_the_centre_crop(setup, patches):
    photo = ramp(480, 360)
    warps = [planar_task.draw(setup, photo, 0, motion).H_image_patch for motion in range(8)]
    assert all(H.shape == (patches, 3, 3) for H in warps)
    for H in warps:
        assert_allclose(H[0], np.eye(3), atol=1e-15)
        place = planar_task.apply(H, planar_task.corners(photo)) * 240
        assert (np.abs(place) <= [240, 180]).all()
    assert_array_equal(planar_task.draw(setup, photo, 0, 3).H_image_patch, warps[3])
    others = np.stack([*warps, planar_task.draw(setup, photo, 1, 3).H_image_patch])[:, 1:]
    assert len(np.unique(others.round(12), axis=0)) == 9, "every motion and seed is another"


def test_the_papers_motions_are_rigid_and_as_large_as_stated():
    photo = ramp(120, 90)
    moved = [planar_task.draw("paper", photo, 0, motion).H_image_patch[1:] for motion in range(40)]
    H = np.concatenate(moved)
    assert_allclose(H[:, :2, :2] @ H[:, :2, :2].swapaxes(1, 2), np.tile(np.eye(2), (240, 1, 1)), atol=1e-12)
    assert_allclose(np.linalg.det(H[:, :2, :2]), 1)
    # Half the room, 18.75 and 11.25 px, and 20 degrees: uniform at the knots, and nearly so between them.
    spread = np.array([18.75 / 60, 11.25 / 60, np.radians(20)]) / np.sqrt(3)
    found = np.stack([H[:, 0, 2], H[:, 1, 2], np.arctan2(H[:, 1, 0], H[:, 0, 0])], axis=1)
    assert_allclose(found.std(axis=0), spread, rtol=0.25)
    assert_allclose(found.mean(axis=0), 0, atol=0.25 * spread.max())


def test_patches_show_what_the_image_has_there():
    photo = ramp()
    task = planar_task.draw("homography", photo, 0, 0)
    x, y = np.moveaxis(planar_task.apply(task.H_image_patch, planar_task.pixels(photo)), 2, 0)
    assert np.ptp(x) > 1
    inside = (np.abs(x) < 1 - 1 / 96) & (np.abs(y) < 2 / 3 - 1 / 96)  # of the outermost pixels' centres
    expected = np.stack([(x + 1) / 2, (y + 1) / 2, 0.5 + x * y / 2], axis=-1)  # bilinear is exact for these
    assert inside.mean() > 0.9
    assert_allclose(task.rgb[inside], expected[inside], atol=1e-12)
    assert_array_equal(task.rgb[0].reshape(32, 32, 3).round(12), photo.rgb[16:48, 32:64].round(12))


def test_corner_errors_of_known_displacements():
    photo, turn = ramp(480, 360), 0.1
    zero = np.zeros(3)
    ground_truth = planar_task.rigid(zero, zero, zero)
    estimate = planar_task.rigid(
        np.array([0, 3 / 240, 0]), np.array([0, -4 / 240, 0]), np.array([0, 0, turn])
    )
    errors = planar_task.corner_errors(photo, estimate, ground_truth)
    assert_allclose(errors, [0, 5, 2 * np.sin(turn / 2) * 90 * np.sqrt(2)], atol=1e-9)


def test_covered_is_where_patches_are():
    photo = ramp()
    moved = planar_task.rigid(np.array([0, 10 / 48]), np.zeros(2), np.zeros(2))
    expected = np.zeros((64, 96), bool)
    expected[16:48, 32:74] = True
    assert_array_equal(planar_task.covered(photo, moved), expected)


# --- warps ----------------------------------------------------------------------------------------------


def test_homographies_are_the_matrix_exponential(dtype):
    h = np.random.default_rng(0).normal(0, 0.2, (20, 8))
    h1, h2, h3, h4, h5, h6, h7, h8 = h.T
    rows = [[h5, h3, h1], [h4, -h5 - h6, h2], [h7, h8, h6]]
    expected = scipy.linalg.expm(np.moveaxis(np.array(rows), 2, 0))
    tolerance = 2e-6 if dtype == jnp.float32 else 1e-11
    assert_allclose(planar_warps.homography(jnp.asarray(h, dtype)), expected, atol=tolerance)
    assert_allclose(planar_task.homography(h), expected, atol=1e-12)


def test_a_point_under_a_homogeneous_matrix(dtype):
    H = planar_task.homography(np.random.default_rng(0).normal(0, 0.2, (3, 8)))
    xy = np.array([[0.3, -0.7], [0.1, 0.2]])
    found = jax.vmap(jax.vmap(planar_warps.apply, (None, 0)), (0, None))(
        jnp.asarray(H, dtype), jnp.asarray(xy, dtype)
    )
    assert_allclose(found, planar_task.apply(H, xy), atol=1e-6)


def test_the_plane_takes_the_nearest_rotation(dtype):
    xi = np.random.default_rng(1).normal(0, 0.5, (10, 6))
    T = jax.jit(se3.exp)(jnp.asarray(xi, dtype))
    found = np.asarray(planar_warps.planar(T))
    for H, block in zip(found, np.asarray(T, np.float64)[:, :2, :2], strict=True):
        left, _, right = np.linalg.svd(block)
        assert_allclose(H[:2, :2], left @ right, atol=1e-5)  # no reflection for so little tilt
    assert_allclose(found[:, :2, 2], T[:, :2, 3])
    assert_allclose(found[:, 2], np.tile([0, 0, 1], (10, 1)))


@pytest.mark.parametrize("pose", POSES)
def test_warps_start_at_the_identity_and_stay_relative_to_the_first(pose):
    warps = planar_warps.motion_warps(pose, 7, NET)
    params = warps.init(jax.random.key(0))
    compiled = jax.jit(warps.warps)
    assert_allclose(compiled(params), np.tile(np.eye(3), (7, 1, 1)), atol=5e-4)
    generator = np.random.default_rng(0)
    moved = jax.tree.map(lambda x: x + jnp.asarray(generator.normal(0, 0.2, x.shape), x.dtype), params)
    H = np.asarray(compiled(moved))
    assert_allclose(H[0], np.eye(3), atol=1e-6)
    assert np.abs(H[1:] - np.eye(3)).max(axis=(1, 2)).min() > 1e-2, "all others move"
    blocks = H[:, :2, :2]
    assert_allclose(blocks @ blocks.swapaxes(1, 2), np.tile(np.eye(2), (7, 1, 1)), atol=1e-5)


def test_the_gauge_is_the_first_patchs_inverse():
    """A rigid motion of all poses together changes nothing; the relative ones are as numpy has them."""
    warps = planar_warps.motion_warps("bspline", 7, NET)
    spline = np.random.default_rng(0).normal(0, 0.2, (7, 7)) * [1, 1, 0, 0, 0, 0, 1]  # in the plane
    field = bspline((-1.0, 1.0), 4)
    params = jnp.asarray(spline, jnp.float32)
    poses = jax.jit(jax.vmap(field.pose, (None, 0)))
    T = np.asarray(poses(params, jnp.linspace(-1, 1, 7)), np.float64)
    T = np.delete(np.delete(T, 2, axis=1), 2, axis=2)
    assert_allclose(jax.jit(warps.warps)(params), np.linalg.inv(T[0]) @ T, atol=1e-5)


def test_the_first_row_of_a_table_gets_no_gradient():
    for warps in (planar_warps.motion_warps("per_frame", 7, NET), planar_warps.homography_warps(5)):
        params = warps.init(jax.random.key(0)) + 0.1
        gradient = jax.jit(jax.grad(lambda p, warps=warps: jnp.sum(warps.warps(p) ** 2)))(params)
        assert np.all(gradient[0] == 0) and np.abs(gradient[1:]).max() > 0.1


def test_the_reset_is_the_least_squares_natural_spline():
    values = np.random.default_rng(0).normal(size=7)
    times, knots = np.linspace(0, 1, 7), np.linspace(0, 1, 5)
    matrix = planar_warps.spline_projection(7, 5)
    smooth = matrix @ values

    def squares(at_knots):
        return np.sum((CubicSpline(knots, at_knots, bc_type="natural")(times) - values) ** 2)

    best = scipy.optimize.minimize(squares, np.zeros(5), tol=1e-14)
    assert np.sum((smooth - values) ** 2) == pytest.approx(best.fun, rel=1e-6)
    assert best.fun > 0.01, "it smooths"
    assert_allclose(matrix @ smooth, smooth, atol=1e-12)
    assert_allclose(matrix @ (2 - 3 * times), 2 - 3 * times, atol=1e-12)


# --- alignment ------------------------------------------------------------------------------------------


def moved_patches(photo, H):
    return planar_task.Task(H, planar_task.cut(photo, H))


@pytest.mark.parametrize("pose", ["posenet", "per_frame"])
def test_small_motions_are_found(pose):
    photo = Photo(blobs() / 255, 32)
    moved = [np.array(v) for v in ((0, 0.08, 0.12), (0, -0.06, 0.05), (0, 0.1, -0.15))]
    task = moved_patches(photo, planar_task.rigid(*moved))
    warps = planar_warps.motion_warps(pose, 3, PoseNetConfig(layers=4, width=64))
    scene = image(ImageConfig(octaves=4, layers=3, width=64))
    found = alignment.by_adam(photo, scene, warps, steps=600, points=128)(task, jax.random.key(0))
    assert found.corner_px[0] > 5
    assert found.corner_px[-1] < 0.5
    errors = planar_task.corner_errors(photo, found.H_image_patch, task.H_image_patch)
    assert found.corner_px[-1] == pytest.approx(errors[1:].mean())
    assert errors[0] < 1e-4, "the first patch stays, but for rounding"
    assert len(found.loss) == 12 and found.loss[-1] < 0.05 * found.loss[0]
    assert found.psnr > 25
    seen = planar_task.covered(photo, task.H_image_patch)
    assert alignment.psnr((found.picture - photo.rgb)[seen]) > 24, "the picture is the photograph"


def test_the_pyramid_finds_motions_to_a_hundredth_of_a_pixel():
    photo = Photo(blobs() / 255, 32)
    moved = [np.array(v) for v in ((0, 0.08, 0.12, 0.1), (0, -0.06, 0.05, 0.1), (0, 0.1, -0.15, -0.2))]
    warps, told = planar_warps.motion_warps("posenet", 4, NET), []
    task = moved_patches(photo, planar_task.rigid(*moved))
    found = pyramid.by_gauss_newton(photo, warps)(task, jax.random.key(0), lambda *now: told.append(now))
    errors = planar_task.corner_errors(photo, found.H_image_patch, task.H_image_patch)
    assert found.corner_px[0] > 5 and errors.max() < 0.02
    assert found.corner_px[-1] == pytest.approx(errors[1:].mean())
    assert [step for step, *_ in told] == list(range(1, pyramid.count(photo.crop) + 1))
    assert len(found.loss) == len(told) and found.loss[-1] < 1e-2 * found.loss[-pyramid.LAST_STEPS]
    assert found.psnr > 60
    seen = planar_task.covered(photo, task.H_image_patch)
    assert alignment.psnr((found.picture - photo.rgb)[seen]) > 40, "the picture is the photograph"


def test_the_pyramid_says_so_where_nothing_can_be_found():
    """A photograph of one colour: no step is taken and nothing is not a number."""
    photo = Photo(np.full((64, 96, 3), 0.5), 32)
    task = moved_patches(photo, planar_task.rigid(np.array([0, 0.1]), np.zeros(2), np.zeros(2)))
    warps = planar_warps.motion_warps("per_frame", 2, NET)
    found = pyramid.by_gauss_newton(photo, warps)(task, jax.random.key(0))
    assert_allclose(found.H_image_patch, np.tile(np.eye(3), (2, 1, 1)), atol=1e-6)
    assert found.corner_px[-1] == pytest.approx(0.1 * 48, rel=1e-4)


def test_a_steps_derivatives_are_those_of_the_points():
    q = np.random.default_rng(0).normal(0, 0.2, (3, 3))
    xy = np.array([[0.3, -0.7], [0.1, 0.2]])
    at = lambda q: planar_task.apply(planar_task.rigid(*q.T), xy)
    expected = np.stack([(at(q + step) - at(q - step)) / 2e-6 for step in 1e-6 * np.eye(3)], axis=1)
    assert_allclose(pyramid._derivatives(q, xy), expected, atol=1e-9)
    turned = jnp.asarray(planar_task.rigid(*q.T), jnp.float32)
    assert_allclose(planar_warps.coordinates(turned), q, atol=1e-6)


# --- the command ----------------------------------------------------------------------------------------


complaint = partial(refused.complaint, planar.main)


def numbers(folder):
    """What must not depend on how a run was cut into pieces."""
    motions = [json.loads((folder / "motions" / f"{k:02d}.json").read_text()) for k in range(2)]
    return [{key: value for key, value in motion.items() if key != "seconds"} for motion in motions]


@pytest.mark.slow
def test_a_killed_run_resumed_has_the_numbers_of_a_whole_one(photograph, tmp_path, capsys):
    smoke = dict(image=photograph, smoke=True, pose="spline_reset")
    whole = planar.run(planar.Config(out=tmp_path / "whole", **smoke))
    assert {path.name for path in whole.folder.iterdir()} == FILES
    assert json.loads((whole.folder / "results.json").read_text()) == json.loads(
        json.dumps(atomic._plain(whole.results))
    )

    class Killed(Exception):
        pass

    def kill(update):
        if update.phase == "spline_reset 2/2":
            raise Killed

    out = tmp_path / "cut"
    with pytest.raises(Killed):
        planar.run(planar.Config(out=out, **smoke), kill)
    assert not (out / "results.json").exists() and (out / "motions" / "00.json").exists()
    before = (out / "motions" / "00.json").stat().st_mtime_ns
    again = ["--image", str(photograph), "--smoke", "--pose", "spline_reset", "--out", str(out), "--resume"]
    planar.main(again)
    assert (out / "motions" / "00.json").stat().st_mtime_ns == before
    said = capsys.readouterr()
    assert "spline_reset 2/2" in said.err and "spline_reset 1/2" not in said.err
    assert "SMOKE" in said.out and "2 motions" in said.out and str(out) in said.out
    assert numbers(out) == numbers(whole.folder)

    line = complaint(*again, "--seed", 1)
    assert "expected --seed 0, as it began, got 1" in line

    results = whole.results
    errors = [motion["corner_error_px"] for motion in numbers(out)]
    assert results["corner_error_px"]["mean"] == pytest.approx(np.mean(errors))
    assert results["failures"] == [k for k, error in enumerate(errors) if error >= 1]
    assert results["success_rate"] == 1 - len(results["failures"]) / 2
    assert results["wall_s"] > 0 and results["peak_rss_bytes"] > 2**20 and results["versions"]["jax"]


@pytest.fixture
def found_at_once(monkeypatch):
    """Alignment without work: the ground truth, 0.5 px off in x."""

    def quick(photo, *_, **__):
        def align(task, key, on_step=None):
            H = task.H_image_patch + np.eye(3)[0][:, None] * np.eye(3)[2] * 0.5 / photo.unit
            return alignment.Aligned(photo.rgb, H, np.ones(2), np.array([40, 2, 0.5]), 31.0)

        return align

    monkeypatch.setattr(alignment, "by_adam", quick)
    monkeypatch.setattr(pyramid, "by_gauss_newton", quick)


def test_compare_puts_all_pose_fields_side_by_side(found_at_once, photograph, tmp_path):
    outcome = planar.run(
        planar.Config(image=photograph, compare=True, motions=1, smoke=True, out=tmp_path / "all")
    )
    assert {path.name for path in outcome.folder.iterdir()} == {
        *POSES, "config.json", "results.json", "table.md", "comparison.png",
    }  # fmt: skip
    assert set(outcome.results["fields"]) == set(POSES)
    for pose in POSES:
        config = json.loads((outcome.folder / pose / "config.json").read_text())
        assert config["pose"] == pose and config["compare"] is False
        one = outcome.results["fields"][pose]
        assert one["success_rate"] == 1 and one["corner_error_px"]["max"] == pytest.approx(0.5)
        assert ("100 steps" in one["protocol"]["reset"]) == (pose == "spline_reset")
    rows = (outcome.folder / "table.md").read_text().splitlines()
    assert len(rows) == 2 + 4 and "1 of 1" in rows[2]
    assert table(outcome.results["fields"]) in report(*outcome)


def test_homographies(found_at_once, photograph, tmp_path):
    outcome = planar.run(
        planar.Config(image=photograph, setup="homography", motions=1, smoke=True, out=tmp_path / "h")
    )
    assert outcome.results["pose"] == "per_frame" and outcome.results["protocol"]["patches"] == 5
    assert "homography set-up, 5 patches of 32 px" in report(*outcome)
    assert "preset paper, 100 steps" in report(*outcome)


def test_the_protocol_of_the_pyramid(found_at_once, photograph, tmp_path):
    outcome = planar.run(planar.Config(image=photograph, motions=1, out=tmp_path / "fast"))
    assert "preset fast, 16 steps" in report(*outcome)
    assert outcome.results["protocol"]["blurs_px"] == pytest.approx([64 / 15, 32 / 15, 0])


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--setup", "affine"], r"invalid choice 'affine'.*paper.*homography"),
        (["--pose", "spline"], r"spline"),
        (["--motions", "0"], r"--motions: expected at least 1, got 0"),
        (["--points", "0"], r"--points: expected at least 1, got 0"),
        (["--steps", "120"], r"--steps: expected a multiple of 50, got 120"),
        (["--steps", "100"], r"--steps.*preset fast"),
        (["--preset", "fast", "--compare"], r"--preset fast: expected none of --compare"),
        (["--preset", "fast", "--pose", "spline_reset"], r"--preset fast: expected none of"),
        (["--seed", "-1"], r"--seed: expected at least 0, got -1"),
        (["--setup", "homography", "--pose", "posenet"], r"homography: expected --pose per_frame"),
        (["--setup", "homography", "--compare"], r"homography: expected --pose per_frame and no --compare"),
        (["--compare", "--pose", "per_frame"], r"--compare: expected no --pose.*got per_frame"),
        (["--image", "nowhere.png"], r"nowhere\.png"),
    ],
)
def test_bad_options_are_one_line(args, expected, tmp_path):
    line = complaint(*args, "--out", tmp_path / "out")
    assert line.startswith("planar: ")
    assert re.search(expected, line), line
    assert not (tmp_path / "out").exists()


def test_resume_needs_to_know_what():
    assert "--resume: expected --out DIR or --name NAME" in complaint("--resume")


def test_bad_images_are_one_line(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    Image.new("RGB", (40, 20)).save(tmp_path / "small.png")
    Image.new("RGB", (2000, 40)).save(tmp_path / "strip.png")
    for name, expected in (
        ("text.png", "expected an image"),
        ("small.png", "at least 32 px a side, got 40x20"),
        ("strip.png", "less than 20 to 1, got 2000x40"),
    ):
        with pytest.raises(DataError, match=expected):
            planar_task.read_photo(tmp_path / name)
    assert "small.png" in complaint("--image", tmp_path / "small.png", "--out", tmp_path / "out")
    assert complaint("--image", tmp_path, "--out", tmp_path / "out").startswith("planar: ")
    assert not (tmp_path / "out").exists()
