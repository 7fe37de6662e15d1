"""Trajectories in a file: numpy alone gives the poses of the fields themselves, at any time."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose import fields
from jaxpose.evaluation import trajectory_error
from jaxpose.fields import PoseNetConfig, numpy_evaluator, serialization
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


def assert_agrees(tmp_path, expected, factors, times=TIMES, tolerance=1e-9, **options):
    serialization.write_field(tmp_path / "field.npz", SPAN, factors, **options)
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
    assert_agrees(tmp_path, expected, [serialization.posenet_factor(config, params)])


def test_bspline(tmp_path):
    field = fields.bspline(SPAN, 9)
    params = random_like(field.init(jax.random.key(0)), scale=0.6)
    assert_agrees(tmp_path, poses_of(field, params), [serialization.bspline_factor(SPAN, params)])


def test_table(tmp_path):
    field = fields.table(STAMPS)
    params = random_like(field.init(jax.random.key(0)), scale=2.0)
    between = np.array([*TIMES, *(STAMPS[1:] + STAMPS[:-1]) / 2])  # on the borders too
    expected = poses_of(field, params, between)
    assert_agrees(tmp_path, expected, [serialization.per_frame_factor(STAMPS, params)], between)


def turns(angles):
    """Poses turned about one axis and moved, one for each angle [rad]."""
    twists = np.array([[0.3 * k, -k, 0.1, 0.6 * a, 0.0, 0.8 * a] for k, a in enumerate(angles)])
    return se3.exp(jnp.asarray(twists))


@pytest.mark.parametrize("angles", [[0, 0, 1e-9, 1e-4, 0.3], [0, 3.1, 0.01, 2.9, -0.2], [0, 1, 2, 3, 4]])
def test_stamped_at_small_and_large_angles(tmp_path, angles):
    poses, timestamps = turns(angles), jnp.asarray(STAMPS)
    field = fields.PoseField(lambda key: None, lambda _, t: fields.piecewise_geodesic(timestamps, poses)(t))
    assert_agrees(tmp_path, poses_of(field, 0), [serialization.piecewise_geodesic_factor(timestamps, poses)])


@pytest.mark.parametrize("side", ["body", "world"])
def test_a_refined_start_and_a_camera_on_a_body(tmp_path, side):
    config = PoseNetConfig(span=SPAN, layers=3, width=8, translation_scale=2.0)
    inner, initial = (
        fields.posenet(config),
        fields.piecewise_geodesic(jnp.asarray(STAMPS), turns([0, 1, 2, 1, 0])),
    )
    T_body_cam = turns([0, 0.7])[1]
    refined = fields.refine(inner, initial, side=side)
    field = refined._replace(
        pose=lambda params, t: fields.body_to_camera(lambda s: refined.pose(params, s), T_body_cam)(t)
    )
    params = random_like(inner.init(jax.random.key(1)))
    start = serialization.piecewise_geodesic_factor(jnp.asarray(STAMPS), turns([0, 1, 2, 1, 0]))
    correction = serialization.posenet_factor(config, params)
    factors = [start, correction] if side == "body" else [correction, start]
    factors.append(serialization.constant_factor(T_body_cam))
    expected = poses_of(field, params)
    assert_agrees(tmp_path, expected, factors)
    alignment = rigid.Similarity(2.5, np.asarray(T_body_cam[:3, :3]), np.array([1.0, 2.0, 3.0]))
    assert_agrees(tmp_path, trajectory_error.align(alignment, expected), factors, alignment=alignment)


@pytest.mark.parametrize("kind", ["bspline", "table"])
def test_an_alignment_scales_every_family(tmp_path, kind):
    field = fields.bspline(SPAN, 4) if kind == "bspline" else fields.table(STAMPS)
    params = random_like(field.init(jax.random.key(0)))
    factor = (
        serialization.bspline_factor(SPAN, params)
        if kind == "bspline"
        else serialization.per_frame_factor(STAMPS, params)
    )
    alignment = rigid.Similarity(0.3, np.asarray(turns([1.0])[0, :3, :3]), np.array([1.0, 2.0, 3.0]))
    expected = trajectory_error.align(alignment, poses_of(field, params))
    assert_agrees(tmp_path, expected, [factor], alignment=alignment)


def test_a_field_in_float32_agrees_to_its_rounding(tmp_path):
    config = PoseNetConfig(span=SPAN, layers=4, width=32, activation="softplus")
    with jax.enable_x64(False):
        field = fields.posenet(config)
        params = random_like(field.init(jax.random.key(0)), scale=0.1)
        times = np.linspace(0.5, 4, 50).astype(np.float32)
        expected = poses_of(field, params, times)
        factor = serialization.posenet_factor(config, params)
    assert_agrees(tmp_path, expected, [factor], times, tolerance=2e-6)


def test_the_evaluator_is_one_short_file_without_jax(tmp_path):
    """A copy of it alone, in another folder, in a Python that knows nothing of this package."""
    params = jnp.zeros((7, 7)).at[:, 0].set(jnp.arange(7.0))
    serialization.write_field(tmp_path / "field.npz", SPAN, [serialization.bspline_factor(SPAN, params)])
    source = Path(numpy_evaluator.__file__).read_text()
    assert len(source.splitlines()) < 100
    (tmp_path / "copied.py").write_text(source)
    code = (
        "import sys, copied; print(copied.load('field.npz')([0.5, 4.0])[:, 0, 3].round(6).tolist(), "
        "[m for m in ('jax', 'jaxpose', 'scipy') if m in sys.modules])"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert said.stdout == "[1.0, 5.0] []\n"


def test_other_files_are_refused(tmp_path):
    np.savez(tmp_path / "old.npz", control_points=np.zeros((5, 7)), span=np.zeros(2))
    with pytest.raises(ValueError, match="old.npz: expected a trajectory of version 1, got none"):
        numpy_evaluator.load(tmp_path / "old.npz")
    np.savez(tmp_path / "new.npz", version=2)
    with pytest.raises(ValueError, match="version 1, got 2"):
        numpy_evaluator.load(tmp_path / "new.npz")
