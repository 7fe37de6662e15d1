"""Rotations and rigid transforms as plain arrays with leading batch axes.

`T_a_b` (4 x 4) maps coordinates in frame b to frame a. A tangent is `[translation, rotation]` (m, rad) and
acts on the right: `T . exp(xi)`. Quaternions are wxyz. Where two arguments have batch axes, these broadcast.

Every singular point (angle 0, angle pi) has a series or a branch without division by zero, so values and
derivatives up to second order are finite and right in float32 and float64.

Every function raises a ValueError that names the argument for a shape it is not made for. Shapes are known
when a function is traced, so a compiled function pays nothing for it.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose._checks import check_shapes

_TERMS = 9  # leaves less than 1e-15 of each series below 1, second derivatives included
# (1 - cos x)/x^2 and (x - sin x)/x^3 in x^2
_COSINE = [(-1) ** k / math.factorial(2 * k + 2) for k in range(_TERMS)]
_SINE = [(-1) ** k / math.factorial(2 * k + 3) for k in range(_TERMS)]
# arcsin(s)/s in s^2, for s below 0.2
_ARCSINE = [math.comb(2 * k, k) / 4**k / (2 * k + 1) for k in range(13)]
# (1 - x/2 cot(x/2))/x^2 in x^2, from the Bernoulli numbers |B_2k|
_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798)
_COTANGENT = [b / math.factorial(2 * k) for k, b in enumerate(_BERNOULLI, start=1)]


def hat(omega: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """The skew-symmetric matrix W of a vector, with `W p = omega x p`.

    Args:
        omega: vectors (..., 3).

    Returns:
        Matrices (..., 3, 3).

    >>> print(hat(jnp.array([1.0, 2.0, 3.0])))
    [[ 0. -3.  2.]
     [ 3.  0. -1.]
     [-2.  1.  0.]]
    """
    _require(omega=(omega, 3))
    x, y, z = (omega[..., i] for i in range(3))
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*omega.shape, 3)


def vee(W: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """The vector of the skew-symmetric part of a matrix; the inverse of `hat`.

    Args:
        W: matrices (..., 3, 3); their symmetric part does not matter.

    Returns:
        Vectors (..., 3).

    >>> print(vee(hat(jnp.array([1.0, 2.0, 3.0]))))
    [1. 2. 3.]
    """
    _require(W=(W, 3, 3))
    return 0.5 * jnp.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], axis=-1
    )


def so3_exp(phi: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """The rotation about `phi` by its length.

    Args:
        phi: rotation vectors (..., 3) [rad].

    Returns:
        Rotation matrices (..., 3, 3).

    >>> print(so3_exp(jnp.array([0.0, 0.0, jnp.pi / 2])).round(6) + 0.0)
    [[ 0. -1.  0.]
     [ 1.  0.  0.]
     [ 0.  0.  1.]]
    """
    _require(phi=(phi, 3))
    return _rotation(phi, *_exp_coefficients(_dot(phi, phi))[:2])


def so3_log(R: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """The rotation vector of a rotation matrix, of length at most pi; at pi one of the two axes.

    Args:
        R: rotation matrices (..., 3, 3).

    Returns:
        Rotation vectors (..., 3) [rad].

    >>> print(so3_log(so3_exp(jnp.array([0.0, 0.5, 0.0]))).round(6) + 0.0)
    [0.  0.5 0. ]
    """
    _require(R=(R, 3, 3))
    return _quaternion_log(rotation_to_quaternion(R))[0]


def exp(xi: Float[Array, "*n 6"]) -> Float[Array, "*n 4 4"]:
    """The transform that a constant twist reaches in unit time.

    Args:
        xi: twists (..., 6), [translation, rotation] [m, rad].

    Returns:
        Transforms (..., 4, 4).

    >>> print(exp(jnp.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])))
    [[1. 0. 0. 1.]
     [0. 1. 0. 2.]
     [0. 0. 1. 3.]
     [0. 0. 0. 1.]]
    """
    _require(xi=(xi, 6))
    rho, phi = xi[..., :3], xi[..., 3:]
    square = _dot(phi, phi)
    a, b, c = _exp_coefficients(square)
    translation = (1 - c * square) * rho + b * _cross(phi, rho) + c * _dot(phi, rho) * phi
    return make(_rotation(phi, a, b), translation)


def log(T: Float[Array, "*n 4 4"]) -> Float[Array, "*n 6"]:
    """The twist of least rotation (at most pi) that reaches a transform in unit time: `exp(log(T)) = T`.

    Args:
        T: transforms (..., 4, 4).

    Returns:
        Twists (..., 6), [translation, rotation] [m, rad].

    >>> print(log(exp(jnp.array([1.0, 2.0, 3.0, 0.0, 0.5, 0.0]))).round(5) + 0.0)
    [1.  2.  3.  0.  0.5 0. ]
    """
    _require(T=(T, 4, 4))
    phi, half_cot = _quaternion_log(rotation_to_quaternion(T[..., :3, :3]))
    square = _dot(phi, phi)
    near = square < 1
    series = _polynomial(_COTANGENT, jnp.where(near, square, 0))
    d = jnp.where(near, series, (1 - half_cot) / jnp.where(near, 1, square))
    p = T[..., :3, 3]
    rho = (1 - d * square) * p - 0.5 * _cross(phi, p) + d * _dot(phi, p) * phi
    return jnp.concatenate([rho, phi], axis=-1)


def make(rotation: Float[Array, "*n 3 3"], translation: Float[Array, "*n 3"]) -> Float[Array, "*n 4 4"]:
    """The transform `p -> rotation p + translation`.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3) [m], with the same leading axes.

    Returns:
        Transforms (..., 4, 4).

    >>> print(make(jnp.eye(3), jnp.array([1.0, 2.0, 3.0])))
    [[1. 0. 0. 1.]
     [0. 1. 0. 2.]
     [0. 0. 1. 3.]
     [0. 0. 0. 1.]]
    """
    _require(rotation=(rotation, 3, 3), translation=(translation, 3))
    if rotation.shape[:-2] != translation.shape[:-1]:
        found = f"{rotation.shape} and {translation.shape}"
        raise ValueError(f"rotation, translation: expected the same leading axes, got {found}")
    upper = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.eye(4, dtype=upper.dtype)[3:], (*upper.shape[:-2], 1, 4))
    return jnp.concatenate([upper, last], axis=-2)


def compose(T_a_b: Float[Array, "*#n 4 4"], T_b_c: Float[Array, "*#n 4 4"]) -> Float[Array, "*n 4 4"]:
    """Chain two transforms; the inner frame `b` cancels.

    Args:
        T_a_b, T_b_c: transforms (..., 4, 4), whose leading axes broadcast.

    Returns:
        `T_a_c` (..., 4, 4), computed in full precision on every device.

    >>> T = compose(exp(jnp.array([1.0, 0, 0, 0, 0, 0])), exp(jnp.array([0, 2.0, 0, 0, 0, 0])))
    >>> print(T[:3, 3])
    [1. 2. 0.]
    """
    _require(T_a_b=(T_a_b, 4, 4), T_b_c=(T_b_c, 4, 4))
    return _product(T_a_b, T_b_c)


def inverse(T_a_b: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4 4"]:
    """`T_b_a`, taking the rotation as orthonormal.

    Args:
        T_a_b: transforms (..., 4, 4).

    Returns:
        `T_b_a` (..., 4, 4).

    >>> print(inverse(exp(jnp.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])))[:3, 3])
    [-1. -2. -3.]
    """
    _require(T_a_b=(T_a_b, 4, 4))
    R_b_a = jnp.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return make(R_b_a, -_rotate(R_b_a, T_a_b[..., :3, 3]))


def apply(T_a_b: Float[Array, "*#n 4 4"], point_b: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """The coordinates in frame a of points known in frame b.

    Args:
        T_a_b: transforms (..., 4, 4).
        point_b: points (..., 3) [m]; the leading axes of both broadcast.

    Returns:
        Points (..., 3) [m].

    >>> print(apply(exp(jnp.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])), jnp.array([0.5, 0.0, 0.0])))
    [1.5 2.  3. ]
    """
    _require(T_a_b=(T_a_b, 4, 4), point_b=(point_b, 3))
    rotated = _rotate(T_a_b[..., :3, :3], point_b)
    return rotated + jnp.broadcast_to(T_a_b[..., :3, 3], rotated.shape)


def adjoint(T_a_b: Float[Array, "*n 4 4"]) -> Float[Array, "*n 6 6"]:
    """The matrix that moves a twist from frame b to a: `T exp(xi) T^-1 = exp(adjoint(T) xi)`.

    Args:
        T_a_b: transforms (..., 4, 4).

    Returns:
        Matrices (..., 6, 6) on twists [translation, rotation] (Sola et al. 2018, eq. 31).
    """
    _require(T_a_b=(T_a_b, 4, 4))
    R = T_a_b[..., :3, :3]
    upper = jnp.concatenate([R, _product(hat(T_a_b[..., :3, 3]), R)], axis=-1)
    lower = jnp.concatenate([jnp.zeros_like(R), R], axis=-1)
    return jnp.concatenate([upper, lower], axis=-2)


def interpolate(
    T_w_a: Float[Array, "*#n 4 4"], T_w_b: Float[Array, "*#n 4 4"], fraction: Float[Array, "*#n"]
) -> Float[Array, "*n 4 4"]:
    """The pose at a fraction of the way from a to b at constant twist.

    Args:
        T_w_a, T_w_b: poses (..., 4, 4).
        fraction: 0 (at a) to 1 (at b), one number or one for each pose; poses without leading axes take any.

    Returns:
        Poses (..., 4, 4).

    >>> T = exp(jnp.array([1.0, 0.0, 0.0, 0.0, 0.0, 2.0]))
    >>> print(log(interpolate(jnp.eye(4), T, jnp.array(0.25))).round(5) + 0.0)
    [0.25 0.   0.   0.   0.   0.5 ]
    """
    _require(T_w_a=(T_w_a, 4, 4), T_w_b=(T_w_b, 4, 4))
    batch = jnp.broadcast_shapes(T_w_a.shape[:-2], T_w_b.shape[:-2])
    if batch and fraction.shape and fraction.shape != batch:
        raise ValueError(f"fraction: expected shape {batch}, got {fraction.shape}")
    return compose(T_w_a, exp(fraction[..., None] * log(compose(inverse(T_w_a), T_w_b))))


def quaternion_multiply(a: Float[Array, "*#n 4"], b: Float[Array, "*#n 4"]) -> Float[Array, "*n 4"]:
    """The Hamilton product of two quaternions; as a rotation, b first and then a.

    Args:
        a, b: quaternions wxyz (..., 4), whose leading axes broadcast.

    Returns:
        Quaternions wxyz (..., 4).

    >>> i, j = jnp.array([0.0, 1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0, 0.0])
    >>> print(quaternion_multiply(i, j))
    [0. 0. 0. 1.]
    """
    _require(a=(a, 4), b=(b, 4))
    (aw, ax, ay, az), (bw, bx, by, bz) = ([q[..., i] for i in range(4)] for q in jnp.broadcast_arrays(a, b))
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """The inverse rotation of a unit quaternion.

    Args:
        q: quaternions wxyz (..., 4).

    Returns:
        Quaternions wxyz (..., 4).
    """
    _require(q=(q, 4))
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def quaternion_exp(phi: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """The unit quaternion of the rotation about `phi` by its length.

    Args:
        phi: rotation vectors (..., 3) [rad].

    Returns:
        Unit quaternions wxyz (..., 4).

    >>> print(quaternion_exp(jnp.array([0.0, 0.0, jnp.pi])).round(6) + 0.0)
    [0. 0. 0. 1.]
    """
    _require(phi=(phi, 3))
    square = 0.25 * _dot(phi, phi)
    a, b, _ = _exp_coefficients(square)
    return jnp.concatenate([1 - b * square, 0.5 * a * phi], axis=-1)


def quaternion_to_rotation(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """The rotation of a quaternion of any length but zero.

    Args:
        q: quaternions wxyz (..., 4).

    Returns:
        Rotation matrices (..., 3, 3).

    >>> print(quaternion_to_rotation(jnp.array([2.0, 0.0, 0.0, 0.0])))
    [[1. 0. 0.]
     [0. 1. 0.]
     [0. 0. 1.]]
    """
    _require(q=(q, 4))
    w, v = q[..., :1], q[..., 1:]
    return _rotation(v, 2 * w / _dot(q, q), 2 / _dot(q, q))


def rotation_to_quaternion(R: Float[Array, "*n 3 3"]) -> Float[Array, "*n 4"]:
    """The unit quaternion with w >= 0 of a rotation; its sign jumps only where the angle passes pi.

    Args:
        R: rotation matrices (..., 3, 3).

    Returns:
        Unit quaternions wxyz (..., 4).

    >>> print(rotation_to_quaternion(jnp.eye(3)))
    [1. 0. 0. 0.]
    """
    _require(R=(R, 3, 3))
    xx, yy, zz = (R[..., i, i] for i in range(3))
    xy, yz, zx = (R[..., i, j] + R[..., j, i] for i, j in ((0, 1), (1, 2), (2, 0)))
    wx, wy, wz = (R[..., j, i] - R[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1)))
    square = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    # Each row is 4 q_i q for one i; the row of the largest |q_i| has no small divisor and no cancellation.
    rows = jnp.stack(
        [
            *(square[0], wx, wy, wz),
            *(wx, square[1], xy, zx),
            *(wy, xy, square[2], yz),
            *(wz, zx, yz, square[3]),
        ],
        axis=-1,
    ).reshape(*R.shape[:-2], 4, 4)
    largest = jax.nn.one_hot(jnp.argmax(jnp.stack(square, axis=-1), axis=-1), 4, dtype=R.dtype)
    q = _rotate(rows, largest)  # the rows are those of a symmetric matrix: its product with a unit vector
    return q * (jnp.where(q[..., :1] < 0, -1, 1) / jnp.sqrt(_dot(q, q)))


def _require(**arguments: tuple) -> None:
    """Raise ValueError unless each argument has its last axes and the leading ones of all broadcast."""
    check_shapes(**{name: (x, f"*n {' '.join(map(str, last))}") for name, (x, *last) in arguments.items()})
    leading = [np.shape(x)[: -len(last)] for x, *last in arguments.values()]
    try:
        np.broadcast_shapes(*leading)
    except ValueError:
        names, found = ", ".join(arguments), " and ".join(map(str, leading))
        raise ValueError(f"{names}: expected leading axes that broadcast, got {found}") from None


def _quaternion_log(q: Float[Array, "*n 4"]) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 1"]]:
    """The rotation vector of a unit quaternion with w >= 0, and theta/2 cot(theta/2)."""
    w, v = q[..., :1], q[..., 1:]
    square = _dot(v, v)
    near = square < 0.04
    sine = jnp.sqrt(jnp.where(near, 1, square))  # of half the angle
    ratio = jnp.where(near, _polynomial(_ARCSINE, jnp.where(near, square, 0)), jnp.arctan2(sine, w) / sine)
    return 2 * ratio * v, ratio * w


def _exp_coefficients(
    square: Float[Array, "*n 1"],
) -> tuple[Float[Array, "*n 1"], Float[Array, "*n 1"], Float[Array, "*n 1"]]:
    """sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 from x^2, smooth at 0."""
    near = square < 1
    x = jnp.where(near, square, 0)
    far = jnp.where(near, 1, square)
    angle = jnp.sqrt(far)
    b = jnp.where(near, _polynomial(_COSINE, x), (1 - jnp.cos(angle)) / far)
    c = jnp.where(near, _polynomial(_SINE, x), (1 - jnp.sin(angle) / angle) / far)
    return 1 - c * square, b, c


def _polynomial(coefficients: list[float], x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    value = jnp.zeros_like(x)
    for c in reversed(coefficients):
        value = value * x + c
    return value


def _rotation(
    v: Float[Array, "*n 3"], a: Float[Array, "*n 1"], b: Float[Array, "*n 1"]
) -> Float[Array, "*n 3 3"]:
    """I + a hat(v) + b hat(v)^2."""
    diagonal = (1 - b * _dot(v, v))[..., None] * jnp.broadcast_to(jnp.eye(3, dtype=v.dtype), (*v.shape, 3))
    return diagonal + hat(a * v) + (b * v)[..., :, None] * v[..., None, :]


def _dot(a: Float[Array, "*n k"], b: Float[Array, "*n k"]) -> Float[Array, "*n 1"]:
    return jnp.sum(a * b, axis=-1, keepdims=True)


def _cross(a: Float[Array, "*n 3"], b: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    (ax, ay, az), (bx, by, bz) = ([v[..., i] for i in range(3)] for v in (a, b))
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _rotate(R: Float[Array, "*#n k k"], p: Float[Array, "*#n k"]) -> Float[Array, "*n k"]:
    """The matrix times a vector, term by term, so that XLA fuses it with what is done to very many points."""
    batch = jnp.broadcast_shapes(R.shape[:-2], p.shape[:-1])
    R, p = jnp.broadcast_to(R, (*batch, *R.shape[-2:])), jnp.broadcast_to(p, (*batch, p.shape[-1]))
    terms = [R[..., :, k] * p[..., k, None] for k in range(p.shape[-1])]
    return sum(terms[1:], terms[0])


def _product(a: Float[Array, "*#n i k"], b: Float[Array, "*#n k j"]) -> Float[Array, "*n i j"]:
    """The matrix product as one sum: never in TF32 (and small batched dots are slow), and soon compiled."""
    batch = jnp.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    a, b = jnp.broadcast_to(a, (*batch, *a.shape[-2:])), jnp.broadcast_to(b, (*batch, *b.shape[-2:]))
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)
