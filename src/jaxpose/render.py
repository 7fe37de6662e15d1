"""Volume rendering of one ray through any scene; the caller vmaps.

A scene enters as a callable `query(point, direction) -> (geometry, rgb)`. What geometry means is settled by
the weights given to `render_ray`: a density (NeRF), an occupancy (NICE-SLAM) or a signed distance.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

Query = Callable[[Float[Array, "3"], Float[Array, "3"]], tuple[Float[Array, ""], Float[Array, "3"]]]
Spacing = Literal["depth", "disparity"]
Weights = Callable[[Float[Array, " s"], Float[Array, " s"]], Float[Array, " s"]]


class Ray(NamedTuple):
    """A half line in the world; with a direction of length 1 along the camera's z axis, depth is z-depth."""

    origin: Float[Array, "*n 3"]
    direction: Float[Array, "*n 3"]


class Rendered(NamedTuple):
    """What a ray sees: expected colour and depth, the depth's variance, and how much of the ray has ended.

    Colour, depth and variance are those of the part that ended (divided by `opacity`).
    """

    rgb: Float[Array, "*n 3"]
    depth: Float[Array, "*n"]
    variance: Float[Array, "*n"]
    opacity: Float[Array, "*n"]


def sample_depths(
    key: PRNGKeyArray | None,
    near: float | Float[Array, ""],
    far: float | Float[Array, ""],
    samples: int,
    *,
    spacing: Spacing = "depth",
) -> Float[Array, " samples"]:
    """Increasing depths, one in each of `samples` equal parts: drawn, or the middle without a key.

    The parts are equal in depth or in disparity, 1 / depth; in disparity `far` may be infinite. With a key
    for every ray each has its own depths, with one for all they share them. As in BARF (PEERS B1).
    """
    within = jnp.full(samples, 0.5) if key is None else jax.random.uniform(key, (samples,))
    share = (jnp.arange(samples, dtype=within.dtype) + within) / samples
    if spacing == "depth":
        return near + (far - near) * share
    return 1 / jnp.maximum((1 - share) / near + share / far, 1e-8)


def density_weights(
    density: Float[Array, " s"], depth: Float[Array, " s"], *, length: float | Float[Array, ""] = 1.0
) -> Float[Array, " s"]:
    """Probability that the ray ends at each sample, from volume densities per unit of length (NeRF).

    `length` is that of one unit of depth along the ray: the norm of its direction, where depth is z-depth.
    The last interval has no end, as in NeRF: what stands at the last sample closes the ray.
    """
    tau = density * (jnp.append(jnp.diff(depth), jnp.asarray(1e10, depth.dtype)) * length)
    return -jnp.expm1(-tau) * jnp.exp(-_before(tau))


def occupancy_weights(occupancy: Float[Array, " s"], depth: Float[Array, " s"]) -> Float[Array, " s"]:
    """Probability that the ray ends at each sample, from occupancies in [0, 1] (NICE-SLAM, eq. 5)."""
    del depth
    return occupancy * _transmittance(occupancy)


def sdf_weights(
    distance: Float[Array, " s"], depth: Float[Array, " s"], *, width: float
) -> Float[Array, " s"]:
    """Probability that the ray ends at each sample, from signed distances [m] to surfaces `width` [m] thick.

    The ray is at a sample from half-way after its neighbour before to half-way to the next. It has stayed
    outside with probability sigmoid(distance / width), as in NeuS (Wang et al. 2021, eq. 13): without bias in
    depth where the distance is linear. Samples behind a surface, where the distance grows again, get nothing.
    """
    del depth
    edges = jnp.concatenate([distance[:1], (distance[1:] + distance[:-1]) / 2, distance[-1:]])
    outside = jax.nn.sigmoid(edges / width)
    # A start inside a surface (outside = 0) must not divide by zero.
    ends = jnp.clip((outside[:-1] - outside[1:]) / (outside[:-1] + 1e-4), 0, 1)
    return ends * _transmittance(ends)


def composite(weights: Float[Array, " s"], depth: Float[Array, " s"], rgb: Float[Array, "s 3"]) -> Rendered:
    """Expected colour, depth and variance of depth under the weights (NICE-SLAM, eqs. 6-7, normalised)."""
    opacity = jnp.sum(weights)
    share = weights / (opacity + 1e-6)
    mean = jnp.sum(share * depth)
    colour = jnp.sum(share[:, None] * rgb, axis=0)
    return Rendered(colour, mean, jnp.sum(share * (depth - mean) ** 2), opacity)


def render_ray(query: Query, ray: Ray, depth: Float[Array, " s"], *, weights: Weights) -> Rendered:
    """Render one ray at increasing sample depths; a pure function, differentiable in all its arrays."""
    points = ray.origin[None] + depth[:, None] * ray.direction[None]
    geometry, rgb = jax.vmap(query, in_axes=(0, None))(points, ray.direction)
    return composite(weights(geometry, depth), depth, rgb)


def surface_weights(width: float) -> Weights:
    """`sdf_weights` for a surface thickness, as `render_ray` takes them."""
    return partial(sdf_weights, width=width)


def _before(x: Float[Array, " s"]) -> Float[Array, " s"]:
    """Sum over the samples before each one; the last, which may be huge, is in none of them."""
    return jnp.concatenate([jnp.zeros_like(x[:1]), jnp.cumsum(x[:-1])])


def _transmittance(ends: Float[Array, " s"]) -> Float[Array, " s"]:
    """Probability of reaching each sample, given that of ending at each; 1e-10 as in NICE-SLAM."""
    passed = jnp.cumprod(1 - ends + 1e-10)
    return jnp.concatenate([jnp.ones_like(passed[:1]), passed[:-1]])
