"""Trajectories in a file: numpy alone gives the poses of the fields themselves, at any time."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose import fields
from jaxpose.errors import DataError
from jaxpose.estimate.posterior import table_times
from jaxpose.evaluation import trajectory_error
from jaxpose.fields import PoseNetConfig, numpy_evaluator, serialization
from jaxpose.fields._entries import read_entries
from jaxpose.geometry import rigid, se3

SPAN = (0.5, 4.0)
TIMES = np.concatenate([np.linspace(-0.3, 5.1, 97), np.linspace(0.5, 4.0, 8), [2.0 + 1e-9]])
STAMPS = np.array([0.5, 0.9, 2.0, 2.1, 4.0])


@pytest.fixture(autouse=True)
def double():
    """Fields are smooth functions of time; in float32 they are that only to the rounding of their time."""
    with jax.enable_x64(True):
        yield


def random_like(params, seed=0, scale=0.3):
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    return jax.tree.unflatten(
        tree, [leaf + scale * jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype) for leaf in leaves]
    )


def poses_of(field, params, times=TIMES):
    return np.asarray(jax.jit(jax.vmap(field.pose, (None, 0)))(params, jnp.asarray(times)))


def assert_agrees(tmp_path, expected, field, params, times=TIMES, tolerance=1e-9, **options):
    serialization.save(tmp_path / "field.npz", field, params, **options)
    found = numpy_evaluator.load(tmp_path / "field.npz")(times)
    assert found.dtype == np.float64 and found.shape == (len(times), 4, 4)
    np.testing.assert_allclose(found, expected, atol=tolerance, rtol=0)


@pytest.mark.parametrize(
    "config",
    [
        PoseNetConfig(span=SPAN, layers=3, width=8),
        PoseNetConfig(span=SPAN, layers=6, width=8, activation="softplus"),  # with the skip
        PoseNetConfig(span=SPAN, layers=2, width=8, activation="sigmoid", octaves=0, head="free"),
        PoseNetConfig(span=SPAN, layers=6, width=8, coupled=True, octaves=3, translation_scale=4.0),
        PoseNetConfig(span=SPAN, layers=1, width=8, octaves=7),
        PoseNetConfig(span=SPAN, layers=3, width=8, window=(0.1, 0.5), activation="softplus"),
    ],
    ids=lambda config: f"{config.layers}-{config.activation}-{config.octaves}-{config.coupled}",
)
def test_posenet(tmp_path, config):
    field = fields.posenet(config)
    params = random_like(field.init(jax.random.key(0)))
    if config.window is not None:
        params = fields.set_progress(params, jnp.asarray(0.33))
    expected = poses_of(field, params)
    assert np.ptp(expected[:, :3, 3], axis=0).min() > 0.01, "a trajectory at rest would prove little"
    assert_agrees(tmp_path, expected, field, params)


def test_bspline(tmp_path):
    field = fields.bspline(SPAN, 9)
    params = random_like(field.init(jax.random.key(0)), scale=0.6)
    assert_agrees(tmp_path, poses_of(field, params), field, params)


def test_per_frame_poses(tmp_path):
    field = fields.per_frame_poses(STAMPS)
    params = random_like(field.init(jax.random.key(0)), scale=2.0)
    between = np.array([*TIMES, *(STAMPS[1:] + STAMPS[:-1]) / 2])  # on the borders too
    expected = poses_of(field, params, between)
    assert_agrees(tmp_path, expected, field, params, between)


def turns(angles):
    """Poses turned about one axis and moved, one for each angle [rad]."""
    twists = np.array([[0.3 * k, -k, 0.1, 0.6 * a, 0.0, 0.8 * a] for k, a in enumerate(angles)])
    return se3.exp(jnp.asarray(twists))


@pytest.mark.parametrize("angles", [[0, 0, 1e-9, 1e-4, 0.3], [0, 3.1, 0.01, 2.9, -0.2], [0, 1, 2, 3, 4]])
def test_stamped_at_small_and_large_angles(tmp_path, angles):
    field = fields.piecewise_geodesic(STAMPS, turns(angles))
    assert_agrees(tmp_path, poses_of(field, {}), field, {})


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_corrected_start_and_a_camera_on_a_body(tmp_path, side):
    net = fields.posenet(PoseNetConfig(span=SPAN, layers=3, width=8, translation_scale=2.0))
    initial = fields.piecewise_geodesic(STAMPS, turns([0, 1, 2, 1, 0]))
    T_body_cam = turns([0, 0.7])[1]
    body = (fields.right_correction if side == "right" else fields.left_correction)(net, initial)
    camera = fields.product(body, fields.constant(T_body_cam))
    params = random_like(net.init(jax.random.key(1)))
    T_initial, P = poses_of(initial, {}), poses_of(net, params)
    expected = (T_initial @ P if side == "right" else P @ T_initial) @ np.asarray(T_body_cam)
    assert_agrees(tmp_path, expected, camera, (params, {}))
    alignment = rigid.Similarity(2.5, np.asarray(T_body_cam[:3, :3]), np.array([1.0, 2.0, 3.0]))
    aligned = trajectory_error.align(alignment, expected)
    assert_agrees(tmp_path, aligned, camera, (params, {}), alignment=alignment)


@pytest.mark.parametrize("kind", ["bspline", "per_frame_poses"])
def test_an_alignment_scales_every_family(tmp_path, kind):
    field = fields.bspline(SPAN, 4) if kind == "bspline" else fields.per_frame_poses(STAMPS)
    params = random_like(field.init(jax.random.key(0)))
    alignment = rigid.Similarity(0.3, np.asarray(turns([1.0])[0, :3, :3]), np.array([1.0, 2.0, 3.0]))
    expected = trajectory_error.align(alignment, poses_of(field, params))
    assert_agrees(tmp_path, expected, field, params, alignment=alignment)
    loaded, read = serialization.load(tmp_path / "field.npz")
    np.testing.assert_allclose(poses_of(loaded, read), expected, atol=1e-9)


def test_a_field_in_float32_agrees_to_its_rounding(tmp_path):
    config = PoseNetConfig(span=SPAN, layers=4, width=32, activation="softplus")
    with jax.enable_x64(False):
        field = fields.posenet(config)
        params = random_like(field.init(jax.random.key(0)), scale=0.1)
        times = np.linspace(0.5, 4, 50).astype(np.float32)
        expected = poses_of(field, params, times)
    assert_agrees(tmp_path, expected, field, params, times, tolerance=2e-6)


def test_the_evaluator_is_one_short_file_without_jax(tmp_path):
    """A copy of it alone, in another folder, in a Python that knows nothing of this package."""
    params = jnp.zeros((7, 7)).at[:, 0].set(jnp.arange(7.0))
    serialization.save(tmp_path / "field.npz", fields.bspline(SPAN, 4), params)
    source = Path(numpy_evaluator.__file__).read_text()
    assert len(source.splitlines()) < 160
    (tmp_path / "copied.py").write_text(source)
    code = (
        "import sys, copied; print(copied.load('field.npz')([0.5, 4.0])[:, 0, 3].round(6).tolist(), "
        "[m for m in ('jax', 'jaxpose', 'scipy') if m in sys.modules])"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert said.stdout == "[1.0, 5.0] []\n"


def test_a_window_comes_back_as_far_open_as_it_was(tmp_path):
    field = fields.posenet(PoseNetConfig(span=SPAN, layers=3, width=8, window=(0.1, 0.5)))
    params = fields.set_progress(random_like(field.init(jax.random.key(0))), jnp.asarray(0.33))
    serialization.save(tmp_path / "field.npz", field, params)
    loaded, read = serialization.load(tmp_path / "field.npz")
    assert float(read["progress"]) == pytest.approx((0.33 - 0.1) / 0.4)
    np.testing.assert_allclose(poses_of(loaded, read), poses_of(field, params), atol=1e-9)


def test_a_configuration_comes_back_equal(tmp_path):
    """So that what was compiled for it serves what is loaded."""
    config = PoseNetConfig(span=SPAN, layers=3, width=8, octaves=2, activation="sigmoid", coupled=True)
    for field in (fields.posenet(config), fields.bspline(SPAN, 9), fields.per_frame_poses(STAMPS)):
        serialization.save(tmp_path / "field.npz", field, field.init(jax.random.key(0)))
        assert serialization.load(tmp_path / "field.npz")[0] == field


def test_other_files_are_refused(tmp_path):
    np.savez(tmp_path / "old.npz", control_points=np.zeros((5, 7)), span=np.zeros(2))
    np.savez(tmp_path / "new.npz", version=2)
    np.savez(tmp_path / "table.npz", version=np.ones((11, 3)))
    for name, found in (("old.npz", "none"), ("new.npz", "2"), ("table.npz", "an array of shape .11, 3.$")):
        message = f"{name}: expected a trajectory of version 1, got {found}"
        with pytest.raises(ValueError, match=message if name != "table.npz" else "of version 1, got"):
            numpy_evaluator.load(tmp_path / name)
        with pytest.raises(DataError, match=message):
            serialization.load(tmp_path / name)
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(DataError, match="text.npz: expected a trajectory, got"):
        serialization.load(tmp_path / "text.npz")


def test_a_count_in_another_type_of_number_is_read(tmp_path):
    entries = entries_of("stamped") | {"count": np.asarray(1.0, ">f8")}
    np.savez(tmp_path / "field.npz", **entries)
    field, params = serialization.load(tmp_path / "field.npz")
    evaluated = numpy_evaluator.load(tmp_path / "field.npz")(np.array([0.5]))
    np.testing.assert_allclose(evaluated, poses_of(field, params, [0.5]), atol=1e-6)


def entries_of(kind: str) -> dict[str, np.ndarray]:
    """A small file of each kind of factor, made by hand as the module describes it."""
    entries = {"version": 1, "span": [0.0, 2.0], "count": 1, "0.kind": kind}
    poses = np.tile(np.eye(4), (3, 1, 1))
    of_kind = {
        "stamped": {"times": [0.0, 1.0, 2.0], "poses": poses},
        "table": {"times": [0.0, 1.0, 2.0], "poses": poses},
        "bspline": {"span": [0.0, 2.0], "control_points": np.zeros((5, 7))},
        "posenet": {
            "span": [0.0, 2.0], "weights": [1.0], "activation": "relu", "head": "free",
            "translation_scale": 1.0,
            "translation.0.kernel": np.ones((3, 2)), "translation.0.bias": np.ones(2),
            "translation.1.kernel": np.ones((5, 3)), "translation.1.bias": np.ones(3),
            "rotation.0.kernel": np.ones((3, 4)), "rotation.0.bias": np.ones(4),
        },
    }[kind]  # fmt: skip
    entries |= {f"0.{name}": value for name, value in of_kind.items()}
    entries |= {"covariance_times": [0.0, 1.0], "covariance": np.tile(np.eye(6), (2, 1, 1))}
    return {name: np.asarray(value) for name, value in entries.items()}


@pytest.mark.parametrize("kind", ["stamped", "table", "bspline", "posenet"])
def test_a_file_made_by_hand_is_read(tmp_path, kind):
    np.savez(tmp_path / "field.npz", **entries_of(kind))
    np.testing.assert_array_equal(read_entries(tmp_path / "field.npz")["0.kind"], kind)
    assert serialization.load(tmp_path / "field.npz")[0].span == (0.0, 2.0)


@pytest.mark.parametrize(
    ("kind", "name", "value", "words"),
    [
        ("stamped", "span", [2.0, 0.0], "span: expected two increasing times, got 2 and 0"),
        (
            "stamped",
            "span",
            [0.0, np.inf],
            "span: expected 2 finite numbers from -7.25812e.09 to 7.25812e.09, got inf",
        ),
        ("stamped", "count", -1, "count: expected a whole number from 1 to 8, got -1"),
        ("stamped", "count", [1, 2], "count: expected a whole number from 1 to 8, got int64"),
        (
            "stamped",
            "count",
            2,
            "1.kind: expected one of posenet, bspline, table, stamped, got no such entry",
        ),
        ("stamped", "0.kind", "spline", "0.kind: expected one of .*, got 'spline'"),
        ("stamped", "0.times", [0.0, 2.0, 1.0], "0.times: expected a time after 2.0, got 1.0"),
        ("stamped", "0.times", [0.0, 1.0], "0.poses: expected 2x4x4 finite numbers, got shape"),
        ("stamped", "0.times", np.zeros(0), "0.times: expected one or more, got none"),
        ("table", "0.poses", np.full((3, 4, 4), np.nan), "0.poses: expected 3x4x4 finite numbers, got nan"),
        ("table", "0.poses", np.tile(2 * np.eye(4), (3, 1, 1)), "0.poses: expected rigid transforms"),
        ("bspline", "0.control_points", np.zeros((3, 7)), "0.control_points: expected 4 or more, got 3"),
        ("bspline", "0.control_points", np.full((4, 7), 1e10), "0.control_points: expected nx7 finite"),
        ("bspline", "0.control_points", [[0.0] * 3 + [-1.0] + [0.0] * 3] * 4, "got a norm of 0 in row 0"),
        ("bspline", "0.span", [1.0, 1.0], "0.span: expected two increasing times, got 1 and 1"),
        ("bspline", "0.span", [0.0, 3e-312], "0.span: expected two increasing times, got 0 and 3e-312"),
        (
            "bspline",
            "0.span",
            [-1e308, 1e308],
            "0.span: expected 2 finite numbers from -7.25812e.09 to .*, got -1e.308",
        ),
        ("posenet", "0.activation", "tanh", "0.activation: expected one of relu, softplus, sigmoid"),
        ("posenet", "0.weights", np.ones(99), "0.weights: expected up to 64, got 99"),
        ("posenet", "0.translation_scale", 0.0, "0.translation_scale: expected a finite number above 0"),
        (
            "posenet",
            "0.translation.1.kernel",
            np.ones((4, 3)),
            "translation.1.kernel: expected 2 rows, got 4",
        ),
        ("posenet", "0.rotation.0.bias", np.ones(3), "0.rotation.0.bias: expected 4 finite numbers"),
        ("posenet", "0.rotation.0.kernel", np.full((3, 4), 1e9), "0.rotation.0.kernel: expected nxn finite"),
        ("stamped", "covariance_times", [1.0, 0.0], "covariance_times: expected a time after 1.0, got 0.0"),
        ("stamped", "covariance", np.tile(-np.eye(6), (2, 1, 1)), "covariance: expected covariances, got"),
        ("stamped", "covariance", np.ones((1, 6, 6)), "covariance: expected one for each of 2 times, got 1"),
    ],
)
def test_what_gives_no_poses_is_refused(tmp_path, kind, name, value, words):
    np.savez(tmp_path / "field.npz", **(entries_of(kind) | {name: np.asarray(value)}))
    for read in (read_entries, serialization.load):
        with pytest.raises(DataError, match=f"field.npz: .*{words}"):
            read(tmp_path / "field.npz")


@pytest.mark.parametrize("lasts", [0.0, 0.03, 0.5, 1.0, 1.04, 1.05, 3.0])
def test_a_table_of_covariances_of_any_length_is_read_again(tmp_path, lasts):
    """Of exactly one second there is a single move of one second, of less none."""
    t, early = table_times((10.0, 10.0 + lasts))
    P, moves = np.tile(np.eye(6), (len(t), 1, 1)), np.tile(2 * np.eye(6), (len(early), 1, 1))
    field, params = fields.bspline((10.0, 10.0 + max(lasts, 0.1)), 4), jnp.zeros((7, 7))
    file = tmp_path / "field.npz"
    serialization.save(file, field, params, covariance=fields.Covariances(t, P, moves))
    assert serialization.load(file)[0] == field
    np.testing.assert_allclose(numpy_evaluator.load_covariance(file)(10.0 + lasts), P[:1])
    if len(early):
        later = numpy_evaluator.load_covariance(file, "relative_covariance")
        np.testing.assert_allclose(later(10.0), moves[:1])


def test_covariances_are_kept_and_interpolated(tmp_path):
    """At the times that were written, between them, and a line for what is not known."""
    times, P = np.array([0.5, 1.0, 2.0]), np.stack([np.diag([k + 1.0] * 6) for k in range(3)])
    field, params = fields.bspline(SPAN, 4), jnp.zeros((7, 7))
    serialization.save(
        tmp_path / "field.npz", field, params, covariance=fields.Covariances(times, P, 2 * P[:2])
    )
    found = numpy_evaluator.load_covariance(tmp_path / "field.npz")
    np.testing.assert_allclose(found([0.5, 1.5, 2.0]), [P[0], np.diag([2.5] * 6), P[2]])
    later = numpy_evaluator.load_covariance(tmp_path / "field.npz", "relative_covariance")
    np.testing.assert_allclose(later(0.75), [np.diag([3.0] * 6)])
    assert serialization.load(tmp_path / "field.npz")[0] == field
    with pytest.raises(ValueError, match="expected times between 0.5 and 2 s"):
        found(2.5)
    serialization.save(tmp_path / "other.npz", field, params)
    with pytest.raises(ValueError, match="got a trajectory without"):
        numpy_evaluator.load_covariance(tmp_path / "other.npz")
