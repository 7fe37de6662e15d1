"""Volume rendering of one ray through any scene; the caller vmaps.

A scene is a function `query(point, direction) -> (geometry, rgb)`. What geometry means is settled by the
weights given to `render_ray`: a density (NeRF, Mildenhall et al. 2020), an occupancy (NICE-SLAM, Zhu et al.
2022) or a signed distance (NeuS, Wang et al. 2021).
"""

from functools import partial
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxpose._checks import check_shapes
from jaxpose.geometry.camera import Camera, unproject

Spacing = Literal["depth", "disparity"]
ENDLESS = 1e10  # interval of the last sample, which closes the ray


@runtime_checkable
class Query(Protocol):
    """A scene: geometry and colour in [0, 1] at a point of the world, seen along a direction."""

    def __call__(
        self, point: Float[Array, "3"], direction: Float[Array, "3"], /
    ) -> tuple[Float[Array, ""], Float[Array, "3"]]: ...


@runtime_checkable
class Weights(Protocol):
    """Probability that a ray ends at each sample, given the scene's geometry there and the depths."""

    def __call__(self, geometry: Float[Array, " s"], depth: Float[Array, " s"], /) -> Float[Array, " s"]: ...


class Ray(NamedTuple):
    """A half line in the world; with a direction of length 1 along the camera's z axis, depth is z-depth."""

    origin: Float[Array, "*n 3"]
    direction: Float[Array, "*n 3"]


class Samples(NamedTuple):
    """Where a ray is looked at: depths, and the length of ray [units of depth] that each stands for."""

    depth: Float[Array, "*n s"]
    interval: Float[Array, "*n s"]


class Rendered(NamedTuple):
    """What a ray sees, of the part of it that ended (divided by `opacity`).

    Attributes:
        rgb: Expected colour.
        depth: Expected depth.
        variance: Variance of the depth.
        opacity: Probability that the ray has ended at all.
    """

    rgb: Float[Array, "*n 3"]
    depth: Float[Array, "*n"]
    variance: Float[Array, "*n"]
    opacity: Float[Array, "*n"]


def pixel_ray(camera: Camera, T_world_cam: Float[Array, "4 4"], pixel: Float[Array, "2"]) -> Ray:
    """The ray through a pixel, its direction of length 1 along the optical axis.

    Args:
        camera: Intrinsics and distortion.
        T_world_cam: The camera's pose, that of the pixel's own time where the shutter rolls.
        pixel: Column and row [px], fractions allowed; the centre of the first pixel is (0, 0).

    Returns:
        The ray in the world. Depth along it is z-depth.

    Raises:
        ValueError: For a pose that is not (4, 4), and for other than one pixel.

    >>> camera = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)
    >>> print(pixel_ray(camera, jnp.eye(4), jnp.array([820.0, 240.0])).direction)
    [1. 0. 1.]
    """
    check_shapes(T_world_cam=(T_world_cam, "4 4"), pixel=(pixel, "2"))
    direction = jnp.matmul(T_world_cam[:3, :3], unproject(camera, pixel), precision="highest")
    return Ray(T_world_cam[:3, 3], direction)


def sample_depths(
    key: PRNGKeyArray | None,
    near: float | Float[Array, ""],
    far: float | Float[Array, ""],
    samples: int,
    *,
    spacing: Spacing = "depth",
) -> Float[Array, " samples"]:
    """Increasing depths, one in each of `samples` equal parts: drawn, or the middle without a key.

    With a key for every ray each has its own depths, with one for all they share them. As in BARF (Lin et
    al. 2021).

    Args:
        key: A random key; None: the middle of each part.
        near: The first depth, above 0 in disparity.
        far: The last depth; in disparity it may be infinite.
        samples: How many depths.
        spacing: Whether the parts are equal in depth or in disparity, 1 / depth.

    Returns:
        Depths in the unit of `near` and `far`.

    Raises:
        ValueError: For `samples` below 1 and an unknown `spacing`.

    >>> sample_depths(None, 1.0, 3.0, 4).tolist()
    [1.25, 1.75, 2.25, 2.75]
    """
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples}")
    if spacing not in ("depth", "disparity"):
        raise ValueError(f"spacing: expected 'depth' or 'disparity', got {spacing!r}")
    within = jnp.full(samples, 0.5) if key is None else jax.random.uniform(key, (samples,))
    share = (jnp.arange(samples, dtype=within.dtype) + within) / samples
    return depth_at(share, near, far, spacing)


def depth_at(
    share: Float[Array, " s"], near: float | Float[Array, ""], far: float | Float[Array, ""], spacing: Spacing
) -> Float[Array, " s"]:
    """Depths at shares of the way from the first to the last, in depth or in disparity.

    Args:
        share: From 0 to 1.
        near: The first depth, above 0 in disparity.
        far: The last depth; in disparity it may be infinite.
        spacing: What shares are equal in.

    Returns:
        Depths in the unit of `near` and `far`.
    """
    if spacing == "depth":
        return near + (far - near) * share
    return 1 / jnp.maximum((1 - share) / near + share / far, 1e-8)


def to_next(depth: Float[Array, " s"]) -> Samples:
    """Samples that stand for the ray as far as the next one; the last, as in NeRF, for all that is behind.

    Args:
        depth: Increasing depths.

    Returns:
        The same depths with their intervals.
    """
    return Samples(depth, jnp.append(jnp.diff(depth), jnp.asarray(ENDLESS, depth.dtype)))


def density_weights(
    density: Float[Array, " s"],
    depth: Float[Array, " s"],
    *,
    length: float | Float[Array, ""] = 1.0,
    interval: Float[Array, " s"] | None = None,
) -> Float[Array, " s"]:
    """Probability that the ray ends at each sample, from volume densities (Mildenhall et al. 2020, eq. 3).

    Args:
        density: Volume densities >= 0 per unit of length.
        depth: Increasing depths of the samples.
        length: Length of one unit of depth along the ray: the norm of its direction, where depth is z-depth.
        interval: Length of ray [units of depth] that each sample stands for; None: as `to_next` has it.

    Returns:
        Weights that sum up to at most 1.

    Raises:
        ValueError: For arrays of different shapes.

    >>> density_weights(jnp.array([0.0, jnp.log(2.0), 0.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [0.0, 0.5, 0.0]
    """
    _check_samples(density=density, depth=depth)
    tau = density * ((to_next(depth).interval if interval is None else interval) * length)
    return -jnp.expm1(-tau) * jnp.exp(-_before(tau))


def occupancy_weights(occupancy: Float[Array, " s"], depth: Float[Array, " s"]) -> Float[Array, " s"]:
    """Probability that the ray ends at each sample, from occupancies (Zhu et al. 2022, eq. 5).

    Args:
        occupancy: In [0, 1]: the probability that a ray that has come so far ends here.
        depth: Increasing depths of the samples; the weights do not depend on them.

    Returns:
        Weights that sum up to at most 1.

    Raises:
        ValueError: For arrays of different shapes.

    >>> occupancy_weights(jnp.array([0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [0.5, 0.25, 0.25]
    """
    _check_samples(occupancy=occupancy, depth=depth)
    return occupancy * _transmittance(occupancy)


def sdf_weights(
    distance: Float[Array, " s"], depth: Float[Array, " s"], *, width: float
) -> Float[Array, " s"]:
    """Probability that the ray ends at each sample, from signed distances (NeuS, Wang et al. 2021, eq. 13).

    The ray is at a sample from half-way after its neighbour before to half-way to the next. It has stayed
    outside with probability sigmoid(distance / width): without bias in depth where the distance is linear.
    Samples behind a surface, where the distance grows again, get nothing.

    Args:
        distance: Signed distances [m], positive in front of surfaces.
        depth: Increasing depths of the samples; the weights do not depend on them.
        width: Thickness of a surface [m], above 0.

    Returns:
        Weights that sum up to at most 1.

    Raises:
        ValueError: For arrays of different shapes and a `width` that is not above 0.
    """
    _check_samples(distance=distance, depth=depth)
    if width <= 0:
        raise ValueError(f"width: expected more than 0 m, got {width}")
    edges = jnp.concatenate([distance[:1], (distance[1:] + distance[:-1]) / 2, distance[-1:]]) / width
    before, after = edges[:-1], edges[1:]
    # The share of `outside` that is lost, 1 - sigmoid(after) / sigmoid(before), as a product: a difference
    # would be rounding where both are near 1. Not `jnp.clip`, whose gradient compares for equality.
    closer = jnp.where(after > before, 0, after - before)
    # A start inside a surface (outside = 0) must not divide by zero.
    outside = jax.nn.sigmoid(before)
    ends = -jnp.expm1(closer) * jax.nn.sigmoid(-after) * outside / (outside + 1e-4)
    return ends * _transmittance(ends)


def composite(weights: Float[Array, " s"], depth: Float[Array, " s"], rgb: Float[Array, "s 3"]) -> Rendered:
    """Expected colour, depth and variance of depth (Zhu et al. 2022, eqs. 6 and 7, normalised).

    Args:
        weights: Probability that the ray ends at each sample.
        depth: Depths of the samples.
        rgb: Colours at the samples.

    Returns:
        Expectations over the part of the ray that ended, and how much of it that is.

    Raises:
        ValueError: For arrays whose samples differ in number.

    >>> seen = composite(jnp.array([0.5, 0.5]), jnp.array([1.0, 3.0]), jnp.eye(2, 3))
    >>> print(f"{seen.depth:.3f} {seen.variance:.3f} {seen.opacity:.1f}")
    2.000 1.000 1.0
    """
    _check_samples(weights=weights, depth=depth)
    if rgb.shape != (*depth.shape, 3):
        raise ValueError(f"rgb: expected shape {(*depth.shape, 3)}, got {rgb.shape}")
    opacity = jnp.sum(weights)
    share = weights / (opacity + 1e-6)
    mean = jnp.sum(share * depth)
    colour = jnp.sum(share[:, None] * rgb, axis=0)
    return Rendered(colour, mean, jnp.sum(share * (depth - mean) ** 2), opacity)


def render_ray(query: Query, ray: Ray, depth: Float[Array, " s"], *, weights: Weights) -> Rendered:
    """Render one ray through a scene; a pure function, differentiable in all its arrays.

    Args:
        query: `query(point, direction) -> (geometry, rgb)` of one point.
        ray: One ray.
        depth: Increasing depths of its samples, in units of the ray's direction.
        weights: What geometry means: `density_weights`, `occupancy_weights`, `surface_weights(width)`, or a
            function of your own.

    Returns:
        Expected colour and depth.

    Raises:
        ValueError: For a ray or depths of another shape than (3,), (3,) and (s,).

    >>> wall = lambda point, direction: (2.0 - point[2], jnp.array([1.0, 0.5, 0.0]))  # the plane z = 2
    >>> ray = Ray(jnp.zeros(3), jnp.array([0.1, 0.0, 1.0]))
    >>> seen = render_ray(wall, ray, jnp.linspace(1.0, 3.0, 101), weights=surface_weights(0.02))
    >>> print(f"{seen.depth:.3f}", seen.rgb.round(3))
    2.000 [1.  0.5 0. ]
    """
    if ray.origin.shape != (3,) or ray.direction.shape != (3,):
        raise ValueError(
            f"ray: expected one, of shapes (3,) and (3,), got {ray.origin.shape} and {ray.direction.shape};"
            " vmap for more"
        )
    if depth.ndim != 1:
        raise ValueError(f"depth: expected shape (samples,), got {depth.shape}; vmap for more rays")
    points = ray.origin[None] + depth[:, None] * ray.direction[None]
    # On a CPU the compiler of JAX 0.12 computes points twice, rounded differently, for a scene's `jnp.min`
    # and for its gradient, which then finds no entry equal to the least and divides by their count, zero.
    points = jax.lax.optimization_barrier(points)
    geometry, rgb = jax.vmap(query, in_axes=(0, None))(points, ray.direction)
    return composite(weights(geometry, depth), depth, rgb)


def surface_weights(width: float) -> Weights:
    """`sdf_weights` for a thickness of surfaces, as `render_ray` takes them.

    Args:
        width: Thickness of a surface [m], above 0.

    Returns:
        A function of signed distances [m] and depths.

    Raises:
        ValueError: For a `width` that is not above 0.
    """
    if width <= 0:
        raise ValueError(f"width: expected more than 0 m, got {width}")
    return partial(sdf_weights, width=width)


def _before(x: Float[Array, " s"]) -> Float[Array, " s"]:
    """Sum over the samples before each one; the last, which may be huge, is in none of them."""
    return jnp.concatenate([jnp.zeros_like(x[:1]), jnp.cumsum(x[:-1])])


def _transmittance(ends: Float[Array, " s"]) -> Float[Array, " s"]:
    """Probability of reaching each sample, given that of ending at each."""
    passed = jnp.cumprod(1 - ends)
    return jnp.concatenate([jnp.ones_like(passed[:1]), passed[:-1]])


def _check_samples(**arrays: Float[Array, "..."]) -> None:
    """Samples of one ray, as many in each array; nothing broadcasts."""
    (first, one), (second, other) = arrays.items()
    if one.ndim != 1 or one.shape != other.shape:
        raise ValueError(
            f"{first}, {second}: expected one shape (samples,), got {one.shape} and {other.shape};"
            " vmap for more rays"
        )
