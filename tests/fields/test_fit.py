"""Fitting recovers known trajectories, to the tolerances that the tracker relies on, compiling once."""

import re
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import make_lsq_spline
from scipy.spatial.transform import Rotation

from jaxpose.fields import PoseField, PoseNetConfig, bspline, fit, fitting, per_frame_poses, posenet
from jaxpose.optim import scale_by_rates

SECONDS = 5.0


def helix(times, turn=2.5):
    """A hand's breadth of a helix, the camera turning by up to `turn` rad and nodding on the way."""
    angle = turn * np.asarray(times) / SECONDS
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = np.stack([0.6 * np.cos(angle) - 0.6, 0.15 * times, 0.6 * np.sin(angle)], axis=-1)
    nod = 0.2 * np.sin(2 * np.asarray(times))
    poses[:, :3, :3] = Rotation.from_euler("YX", np.stack([angle, nod], axis=-1)).as_matrix()
    return poses


def errors(field, params, times, poses):
    """Root mean square distance [m] and angle [deg], by scipy."""
    found = np.asarray(
        jax.jit(jax.vmap(field.pose, in_axes=(None, 0)))(params, jnp.asarray(times, jnp.float32))
    )
    distance = np.linalg.norm(found[:, :3, 3] - poses[:, :3, 3], axis=-1)
    relative = np.swapaxes(found[:, :3, :3].astype(np.float64), -1, -2) @ poses[:, :3, :3]
    angle = np.degrees(Rotation.from_matrix(relative).magnitude())
    return np.sqrt(np.mean(distance**2)), np.sqrt(np.mean(angle**2))


def test_posenet_holds_a_helix():
    times = np.linspace(0, SECONDS, 100)
    field = posenet(PoseNetConfig(span=(0.0, SECONDS), translation_scale=2.0))
    result = fit(field, times, helix(times), key=jax.random.key(0), steps=400)
    translation, rotation = errors(field, result.params, times, helix(times))
    assert translation < 2e-3 and rotation < 0.1
    assert_allclose(result.translation_rmse_m, translation, rtol=1e-2)
    assert_allclose(result.rotation_rmse_deg, rotation, rtol=1e-2)
    between = (times[1:] + times[:-1]) / 2
    translation, rotation = errors(field, result.params, between, helix(between))
    assert translation < 1e-2 and rotation < 0.5


def test_the_free_head_follows_rotations_past_half_a_turn():
    """Twice round in 5 s, which no quaternion with a positive real part can do."""
    times = np.linspace(0, SECONDS, 60)
    poses = helix(times, turn=4 * np.pi)
    shape = dict(span=(0.0, SECONDS), layers=4, width=128)
    field = posenet(PoseNetConfig(head="free", **shape))
    found = fit(field, times, poses, key=jax.random.key(0), steps=1000)
    translation, rotation = errors(field, found.params, times, poses)
    assert translation < 1e-2 and rotation < 1


def test_bspline_and_per_frame_poses_are_exact():
    times = np.linspace(0, SECONDS, 100)
    poses = helix(times, turn=5.0)
    for field in (bspline((0.0, SECONDS), 25), per_frame_poses(times)):
        found = fit(field, times, poses)
        translation, rotation = errors(field, found.params, times, poses)
        assert translation < 2e-5 and rotation < 1e-3
        assert_allclose(found.translation_rmse_m, translation, rtol=0.05, atol=1e-6)
        assert_allclose(found.rotation_rmse_deg, rotation, rtol=0.05, atol=1e-4)


def test_a_spline_without_rotation_is_scipys_least_squares():
    """The same knots, the same poses, twice as many as control points, with noise."""
    times = np.linspace(0, SECONDS, 60)
    poses = np.tile(np.eye(4), (60, 1, 1))
    noise = 1e-5 * np.random.default_rng(0).normal(size=(60, 3))
    poses[:, :3, 3] = np.stack([np.sin(times), np.cos(2 * times), 0.1 * times], axis=-1) + noise
    found = fit(bspline((0.0, SECONDS), 25), times, poses)
    knots = SECONDS / 25 * (np.arange(25 + 7) - 3)
    expected = make_lsq_spline(times, poses[:, :3, 3], knots)
    # Residuals of 1e-5 length scales are thousandths of where the loss bends.
    assert_allclose(found.params[:, :3], expected.c, atol=3e-6)
    assert_allclose(found.params[:, 3:], 0, atol=1e-5)


def test_a_spline_follows_a_noisy_motion_more_closely_than_its_poses():
    times = np.linspace(0, SECONDS, 400)
    truth, rng = helix(times, turn=5.0), np.random.default_rng(0)
    noisy = truth.copy()
    noisy[:, :3, 3] += 1e-3 * rng.normal(size=(400, 3))
    noisy[:, :3, :3] @= Rotation.from_rotvec(1e-3 * rng.normal(size=(400, 3))).as_matrix()
    noisy[7, 0, 3] += 1.0  # an outlier, which pulls as one of a hundredth would
    found = fit(bspline((0.0, SECONDS), 25), times, noisy)
    translation, rotation = errors(found.field, found.params, times, truth)
    # 28 control points and 400 poses: sqrt(28 / 400) of the noise of three axes.
    assert translation < 1.2e-3 * np.sqrt(3 * 28 / 400) and rotation < np.degrees(
        1.2e-3 * np.sqrt(3 * 28 / 400)
    )
    assert found.translation_max_m == pytest.approx(1.0, abs=0.1)


def test_a_spline_with_more_control_points_than_poses_keeps_to_its_start_between():
    times = np.array([0.0, 1.0, 4.0, 5.0])
    poses = helix(times)
    found = fit(bspline((0.0, SECONDS), 20), times, poses)
    assert found.translation_max_m < 1e-5 and found.rotation_max_deg < 1e-3
    T = np.asarray(jax.jit(found.field.pose)(found.params, 2.5))
    middle = poses[1, :3, 3] / 2 + poses[2, :3, 3] / 2
    assert np.linalg.norm(T[:3, 3] - middle) < np.linalg.norm(poses[1, :3, 3] - poses[2, :3, 3]) / 2


def pulled_field():
    """Six numbers that are a pose at rest: the least there is to fit."""
    return PoseField(lambda key: jnp.zeros(3), lambda params, t: jnp.eye(4).at[:3, 3].set(params))


def test_many_poses_are_taken_in_turns():
    """Each step sees 16 of 100 poses, all of them equally often; and one outlier hardly matters."""
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, 0, 3] = 0.3 + 1e-3 * np.sin(np.arange(100))
    poses[57, 0, 3] = 5.0
    tx = optax.adam(optax.exponential_decay(3e-2, 1000, 1e-2))
    settings = dict(params=jnp.zeros(3), tx=tx, length_scale=1.0)
    found = fit(pulled_field(), np.arange(100.0), poses, batch=16, **settings)
    # Of the outlier the gradient is that of a residual of DELTA: 1e-2 / 100 is the pull.
    assert_allclose(found.params, [0.3, 0, 0], atol=1e-3)
    everything = fit(pulled_field(), np.arange(100.0), poses, **settings)
    assert_allclose(found.params, everything.params, atol=1e-4)


def test_any_transformation_descends():
    """One with memory and a line search: a quadratic near its least is done in a few steps."""
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, 3] = [0.003, -0.002, 0.001]
    for tx in (optax.lbfgs(), optax.sgd(2e-5), optax.adamw(1e-3, weight_decay=0.0)):
        settings = dict(params=jnp.zeros(3), tx=tx, length_scale=1.0)
        found = fit(pulled_field(), np.arange(20.0), poses, steps=100, **settings)
        assert_allclose(found.params, poses[0, :3, 3], atol=1e-4)


def test_a_warm_start_with_other_values_compiles_once():
    """Once a frame with the same shapes, 16 poses and 40 steps: each goes on from the last."""
    times = np.linspace(0, SECONDS, 16)
    tx = optax.chain(optax.scale_by_adam(), scale_by_rates({"translation": 1e-3, "rotation": 2e-4}))
    config = PoseNetConfig(layers=3, width=32, span=(0.0, SECONDS), translation_scale=2.0)
    params, before = posenet(config).init(jax.random.key(0)), None
    fitting._descend.clear_cache()
    for shift in (0.0, 0.01, 0.02):
        inside = np.minimum(times + shift, SECONDS - 1e-9 * np.arange(16)[::-1])
        found = fit(
            posenet(config), inside, helix(inside), params=params, steps=40, tx=tx, length_scale=1 + shift
        )
        if before is not None:
            assert found.translation_rmse_m < before.translation_rmse_m
            assert found.rotation_rmse_deg < before.rotation_rmse_deg
        params, before = found.params, found
    assert fitting._descend._cache_size() == 1


def test_a_rate_of_zero_keeps_a_network():
    field = posenet(PoseNetConfig(layers=3, width=32, span=(0.0, SECONDS), translation_scale=2.0))
    params, times = field.init(jax.random.key(0)), np.linspace(0, SECONDS, 16)
    tx = optax.chain(optax.scale_by_adam(), scale_by_rates({"translation": 1e-3, "rotation": 0.0}))
    found = fit(field, times, helix(times), params=params, steps=40, tx=tx).params
    chex.assert_trees_all_equal(found["rotation"], params["rotation"])
    assert np.any(found["translation"]["layer_0"]["kernel"] != params["translation"]["layer_0"]["kernel"])


@pytest.mark.parametrize("kind", ["posenet", "bspline", "per_frame_poses"])
def test_seconds_since_1970_lose_nothing(kind):
    """The same fit as on a clock that starts at zero, asked in the seconds that it was given."""
    times, origin = np.linspace(0, SECONDS, 21), 1_700_000_000.0
    poses = helix(times)
    make = {
        "posenet": lambda t: PoseNetConfig(octaves=2, layers=2, width=16),
        "bspline": lambda t: bspline((t[0], t[-1]), 8),
        "per_frame_poses": per_frame_poses,
    }[kind]
    late = fit(make(origin + times), origin + times, poses, key=jax.random.key(0), steps=20)
    soon = fit(make(times), times, poses, key=jax.random.key(0), steps=20)
    assert late.field.span == (origin, origin + SECONDS)
    assert_allclose(late.translation_rmse_m, soon.translation_rmse_m, rtol=1e-2, atol=1e-6)
    ask = lambda found, start: jax.jit(
        lambda params: [found.field.pose(params, start + t) for t in (0.0, 1.3, SECONDS)]
    )(found.params)
    assert_allclose(ask(late, origin), ask(soon, 0.0), atol=2e-4)


def test_a_configuration_is_completed_for_poses_far_away():
    """Half a kilometre off and turned over: about the middle pose, in a scale that they fill by half."""
    times = np.linspace(0, SECONDS, 40)
    away = np.eye(4)
    away[:3, :3], away[:3, 3] = Rotation.from_rotvec([0, 3.0, 0.3]).as_matrix(), [500.0, -200.0, 30.0]
    poses = away @ helix(times)
    config = PoseNetConfig(octaves=3, layers=3, width=64, activation="softplus", gain=2.0)
    found = fit(config, times, poses, key=jax.random.key(0), steps=1000)
    assert found.field.span == (0.0, SECONDS)
    assert found.translation_rmse_m < 5e-3 and found.rotation_rmse_deg < 1
    translation, rotation = errors(found.field, found.params, times, poses)
    assert_allclose(translation, found.translation_rmse_m, rtol=0.05)


def test_in_double_precision():
    with jax.enable_x64(True):
        times = np.linspace(0, 1, 8)
        poses = np.tile(np.eye(4), (8, 1, 1))
        poses[:, 0, 3] = times**2
        for field in (per_frame_poses(times), bspline((0.0, 1.0), 4)):
            found = fit(field, times, poses)
            assert found.params.dtype == jnp.float64 and found.translation_max_m < 1e-8


GOOD = np.tile(np.eye(4), (3, 1, 1))


def changed(index, value):
    poses = GOOD.copy()
    poses[index] = value
    return poses


def turning(degrees):
    poses = np.tile(np.eye(4), (len(degrees), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(np.radians(degrees), [0, 0, 1])).as_matrix()
    return poses


@pytest.mark.parametrize(
    ("times", "poses", "message"),
    [
        ([], np.zeros((0, 4, 4)), "poses: expected at least one, got none"),
        ([0.5], GOOD[:1], "poses: expected at least two for a field that moves, got one"),
        ([0.0, 1.0], GOOD, "poses: expected shape (2, 4, 4), got (3, 4, 4)"),
        ([0.0, 0.5, 1.0], GOOD[:, :3], "poses: expected shape (3, 4, 4), got (3, 3, 4)"),
        ([0.0, 1.0, 0.5], GOOD, "times: expected increasing times, got 0.5 after 1.0 s"),
        ([0.0, 0.5, 0.5], GOOD, "times: expected increasing times, got 0.5 after 0.5 s"),
        ([0.0, np.nan, 1.0], GOOD, "times: expected finite numbers, got nan at index (1)"),
        (
            [0.0, 0.5, 1.0],
            changed((2, 0, 3), np.nan),
            "poses: expected finite numbers, got nan at index (2, 0, 3)",
        ),
        (
            [0.0, 0.5, 1.0],
            changed((1, 0, 0), 2.0),
            "expected rigid transforms, got one at index 1 whose R^T R",
        ),
        ([0.0, 0.5, 1.0], changed((1, 2, 2), -1.0), "determinant -1"),
        ([0.0, 0.5, 1.0], changed((2, 3, 0), 0.1), "last row [0.1, 0.0, 0.0, 1.0]"),
        ([0.0, 0.5, 1.1], GOOD, "times: expected within the field's span, 0.0 to 1.0 s, got 0.0 to 1.1 s"),
    ],
)
@pytest.mark.parametrize("field", [bspline((0.0, 1.0), 3), posenet(PoseNetConfig(span=(0.0, 1.0)))])
def test_what_no_field_can_follow_is_refused(field, times, poses, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        fit(field, times, poses, key=jax.random.key(0))


def test_what_a_posenet_cannot_reach_is_refused():
    times, key = np.linspace(0, 1, 5), jax.random.key(0)
    far = np.tile(np.eye(4), (5, 1, 1))
    far[3, 1, 3] = -1.5
    bound = PoseNetConfig(span=(0.0, 1.0), layers=2, width=8)
    with pytest.raises(
        ValueError, match=r"translations within 1 m, the PoseNet's translation_scale, got 1.5 m"
    ):
        fit(posenet(bound), times, far, key=key)
    wide = turning([0, 90, 170, 200, 250])
    with pytest.raises(ValueError, match=r"below 180 degrees .* at index 3 \(0.75 s\); use head='free'"):
        fit(posenet(bound), times, wide, key=key)
    # About the middle they are 125 degrees to either side; a whole turn and more is beyond that too.
    assert fit(bound, times, wide, key=key, steps=1).field.span == (0.0, 1.0)
    with pytest.raises(ValueError, match="below 180 degrees from the field's reference"):
        fit(bound, times, turning([0, 100, 200, 300, 400]), key=key)
    free = replace(bound, head="free")
    fit(free, times, turning([0, 100, 200, 300, 400]), key=jax.random.key(1), steps=1)


def test_per_frame_poses_without_a_pose_are_refused():
    with pytest.raises(ValueError, match="one for each of the field's 3 timestamps, got none for 1.0 s"):
        fit(per_frame_poses(np.arange(3.0)), [0.0, 2.0], GOOD[:2])


def test_a_start_is_required():
    with pytest.raises(ValueError, match="`params` or a `key`"):
        fit(posenet(PoseNetConfig(layers=2, width=8)), [-1.0, 0.0, 1.0], GOOD)


def test_rates_for_unknown_parts_are_refused():
    field = posenet(PoseNetConfig(layers=2, width=8))
    with pytest.raises(ValueError):
        fit(field, [-1.0, 0.0, 1.0], GOOD, key=jax.random.key(0), tx=scale_by_rates({"translation": 1e-3}))
