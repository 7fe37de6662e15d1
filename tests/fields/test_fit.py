"""Fitting recovers known trajectories, to the tolerances that the tracker relies on, compiling once."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxpose.fields import PoseField, PoseNetConfig, bspline, fit, posenet, table

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


def test_bspline_and_table_are_exact():
    times = np.linspace(0, SECONDS, 100)
    poses = helix(times, turn=5.0)
    spline = bspline((0.0, SECONDS), 25)
    found = fit(spline, times, poses, key=jax.random.key(0), steps=500, learning_rate=3e-2)
    translation, rotation = errors(spline, found.params, times, poses)
    assert translation < 1e-4 and rotation < 1e-2
    one_each = table(times)
    found = fit(one_each, times, poses, key=jax.random.key(0), steps=600, learning_rate=3e-2)
    translation, rotation = errors(one_each, found.params, times, poses)
    assert translation < 1e-6 and rotation < 1e-4


def pulled_field():
    """Six numbers that are a pose at rest: the least there is to fit."""
    return PoseField(lambda key: jnp.zeros(3), lambda params, t: jnp.eye(4).at[:3, 3].set(params))


def test_many_poses_are_taken_in_turns():
    """Each step sees 16 of 100 poses, all of them equally often; and one outlier hardly matters."""
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, 0, 3] = 0.3 + 1e-3 * np.sin(np.arange(100))
    poses[57, 0, 3] = 5.0
    found = fit(pulled_field(), np.arange(100.0), poses, params=jnp.zeros(3), batch=16, learning_rate=3e-2)
    # Of the outlier the gradient is that of a residual of _DELTA: 1e-2 / 100 is the pull.
    assert_allclose(found.params, [0.3, 0, 0], atol=1e-3)
    everything = fit(pulled_field(), np.arange(100.0), poses, params=jnp.zeros(3), learning_rate=3e-2)
    assert_allclose(found.params, everything.params, atol=1e-4)


def test_a_warm_start_with_other_values_compiles_once():
    """Once a frame with the same shapes, 16 poses and 40 steps: each goes on from the last."""
    field = posenet(PoseNetConfig(layers=3, width=32, span=(0.0, SECONDS)))
    params, times = field.init(jax.random.key(0)), np.linspace(0, SECONDS, 16)
    chex.clear_trace_counter()
    counted = PoseField(field.init, chex.assert_max_traces(field.pose, n=2))  # of a step, and of the result
    result = fit(counted, times, helix(times), params=params, steps=40)
    for shift in (0.01, 0.02):
        again = fit(
            *(counted, times + shift, helix(times + shift)),
            params=result.params,
            steps=40,
            learning_rate={"translation": 1e-3 * (1 + shift), "rotation": 2e-4},
            decay=shift,
            length_scale=1 + shift,
        )
        assert again.translation_rmse_m < result.translation_rmse_m
        assert again.rotation_rmse_deg < result.rotation_rmse_deg
        result = again


def test_a_rate_of_zero_keeps_a_network():
    field = posenet(PoseNetConfig(layers=3, width=32, span=(0.0, SECONDS)))
    params, times = field.init(jax.random.key(0)), np.linspace(0, SECONDS, 16)
    rates = {"translation": 1e-3, "rotation": 0.0}
    found = fit(field, times, helix(times), params=params, steps=40, learning_rate=rates).params
    chex.assert_trees_all_equal(found["rotation"], params["rotation"])
    assert np.any(found["translation"]["layer_0"]["kernel"] != params["translation"]["layer_0"]["kernel"])


def test_in_double_precision():
    with jax.enable_x64(True):
        times = np.linspace(0, 1, 8)
        poses = np.tile(np.eye(4), (8, 1, 1))
        poses[:, 0, 3] = times**2
        found = fit(table(times), times, poses, key=jax.random.key(0), learning_rate=3e-2)
        assert found.translation_rmse_m.dtype == jnp.float64 and found.translation_rmse_m < 1e-9


def test_a_start_is_required():
    with pytest.raises(ValueError, match="`params` or a `key`"):
        fit(table(np.arange(2.0)), np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))


def test_rates_for_unknown_parts_are_refused():
    field = posenet(PoseNetConfig(layers=2, width=8))
    with pytest.raises(ValueError):
        fit(
            *(field, np.zeros(1), np.eye(4)[None]), key=jax.random.key(0), learning_rate={"translation": 1e-3}
        )
