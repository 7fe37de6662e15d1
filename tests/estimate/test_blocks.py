"""Block tridiagonal normal equations with a border, against dense linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose.estimate.blocks import Blocks, covariance, factorise, solve


@pytest.fixture(scope="module")
def dense():
    """A matrix of six blocks of four and a border of three, as blocks, and as it is."""
    rng = np.random.default_rng(0)
    n, k, g = 6, 4, 3
    J = np.zeros(((n - 1) * 15, n * k + g))
    for i in range(n - 1):
        rows = slice(15 * i, 15 * (i + 1))
        J[rows, i * k : (i + 2) * k] = rng.normal(size=(15, 2 * k))
        J[rows, n * k :] = rng.normal(size=(15, g))
    H, b = J.T @ J, rng.normal(size=n * k + g)
    cut = lambda i, j: H[i * k : (i + 1) * k, j * k : (j + 1) * k]
    blocks = Blocks(
        np.stack([cut(i, i) for i in range(n)]),
        np.stack([cut(i + 1, i) for i in range(n - 1)]),
        H[: n * k, n * k :].reshape(n, k, g),
        H[n * k :, n * k :],
        b[: n * k].reshape(n, k),
        b[n * k :],
    )
    with jax.enable_x64(True):
        yield jax.tree.map(jnp.asarray, blocks), H, b


def test_the_solution_is_that_of_a_dense_solver(dense):
    blocks, H, b = dense
    row, corner = solve(blocks, factorise(blocks))
    np.testing.assert_allclose(np.concatenate([row.ravel(), corner]), np.linalg.solve(H, b), rtol=1e-9)


def test_covariances_are_those_of_the_inverse(dense):
    blocks, H, _ = dense
    known, P = covariance(factorise(blocks)), np.linalg.inv(H)
    for i in range(6):
        own = slice(4 * i, 4 * i + 4)
        np.testing.assert_allclose(known.diagonal[i], P[own, own], rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(known.border[i], P[own, 24:], rtol=1e-8, atol=1e-12)
        if i < 5:
            np.testing.assert_allclose(known.lower[i], P[4 * i + 4 : 4 * i + 8, own], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(known.corner, P[24:, 24:], rtol=1e-8)
