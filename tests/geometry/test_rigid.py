"""The numpy twins of se3 against scipy's matrix exponential and logarithm, and against se3 in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm, logm

from jaxpose.geometry import rigid, se3

ANGLES = [0.0, 1e-9, 1e-5, 1e-3, 0.1, 0.999, 1.001, 2.5, 3.1, np.pi - 1e-7, np.pi]


def wedge(xi):
    x, y, z = xi[3:]
    return np.array([[0, -z, y, xi[0]], [z, 0, -x, xi[1]], [-y, x, 0, xi[2]], [0, 0, 0, 0]])


def twist(angle):
    return np.array([1.0, -2.0, 0.5, *(angle * np.array([0.36, 0.48, 0.8]))])


@pytest.mark.parametrize("angle", [*ANGLES, 4.0, 9.0])
def test_exp_is_the_matrix_exponential(angle):
    assert_allclose(rigid.exp(twist(angle)), expm(wedge(twist(angle))), rtol=0, atol=1e-13)
    assert_allclose(rigid.so3_exp(twist(angle)[3:]), expm(wedge(twist(angle)))[:3, :3], rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle):
    xi = twist(angle)
    found = rigid.log(expm(wedge(xi)))
    if angle > np.pi - 1e-5:  # either axis
        assert_allclose(rigid.exp(found), expm(wedge(xi)), rtol=0, atol=1e-8)
        assert np.linalg.norm(found[3:]) == pytest.approx(angle, abs=2e-8)
    else:
        assert_allclose(found, xi, rtol=0, atol=1e-13)


def test_log_is_the_matrix_logarithm():
    xi = twist(2.0)
    assert_allclose(wedge(rigid.log(rigid.exp(xi))), np.real(logm(rigid.exp(xi))), atol=1e-12)


def test_the_twins_agree_with_se3_for_any_leading_axes():
    rng = np.random.default_rng(0)
    xi, points = rng.normal(size=(2, 3, 6)), rng.normal(size=(3, 3))
    T = rigid.exp(xi)
    with jax.enable_x64(True):
        to_jax = jnp.asarray
        assert_allclose(T, se3.exp(to_jax(xi)), atol=1e-14)
        assert_allclose(rigid.log(T), se3.log(to_jax(T)), atol=1e-13)
        assert_allclose(rigid.inverse(T), se3.inverse(to_jax(T)), atol=1e-14)
        assert_allclose(rigid.apply(T[0], points), se3.apply(to_jax(T[0]), to_jax(points)), atol=1e-13)
    assert_allclose(rigid.inverse(T), np.linalg.inv(T), atol=1e-13)


def test_make_broadcasts():
    T = rigid.make(np.eye(3), np.arange(6.0).reshape(2, 3))
    assert_allclose(T, [[[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 2], [0, 0, 0, 1]],
                        [[1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]]])  # fmt: skip


@pytest.mark.parametrize("angle", ANGLES)
def test_angles_of_rotations_and_vectors(angle):
    R = rigid.so3_exp(angle * np.array([0.36, 0.48, 0.8]))
    assert rigid.rotation_angle(np.eye(3), R) == pytest.approx(angle, abs=2e-15)
    a, b = np.array([3.0, 0, 0]), 0.1 * np.array([np.cos(angle), np.sin(angle), 0])
    assert rigid.vector_angle(a, b) == pytest.approx(angle, abs=2e-15)


def test_what_is_a_rotation():
    R = rigid.so3_exp(np.array([0.3, -1.0, 2.0]))
    matrices = np.stack([R, 1.001 * R, -R, R + 1e-9, np.full((3, 3), np.nan)])
    assert rigid.is_rotation(matrices).tolist() == [True, False, False, True, False]
    assert rigid.is_rotation(1.001 * R, tolerance=0.01)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rigid.make(np.eye(4), np.zeros(3)), r"rotation: expected shape \(..., 3, 3\), got \(4, 4\)"),
        (lambda: rigid.make(np.eye(3), np.zeros(2)), r"translation: expected shape \(..., 3\), got \(2,\)"),
        (lambda: rigid.inverse(np.eye(3)), r"T_a_b: expected shape \(..., 4, 4\), got \(3, 3\)"),
        (lambda: rigid.exp(np.zeros(7)), r"xi: expected shape \(..., 6\), got \(7,\)"),
        (lambda: rigid.log(np.zeros((5, 3, 4))), r"T: expected shape \(..., 4, 4\), got \(5, 3, 4\)"),
        (lambda: rigid.apply(np.eye(4), np.zeros(4)), r"point_b: expected shape \(..., 3\), got \(4,\)"),
        (lambda: rigid.rotation_angle(np.eye(3), np.eye(4)), r"R_world_b: expected shape .* got \(4, 4\)"),
    ],
)
def test_a_wrong_shape_is_named(unchecked, call, message):
    with pytest.raises(ValueError, match=message):
        call()
