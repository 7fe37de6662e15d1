"""Normal equations that are block tridiagonal but for a border: solved and inverted block by block.

The unknowns are a row of blocks of one size, each coupled to its neighbours only, and a few unknowns that all
blocks may be coupled to. Cost grows with the number of blocks, not with its cube.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular
from jaxtyping import Array, Float


class Blocks(NamedTuple):
    """A symmetric matrix [[A, B], [B^T, C]] and a right side; A is block tridiagonal."""

    diagonal: Float[Array, "n k k"]
    lower: Float[Array, "n-1 k k"]  # block (i + 1, i)
    border: Float[Array, "n k g"]  # B
    corner: Float[Array, "g g"]  # C
    side: Float[Array, "n k"]
    corner_side: Float[Array, " g"]


class Factorisation(NamedTuple):
    """The Cholesky factor of A, what A does to B, and the Schur complement of A."""

    root: Float[Array, "n k k"]
    lower: Float[Array, "n-1 k k"]
    swept: Float[Array, "n k g"]  # A^-1 B
    schur: Float[Array, "g g"]  # C - B^T A^-1 B


class Covariance(NamedTuple):
    """The parts of the inverse that neighbouring blocks and the border need."""

    diagonal: Float[Array, "n k k"]
    lower: Float[Array, "n-1 k k"]  # of blocks (i + 1, i)
    border: Float[Array, "n k g"]
    corner: Float[Array, "g g"]


def factorise(blocks: Blocks) -> Factorisation:
    """The factor of a positive definite matrix; of another one it holds NaN."""
    k = blocks.diagonal.shape[-1]

    def step(carried, block):
        diagonal, lower = block  # `lower` couples this block to the one before
        solved = solve_triangular(carried, lower.T, lower=True).T
        root = jnp.linalg.cholesky(diagonal - solved @ solved.T)
        return root, (root, solved)

    first = jnp.zeros((1, k, k), blocks.lower.dtype)
    start = jnp.eye(k, dtype=blocks.diagonal.dtype)
    _, (root, lower) = jax.lax.scan(step, start, (blocks.diagonal, jnp.concatenate([first, blocks.lower])))
    swept = solve_rows(root, lower[1:], blocks.border)
    schur = blocks.corner - jnp.einsum("nkg,nkh->gh", blocks.border, swept)
    return Factorisation(root, lower[1:], swept, schur)


def solve(blocks: Blocks, factor: Factorisation) -> tuple[Float[Array, "n k"], Float[Array, " g"]]:
    """The solution for the blocks' right side, of the row and of the border."""
    alone = solve_rows(factor.root, factor.lower, blocks.side[..., None])[..., 0]
    rest = blocks.corner_side - jnp.einsum("nkg,nk->g", blocks.border, alone)
    corner = cho_solve(cho_factor(factor.schur), rest)
    return alone - jnp.einsum("nkg,g->nk", factor.swept, corner), corner


def covariance(factor: Factorisation) -> Covariance:
    """The inverse where the matrix itself is not zero (Takahashi's recursion, block by block)."""
    k = factor.root.shape[-1]
    identity = jnp.eye(k, dtype=factor.root.dtype)
    inverse = jax.vmap(lambda root: solve_triangular(root, identity, lower=True))(factor.root)

    def step(later, block):
        inverse, lower = block  # `lower` couples the block after to this one
        gain = lower @ inverse
        beside = -later @ gain
        own = inverse.T @ inverse - gain.T @ beside
        return own, (own, beside)

    last = inverse[-1].T @ inverse[-1]
    _, (own, beside) = jax.lax.scan(step, last, (inverse[:-1], factor.lower), reverse=True)
    own = jnp.concatenate([own, last[None]])
    corner = jnp.linalg.inv(factor.schur)
    border = -factor.swept @ corner
    across = lambda a, b: jnp.einsum("nkg,nlg->nkl", a, b)
    own = own - across(border, factor.swept)
    return Covariance(own, beside - across(border[1:], factor.swept[:-1]), border, corner)


def solve_rows(root, lower, side: Float[Array, "n k m"]) -> Float[Array, "n k m"]:
    """A^-1 times columns, one for each m."""

    def forward(before, block):
        root, lower, side = block
        found = solve_triangular(root, side - lower @ before, lower=True)
        return found, found

    def backward(after, block):
        root, lower, side = block
        found = solve_triangular(root.T, side - lower.T @ after)
        return found, found

    none = jnp.zeros((1, *root.shape[1:]), root.dtype)
    start = jnp.zeros(side.shape[1:], side.dtype)
    _, half = jax.lax.scan(forward, start, (root, jnp.concatenate([none, lower]), side))
    later = jnp.concatenate([lower, none])
    return jax.lax.scan(backward, start, (root, later, half), reverse=True)[1]
