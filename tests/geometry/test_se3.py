"""se3 against scipy, closed forms and finite differences, in both precisions and at every branch edge.

Each test compiles once for all angles and axes, so a failure names the row of `ANGLES` x `AXES`.
"""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from jaxpose.geometry import se3

pytestmark = pytest.mark.optimised

# 0.4 and 0.403 straddle the switch of the logarithm, 0.999 and 1.001 that of the exponential
ANGLES = [0.0, 1e-8, 1e-4, 3e-3, 0.1, 0.4, 0.403, 0.999, 1.001, 2.0, 3.1, math.pi - 1e-6, math.pi]
# with these, each component of the quaternion is the largest one near pi
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0.6, -0.8], [-0.48, 0.6, 0.64], [2 / 3, 2 / 3, -1 / 3]])
VALUE = {jnp.float32: 2e-6, jnp.float64: 4e-15}
DERIVATIVE = {jnp.float32: 1e-5, jnp.float64: 4e-13}


def assert_close(actual, expected, tolerance):
    np.testing.assert_allclose(np.asarray(actual, float), np.asarray(expected, float), tolerance, tolerance)


def skew(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def wedge(xi):
    """The 4 x 4 matrix whose matrix exponential is the transform."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = skew(xi[3:]), xi[:3]
    return matrix


def expm(xi):
    return np.stack([scipy.linalg.expm(wedge(x)) for x in np.asarray(xi, float)])


def rotation_vectors(angles):
    return np.multiply.outer(angles, AXES).reshape(-1, 3)


def twists(angles):
    """Twists of every angle about every axis."""
    phi = rotation_vectors(angles)
    return np.concatenate([np.broadcast_to([1.0, -2.0, 0.5], phi.shape), phi], axis=1)


def half_turns():
    """Transforms with rotations by exactly pi, free of rounding in the angle."""
    T = np.broadcast_to(np.eye(4), (len(AXES), 4, 4)).copy()
    T[:, :3, :3] = 2 * AXES[:, :, None] * AXES[:, None, :] - np.eye(3)
    T[:, :3, 3] = [1.0, -2.0, 0.5]
    return T


def directions(shape):
    return np.random.default_rng(0).normal(size=shape)


def along(path):
    """(value, first, second derivative) of a function of one scalar, compiled."""
    first = lambda s: jax.jvp(path, (s,), (jnp.ones_like(s),))

    def both(s):
        (value, rate), (_, second) = jax.jvp(first, (s,), (jnp.ones_like(s),))
        return value, rate, second

    return jax.jit(both)


@jax.jit
def log_along(s, base, first, second):
    """(value, first, second derivative) in s of the logarithm of `base + s first + s^2 second`."""
    return along(lambda s: se3.log(base + s * first + s**2 * second))(s)


class TestExp:
    def test_is_the_matrix_exponential(self, dtype):
        xi = jnp.asarray(twists([*ANGLES, 6.0]), dtype)
        T = jax.jit(se3.exp)(xi)
        assert T.dtype == dtype
        assert_close(T, expm(xi), VALUE[dtype])
        phi = np.array(xi[:, 3:], float)
        assert_close(jax.jit(se3.so3_exp)(xi[:, 3:]), Rotation.from_rotvec(phi).as_matrix(), VALUE[dtype])

    def test_derivatives_at_zero_are_those_of_the_power_series(self, dtype):
        v = directions((5, 6))
        W = np.stack([wedge(x) for x in v])
        _, first, second = along(lambda s: se3.exp(s * jnp.asarray(v, dtype)))(jnp.zeros((), dtype))
        assert_close(first, W, VALUE[dtype])
        assert_close(second, W @ W, VALUE[dtype])

    def test_derivatives_are_the_finite_differences(self):
        with jax.enable_x64(True):
            xi = twists(ANGLES)
            v = directions(xi.shape)
            path = along(lambda s: se3.exp(xi + s * v))
            h = 1e-5
            (_, first, second), ahead, behind = (path(jnp.asarray(s)) for s in (0.0, h, -h))
            assert_close(first, (ahead[0] - behind[0]) / (2 * h), 1e-8)
            assert_close(second, (ahead[1] - behind[1]) / (2 * h), 1e-8)


class TestLog:
    def test_undoes_exp(self, dtype):
        xi = jnp.asarray(twists(ANGLES[:-1]), dtype)
        twist, phi = jax.jit(lambda x: (se3.log(se3.exp(x)), se3.so3_log(se3.so3_exp(x[:, 3:]))))(xi)
        assert_close(twist, xi, VALUE[dtype])
        assert_close(phi, xi[:, 3:], VALUE[dtype])

    def test_at_pi_is_one_of_the_two_axes(self, dtype):
        T = half_turns()
        xi = jax.jit(se3.log)(jnp.asarray(T, dtype))
        assert_close(np.linalg.norm(xi[:, 3:], axis=1), math.pi, VALUE[dtype])
        assert_close(expm(xi), T, VALUE[dtype])

    def test_rotation_is_scipys(self, dtype):
        R = Rotation.from_rotvec(rotation_vectors([*ANGLES[:-1], 4.0, 6.0]))
        assert_close(jax.jit(se3.so3_log)(jnp.asarray(R.as_matrix(), dtype)), R.as_rotvec(), VALUE[dtype])

    def test_gradient_is_the_closed_form_up_to_pi(self, dtype):
        """The inverse right Jacobian of SO(3): what a right increment does to the rotation vector."""
        angles = np.array(ANGLES[:-1])
        safe = np.maximum(angles, 1e-2)
        factor = np.where(angles > 1e-2, 1 / safe**2 - 1 / (2 * safe * np.tan(safe / 2)), 1 / 12)
        phi = rotation_vectors(angles)
        W = np.stack([skew(p) for p in phi])
        expected = np.eye(3) + W / 2 + np.repeat(factor, len(AXES))[:, None, None] * (W @ W)
        R = jnp.asarray(Rotation.from_rotvec(phi).as_matrix(), dtype)
        turned = lambda R, v: se3.so3_log(jnp.matmul(R, se3.so3_exp(v), precision="highest"))
        jacobians = lambda R: [
            jac(lambda v: turned(R, v))(jnp.zeros(3, dtype)) for jac in (jax.jacfwd, jax.jacrev)
        ]
        for jacobian in jax.jit(jax.vmap(jacobians))(R):
            # 1e-6 rad before pi the input's own rounding moves the angle, in float64 by 1e-10
            assert_close(jacobian, expected, 1e-5 if dtype == jnp.float32 else 1e-9)

    def test_derivatives_are_the_finite_differences(self):
        with jax.enable_x64(True):
            T = expm(twists([*ANGLES[:-2], math.pi - 1e-3]))
            W = np.stack([wedge(x) for x in directions((len(T), 6))])
            path = lambda s: log_along(jnp.asarray(s), T, T @ W, T @ W @ W / 2)
            h = 1e-5
            (_, first, second), ahead, behind = (path(s) for s in (0.0, h, -h))
            assert_close(first, (ahead[0] - behind[0]) / (2 * h), 2e-8)
            assert_close(second, (ahead[1] - behind[1]) / (2 * h), 2e-8)

    def test_second_derivative_at_the_identity_is_the_bracket(self, dtype):
        a, b = directions((2, len(AXES), 6))
        A, B = (np.stack([wedge(x) for x in v]) for v in (a, b))
        # exp(s A) exp(s B) to second order, whose logarithm is s (A + B) + s^2/2 [A, B]
        terms = np.broadcast_to(np.eye(4), A.shape), A + B, A @ A / 2 + A @ B + B @ B / 2
        _, first, second = log_along(jnp.zeros((), dtype), *(jnp.asarray(x, dtype) for x in terms))
        assert_close(first, a + b, VALUE[dtype])
        assert_close([wedge(x) for x in np.asarray(second, float)], A @ B - B @ A, VALUE[dtype])

    def test_derivatives_at_pi_are_finite(self, dtype):
        T = half_turns()
        W = np.stack([wedge(x) for x in directions((len(AXES), 6))])
        terms = [jnp.asarray(x, dtype) for x in (T, T @ W, T @ W @ W / 2)]
        pulled = jax.jit(jax.grad(lambda T: jnp.sum(se3.log(T))))(terms[0])
        for derivative in (*log_along(jnp.zeros((), dtype), *terms), pulled):
            assert np.all(np.abs(derivative) < 50)


class TestGroup:
    """Axioms on random elements, relative to the size of the translations."""

    three_twists = st.lists(st.floats(-10, 10, width=32), min_size=18, max_size=18).map(
        lambda x: np.reshape(x, (3, 6))
    )
    relaxed = settings(
        max_examples=50,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )

    @staticmethod
    @jax.jit
    def identities(xi):
        """Pairs that must be equal."""
        A, B, C = T = se3.exp(xi)
        A_inverse, B_inverse, _ = se3.inverse(T)
        AB = se3.compose(A, B)
        p, eye = xi[1, :3], jnp.eye(4, dtype=xi.dtype)
        adjoint_A, adjoint_B, adjoint_AB = se3.adjoint(jnp.stack([A, B, AB]))
        matmul = lambda a, b: jnp.matmul(a, b, precision="highest")
        back, conjugated = se3.exp(jnp.stack([se3.log(A), matmul(adjoint_A, xi[1])]))
        return [
            (se3.compose(A, A_inverse), eye),
            (se3.compose(A_inverse, A), eye),
            (se3.compose(A, eye), A),
            (se3.compose(AB, C), se3.compose(A, se3.compose(B, C))),
            (se3.inverse(AB), se3.compose(B_inverse, A_inverse)),
            (se3.apply(AB, p), se3.apply(A, se3.apply(B, p))),
            (back, A),
            (se3.exp(-xi[0]), A_inverse),
            (conjugated, se3.compose(AB, A_inverse)),
            (adjoint_AB, matmul(adjoint_A, adjoint_B)),
        ]

    @given(xi=three_twists)
    @relaxed
    def test_axioms(self, xi, dtype):
        size = 1 + 3 * np.abs(xi[:, :3]).max()
        for left, right in self.identities(jnp.asarray(xi, dtype)):
            assert_close(
                np.asarray(left) / size, np.asarray(right) / size, 2e-5 if dtype == jnp.float32 else 1e-13
            )

    @staticmethod
    @jax.jit
    def there_and_back(xi):
        T = se3.exp(xi)
        return T, se3.log(T)

    @given(xi=three_twists)
    @relaxed
    def test_log_is_short_and_rotations_stay_orthonormal(self, xi, dtype):
        T, back = self.there_and_back(jnp.asarray(xi, dtype))
        assert np.all(np.linalg.norm(back[:, 3:], axis=1) <= math.pi + VALUE[dtype])
        R = np.asarray(T, float)[:, :3, :3]
        assert_close(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), VALUE[dtype])

    def test_operations_are_numpys(self, dtype):
        A, B = expm(twists([0.7, 2.5])[[4, 11]])
        p = np.array([0.3, -1.0, 2.0])
        operations = jax.jit(lambda A, B, p: (se3.compose(A, B), se3.inverse(A), se3.apply(A, p)))
        composed, inverse, moved = operations(*(jnp.asarray(x, dtype) for x in (A, B, p)))
        assert_close(composed, A @ B, VALUE[dtype])
        assert_close(inverse, np.linalg.inv(A), VALUE[dtype])
        assert_close(moved, (A @ [*p, 1])[:3], VALUE[dtype])

    def test_hat_and_vee(self, dtype):
        w = jnp.asarray([0.3, -1.0, 2.0], dtype)
        assert_close(se3.hat(w), skew(w), 0)
        assert_close(se3.vee(se3.hat(w) + 3 * jnp.eye(3, dtype=dtype)), w, 0)  # only the skew part counts


class TestInterpolate:
    def test_twist_is_constant(self, dtype):
        xi, A = twists([2.0])[4], expm(twists([1.3]))[3]
        fractions = np.array([0.0, 0.25, 1.0])
        ends = (jnp.asarray(np.stack([T] * 3), dtype) for T in (A, A @ expm(xi[None])[0]))
        T = jax.jit(se3.interpolate)(*ends, jnp.asarray(fractions, dtype))
        assert_close(T, A @ expm(fractions[:, None] * xi), VALUE[dtype])

    def test_rotation_is_slerp(self, dtype):
        ends = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-1.0, 2.0, 0.5]])
        fractions = np.linspace(0, 1, 7)
        T = se3.make(jnp.asarray(ends.as_matrix(), dtype), jnp.zeros((2, 3), dtype))
        A, B = (jnp.broadcast_to(end, (7, 4, 4)) for end in T)
        between = jax.jit(se3.interpolate)(A, B, jnp.asarray(fractions, dtype))
        assert_close(between[:, :3, :3], Slerp([0, 1], ends)(fractions).as_matrix(), VALUE[dtype])


class TestQuaternion:
    def test_conversions_are_scipys(self, dtype):
        R = Rotation.from_rotvec(rotation_vectors(ANGLES[:-1]))
        q = R.as_quat(canonical=True, scalar_first=True)
        from_matrix = jax.jit(se3.rotation_to_quaternion)(jnp.asarray(R.as_matrix(), dtype))
        from_vector = jax.jit(se3.quaternion_exp)(jnp.asarray(R.as_rotvec(), dtype))
        assert from_matrix.dtype == from_vector.dtype == dtype
        assert_close(from_matrix, q, VALUE[dtype])
        assert_close(from_vector, q, VALUE[dtype])
        # of any length and either sign
        back = jax.jit(se3.quaternion_to_rotation)(jnp.asarray(-3 * q, dtype))
        assert_close(back, R.as_matrix(), VALUE[dtype])

    def test_real_part_is_not_negative_beyond_pi(self, dtype):
        R = Rotation.from_rotvec(rotation_vectors([3.5, 4.5, 6.0]))
        q = jax.jit(se3.rotation_to_quaternion)(jnp.asarray(R.as_matrix(), dtype))
        assert_close(q, R.as_quat(canonical=True, scalar_first=True), VALUE[dtype])

    def test_product_and_inverse_are_scipys(self, dtype):
        a, b = Rotation.from_rotvec([[0.3, -1.0, 2.0], [1.0, 0.2, 0.4]])
        qa, qb = (jnp.asarray(r.as_quat(scalar_first=True), dtype) for r in (a, b))
        assert_close(se3.quaternion_multiply(qa, qb), (a * b).as_quat(scalar_first=True), VALUE[dtype])
        assert_close(se3.quaternion_conjugate(qa), a.inv().as_quat(scalar_first=True), VALUE[dtype])

    def test_derivative_is_half_the_rate(self, dtype):
        """dq = 1/2 q (0, omega), whichever component the conversion divides by."""
        R = Rotation.from_rotvec(rotation_vectors([0.0, 0.5, 2.0, 3.1]))
        omega = np.array([0.3, -1.0, 2.0])
        spin = jnp.asarray(R.as_matrix() @ skew(omega), dtype)
        q, dq = jax.jit(lambda R: jax.jvp(se3.rotation_to_quaternion, (R,), (spin,)))(
            jnp.asarray(R.as_matrix(), dtype)
        )
        w, v = np.asarray(q, float)[:, :1], np.asarray(q, float)[:, 1:]
        expected = np.concatenate([-v @ omega[:, None], w * omega + np.cross(v, omega)], axis=1) / 2
        assert_close(dq, expected, VALUE[dtype])


SINGULAR = {
    "exp": (se3.exp, lambda: twists(ANGLES)),
    "log": (se3.log, lambda: expm(twists(ANGLES[:-1]))),
    "quaternion_exp": (se3.quaternion_exp, lambda: rotation_vectors(ANGLES)),
}


@pytest.mark.parametrize("name", SINGULAR)
def test_derivatives_agree_between_modes_and_precisions(name):
    fn, make = SINGULAR[name]
    x = np.asarray(make(), np.float32)
    v, w = np.float32(directions(x.shape)), np.float32(directions(jax.eval_shape(fn, x).shape))

    def derivatives(dtype):
        at, to, weight = (jnp.asarray(a, dtype) for a in (x, v, w))
        _, first, second = along(lambda s: fn(at + s * to))(jnp.zeros((), dtype))
        pulled = jax.jit(lambda at: jax.vjp(fn, at)[1](weight)[0])(at)
        row = lambda a: np.sum(np.asarray(a, float).reshape(len(x), -1), axis=1)
        assert_close(row(first * weight), row(pulled * to), 10 * DERIVATIVE[dtype])  # sums of up to 16 terms
        return first, second

    single = derivatives(jnp.float32)
    with jax.enable_x64(True):
        double = derivatives(jnp.float64)
    for s, d in zip(single, double, strict=True):
        assert_close(s, d, DERIVATIVE[jnp.float32])


@pytest.mark.parametrize("leading", [(), (2, 3)])
def test_any_leading_axes(leading):
    """The other tests map over one axis; values do not depend on how many there are."""
    array = lambda *shape: jax.ShapeDtypeStruct((*leading, *shape), jnp.float32)
    for fn, inputs, output in [
        (se3.hat, [array(3)], (3, 3)),
        (se3.vee, [array(3, 3)], (3,)),
        (se3.so3_exp, [array(3)], (3, 3)),
        (se3.so3_log, [array(3, 3)], (3,)),
        (se3.exp, [array(6)], (4, 4)),
        (se3.log, [array(4, 4)], (6,)),
        (se3.make, [array(3, 3), array(3)], (4, 4)),
        (se3.compose, [array(4, 4), array(4, 4)], (4, 4)),
        (se3.inverse, [array(4, 4)], (4, 4)),
        (se3.apply, [array(4, 4), array(3)], (3,)),
        (se3.adjoint, [array(4, 4)], (6, 6)),
        (se3.interpolate, [array(4, 4), array(4, 4), array()], (4, 4)),
        (se3.quaternion_multiply, [array(4), array(4)], (4,)),
        (se3.quaternion_conjugate, [array(4)], (4,)),
        (se3.quaternion_exp, [array(3)], (4,)),
        (se3.quaternion_to_rotation, [array(4)], (3, 3)),
        (se3.rotation_to_quaternion, [array(3, 3)], (4,)),
    ]:
        assert jax.eval_shape(fn, *inputs).shape == (*leading, *output)


def test_one_transform_meets_many():
    many = jax.jit(se3.exp)(jnp.asarray(twists([1.3]), jnp.float32))
    T, points = many[2], many[:, :3, 3]
    exact, exact_points = np.asarray(many, float), np.asarray(points, float)
    assert_close(se3.compose(T, many), exact[2] @ exact, 1e-6)
    assert_close(se3.compose(many, T), exact @ exact[2], 1e-6)
    assert_close(se3.apply(T, points), exact_points @ exact[2, :3, :3].T + exact[2, :3, 3], 1e-6)
    assert se3.apply(many[:, None], points[None, :4]).shape == (6, 4, 3)


@pytest.mark.parametrize(
    ("name", "shapes", "message"),
    [
        ("hat", [(4,)], "omega: expected shape (..., 3), got (4,)"),
        ("vee", [(4, 4)], "W: expected shape (..., 3, 3), got (4, 4)"),
        ("so3_exp", [(2,)], "phi: expected shape (..., 3), got (2,)"),
        ("so3_log", [(4, 4)], "R: expected shape (..., 3, 3), got (4, 4)"),
        ("exp", [(5,)], "xi: expected shape (..., 6), got (5,)"),
        ("exp", [()], "xi: expected shape (..., 6), got ()"),
        ("log", [(3, 4)], "T: expected shape (..., 4, 4), got (3, 4)"),
        ("make", [(3, 3), (4,)], "translation: expected shape (..., 3), got (4,)"),
        (
            "make",
            [(3, 3), (2, 3)],
            "rotation, translation: expected the same leading axes, got",
        ),
        ("compose", [(3, 4), (4, 4)], "T_a_b: expected shape (..., 4, 4), got (3, 4)"),
        ("inverse", [(3, 3)], "T_a_b: expected shape (..., 4, 4), got (3, 3)"),
        ("apply", [(4, 4), (2,)], "point_b: expected shape (..., 3), got (2,)"),
        ("apply", [(4, 4), (4,)], "point_b: expected shape (..., 3), got (4,)"),
        ("apply", [(3, 3), (3,)], "T_a_b: expected shape (..., 4, 4), got (3, 3)"),
        (
            "apply",
            [(5, 4, 4), (2, 3)],
            "T_a_b, point_b: expected leading axes that broadcast, got (5,) and (2,)",
        ),
        ("adjoint", [(3, 4)], "T_a_b: expected shape (..., 4, 4), got (3, 4)"),
        ("interpolate", [(4, 4), (3, 4), ()], "T_w_b: expected shape (..., 4, 4), got (3, 4)"),
        (
            "interpolate",
            [(5, 4, 4), (5, 4, 4), (5, 1)],
            "fraction: expected shape (5,), got (5, 1)",
        ),
        ("quaternion_multiply", [(4,), (3,)], "b: expected shape (..., 4), got (3,)"),
        ("quaternion_conjugate", [(3,)], "q: expected shape (..., 4), got (3,)"),
        ("quaternion_exp", [(4,)], "phi: expected shape (..., 3), got (4,)"),
        ("quaternion_to_rotation", [(3,)], "q: expected shape (..., 4), got (3,)"),
        ("rotation_to_quaternion", [(4, 4)], "R: expected shape (..., 3, 3), got"),
    ],
)
def test_a_shape_that_means_nothing_is_refused_by_name(name, shapes, message):
    """As users see it: without the checks of annotations that the tests put around every function."""
    function = inspect.unwrap(getattr(se3, name))
    with pytest.raises(ValueError) as refused:
        function(*(jnp.zeros(shape) for shape in shapes))
    assert str(refused.value).startswith(message)
    with pytest.raises(ValueError):
        jax.jit(function)(*(jnp.zeros(shape) for shape in shapes))
