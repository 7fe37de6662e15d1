"""A wide search for a camera's pose: many candidates, each judged by where a few points fall in the map.

For what second-order steps cannot reach: long intervals without an IMU, and frames after a loss.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose.geometry import se3
from jaxpose.slam.map.integrate import MapSampler
from jaxpose.slam.observation import Pixels, back_project

FOUND_SIGMA = (0.04, 0.03)  # [m, rad] how far off the pose that a search finds may be

_CANDIDATES = 512
CENTRES = 32  # kept from round to round
_ROUNDS = 5
_NARROWER = 0.5  # the spread of a round's candidates against that of the one before
_FAR = 0.2  # [m] from a surface: no point is worse
_COLOUR = 0.5  # what a wrong colour costs, against a point that is nowhere near a surface
_COLOUR_SCALE = 0.3
_PRIOR = 0.02  # what a sigma along one axis costs


def relocalise(
    sample_map: MapSampler,
    T_world_cam: Float[Array, "k 4 4"],
    sigma: Float[Array, "2"],
    pixels: Pixels,
    key: PRNGKeyArray,
) -> Float[Array, "4 4"]:
    """The pose among those within a few `sigma` [m, rad] of any of `T_world_cam`.

    Rounds of random candidates around the best of the round before, each closer than the last. Measured
    points are to lie on the map's zero, and the pose near the closest of `T_world_cam`.
    """
    axes = jnp.repeat(sigma, 3)

    def score(T):
        away = se3.log(se3.compose(se3.inverse(T_world_cam), T[None])) / axes[None]
        return mismatch(sample_map, T, pixels) + _PRIOR * jnp.min(jnp.sum(away**2, axis=-1))

    def improve(best, at):
        spread, key = at
        centres = jnp.concatenate([best] * (_CANDIDATES // CENTRES))
        xi = jax.random.normal(key, (centres.shape[0], 6)) * spread * axes[None]
        tries = se3.compose(centres, se3.exp(xi.at[:CENTRES].set(0)))  # the best themselves, and around them
        _, lowest = jax.lax.top_k(-jax.lax.map(score, tries, batch_size=64), CENTRES)
        return tries[lowest], None

    keys = jax.random.split(key, _ROUNDS)
    spreads = jnp.asarray([_NARROWER**k for k in range(_ROUNDS)], axes.dtype)
    best, _ = jax.lax.scan(improve, T_world_cam, (spreads, keys))
    return best[0]


def mismatch(sample_map: MapSampler, T_world_cam: Float[Array, "4 4"], pixels: Pixels) -> Float[Array, ""]:
    """How badly measured points fit the map: distance and colour, 0 to 1.5, a mean over pixels with depth."""
    near = jax.vmap(sample_map)(back_project(pixels, T_world_cam))
    off = jnp.minimum(jnp.abs(near.distance) / _FAR, 1)
    colour = jnp.mean(jnp.abs(near.rgb - pixels.rgb), axis=-1) / _COLOUR_SCALE
    cost = jnp.where(near.valid > 0, off + _COLOUR * jnp.minimum(colour, 1), 1 + _COLOUR)
    seen = (pixels.depth > 0).astype(cost.dtype)
    return jnp.sum(cost * seen) / jnp.maximum(jnp.sum(seen), 1)
