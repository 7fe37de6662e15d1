"""Levenberg-Marquardt on a spline's problem, and how large each group's noise turns out to be."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.errors import DataError
from jaxpose.estimate.blocks import Blocks, Covariance, Factorisation, covariance, factorise, solve
from jaxpose.estimate.system import Noise, Problem, Residuals, State, normal_equations, residuals, retract

_STEPS = 50  # at most
_SETTLED = 1e-6  # share of the cost that a step takes off, at which it is done
_DAMPING, _LEAST, _MOST = 1e-6, 1e-12, 1e6  # of the diagonal: at first, and its bounds


class Linearisation(NamedTuple):
    """A problem at a state."""

    state: State
    found: Residuals
    blocks: Blocks
    cost: Float[Array, ""]  # half the sum of squares


class GroupFit(NamedTuple):
    """How well each group of residuals is explained at the level of noise that was assumed."""

    squares: Noise  # sum of squares of the whitened residuals
    degrees: Noise  # what is expected of it: their number less what the unknowns explain


@jax.jit
def linearise(problem: Problem, state: State, noise: Noise) -> Linearisation:
    """Residuals, their derivatives and the normal equations at a state."""
    found = residuals(problem, state, noise)
    return Linearisation(state, found, *normal_equations(problem, state, found))


def optimise(problem: Problem, state: State, noise: Noise, steps: int = _STEPS) -> Linearisation:
    """The state of least cost near the given one, linearised there; float64 throughout.

    Raises:
        DataError: the problem has no finite cost at the given state.
    """
    at = linearise(problem, state, noise)
    if not np.isfinite(at.cost):
        raise DataError(f"estimate: expected a finite cost to begin with, got {float(at.cost)}")
    damping = _DAMPING
    for _ in range(steps):
        moved = linearise(problem, _moved(at, damping), noise)
        gain = float(at.cost - moved.cost)
        if gain >= 0:  # False for NaN
            settled, at = gain <= _SETTLED * float(at.cost), moved
            damping = max(damping / 10, _LEAST)
            if settled:
                break
        elif damping > _MOST or -gain <= 1e-12 * float(at.cost):
            break
        else:
            damping *= 10
    return at


@jax.jit
def _moved(at: Linearisation, damping: Float[Array, ""]) -> State:
    """The state after one step, with every diagonal entry so much larger."""
    more = lambda x: x + damping * x * jnp.broadcast_to(jnp.eye(x.shape[-1], dtype=x.dtype), x.shape)
    damped = at.blocks._replace(diagonal=more(at.blocks.diagonal), corner=more(at.blocks.corner))
    return retract(at.state, *solve(damped, factorise(damped)))


@jax.jit
def spread(at: Linearisation) -> tuple[Factorisation, Covariance, GroupFit]:
    """What the unknowns' covariance follows from, parts of it, and how well each group is explained."""
    factor = factorise(at.blocks)
    known = covariance(factor)
    P = pair_covariance(known)
    explained = lambda J, P: jnp.einsum("...ij,...jk,...ik->...i", J, P, J)
    inertial, poses, drift, motion = at.found.inertial, at.found.poses, at.found.drift, at.found.motion
    sums = []
    for rows, P_rows in ((inertial, P), (motion, P), (poses, P[at.found.pair]), (drift, P)):
        per_pair = rows.jacobian.reshape(len(P_rows), -1, P.shape[-1])
        used = explained(per_pair, P_rows).reshape(rows.residual.shape)
        counted = jnp.any(rows.jacobian != 0, axis=-1)
        both = jnp.stack([rows.residual**2, jnp.where(counted, 1 - used, 0)])
        sums.append(both.reshape(2, -1, *both.shape[-2:-1], 2, 3).sum((1, -1)))
    bands, moved, posed = sums[0], sums[1].sum(1), sums[2].sum(1) + sums[3].sum(1)
    of = lambda k: Noise(bands[k, :, 0], bands[k, :, 1], *posed[k], *moved[k])
    return factor, known, GroupFit(of(0), of(1))


def compiled_calls(problem: Problem, noise: Noise) -> list[tuple[Any, ...]]:
    """The compiled functions that solve a problem of these shapes, each with arguments of such shapes."""
    at = jax.eval_shape(linearise, problem, problem.start, noise)
    return [(linearise, problem, problem.start, noise), (_moved, at, _DAMPING), (spread, at)]


@jax.jit
def pair_covariance(known: Covariance) -> Float[Array, "n 70 70"]:
    """The covariance of each pair of neighbouring blocks with the border."""
    early, late, beside = known.diagonal[:-1], known.diagonal[1:], known.lower
    border = jnp.concatenate([known.border[:-1], known.border[1:]], axis=1)
    corner = jnp.broadcast_to(known.corner, (len(early), *known.corner.shape))
    upper = jnp.concatenate([early, jnp.swapaxes(beside, 1, 2)], axis=2)
    lower = jnp.concatenate([beside, late], axis=2)
    row = jnp.concatenate([jnp.concatenate([upper, lower], axis=1), border], axis=2)
    return jnp.concatenate([row, jnp.concatenate([jnp.swapaxes(border, 1, 2), corner], axis=2)], axis=1)
