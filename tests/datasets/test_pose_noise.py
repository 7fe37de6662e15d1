"""Noise on poses: stated sizes reached exactly, smooth in time, BARF's distribution, seeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.datasets.synthetic import pose_noise
from jaxpose.geometry import se3

T = np.linspace(3.0, 8.0, 100)


def angles_deg(T_noise):
    return np.degrees(Rotation.from_matrix(T_noise[:, :3, :3]).magnitude())


def lengths(T_noise):
    return np.linalg.norm(T_noise[:, :3, 3], axis=1)


@pytest.mark.parametrize("rotation_deg", [0.5, 30.0, 60.0, 120.0, 180.0])
@pytest.mark.parametrize("translation", [1e-3, 160.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_largest_deviations_are_as_stated(translation, rotation_deg, seed):
    T_noise = pose_noise.correlated(T, translation=translation, rotation_deg=rotation_deg, seed=seed)
    assert lengths(T_noise).max() == pytest.approx(translation, rel=1e-12)
    assert angles_deg(T_noise).max() == pytest.approx(rotation_deg, rel=1e-7)
    R = T_noise[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (100, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(T_noise[:, 3], np.tile([0.0, 0, 0, 1], (100, 1)))


def test_no_noise_is_the_identity_to_the_last_bit():
    np.testing.assert_array_equal(
        pose_noise.correlated(T, translation=0.0, rotation_deg=0.0, seed=5), np.tile(np.eye(4), (100, 1, 1))
    )
    only_moved = pose_noise.correlated(T, translation=1.0, rotation_deg=0.0, seed=5)
    np.testing.assert_array_equal(only_moved[:, :3, :3], np.tile(np.eye(3), (100, 1, 1)))
    only_turned = pose_noise.correlated(T, translation=0.0, rotation_deg=90.0, seed=5)
    assert not only_turned[:, :3, 3].any()
    np.testing.assert_array_equal(pose_noise.independent(7, 0.0, 0), np.tile(np.eye(4), (7, 1, 1)))


@pytest.mark.parametrize("seed", range(5))
def test_correlated_noise_is_continuous_in_time_at_any_size(seed):
    t = np.linspace(0.0, 1.0, 2000)
    T_noise = pose_noise.correlated(t, translation=2.0, rotation_deg=120.0, seed=seed)
    steps = Rotation.from_matrix(T_noise[:-1, :3, :3]).inv() * Rotation.from_matrix(T_noise[1:, :3, :3])
    assert np.degrees(steps.magnitude()).max() < 1.5  # a jump past pi would be one of 100 degrees and more
    assert np.linalg.norm(np.diff(T_noise[:, :3, 3], axis=0), axis=1).max() < 0.05


def test_translation_is_one_cubic_between_knots_and_smooth_across_them():
    t = np.linspace(0.0, 1.0, 501)  # knots at every hundredth sample
    shift = pose_noise.correlated(t, translation=1.0, rotation_deg=0.0, seed=1)[:, :3, 3]
    fourth = np.abs(np.diff(shift, n=4, axis=0))
    assert fourth[202:294].max() < 1e-12 < fourth[300 - 4 : 300].max()  # zero inside an interval alone
    curvature = np.diff(shift, n=2, axis=0)
    assert np.abs(np.diff(curvature, axis=0)).max() < 0.1 * np.abs(curvature).max()  # no jump at a knot


def test_more_knots_make_rougher_noise():
    rough, smooth = (
        np.linalg.norm(
            np.diff(
                pose_noise.correlated(T, translation=1.0, rotation_deg=0.0, seed=0, knots=k)[:, :3, 3], axis=0
            )
        )
        for k in (20, 3)
    )
    assert rough > 3 * smooth


def test_seeds_reproduce_and_differ():
    first, again, other = (
        pose_noise.correlated(T, translation=1.0, rotation_deg=30.0, seed=seed) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    np.testing.assert_array_equal(pose_noise.independent(5, 0.1, 3), pose_noise.independent(5, 0.1, 3))
    assert np.abs(pose_noise.independent(5, 0.1, 3) - pose_noise.independent(5, 0.1, 4)).max() > 0.01


def test_independent_noise_is_the_exponential_of_a_normal_twist():
    T_noise = pose_noise.independent(20_000, 0.15, 0)
    with jax.enable_x64(True):
        twists = np.asarray(jax.jit(se3.log)(jnp.asarray(T_noise)))
    np.testing.assert_allclose(np.cov(twists.T), 0.15**2 * np.eye(6), atol=8e-4)
    np.testing.assert_allclose(twists.mean(0), np.zeros(6), atol=5e-3)


@pytest.mark.parametrize(
    "wrong",
    [{"translation": -1.0}, {"rotation_deg": 181.0}, {"rotation_deg": np.nan}, {"knots": 1}],
)
def test_wrong_settings(wrong):
    settings = {"translation": 1.0, "rotation_deg": 10.0, "seed": 0, **wrong}
    with pytest.raises(ValueError, match="expected translation >= 0"):
        pose_noise.correlated(T, **settings)
    with pytest.raises(ValueError, match="times that differ, got 1 all at 2.0"):
        pose_noise.correlated(np.array([2.0]), translation=1.0, rotation_deg=1.0, seed=0)
    with pytest.raises(ValueError, match="sigma: expected 0 or more, got -0.1"):
        pose_noise.independent(3, -0.1, 0)
