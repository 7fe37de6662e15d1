"""Registration of one frame to the map: measured points are moved onto its surfaces by Gauss-Newton steps.

A point is where a pixel's ray ends at the measured depth; its residual is the signed distance that the map
has there (Bylow et al. 2013), along the surface's normal, in sigmas. One look-up a pixel takes the place of
the samples of a rendered ray, and the distance pulls from as far off as the map knows it.
"""

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxpose.fields import Params
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, project
from jaxpose.losses import weighted_mean
from jaxpose.slam.config import TrackConfig
from jaxpose.slam.map.integrate import MapQuery, MapSampler
from jaxpose.slam.observation import Image, Pixels, back_project, depth_sigma, sample_pixels
from jaxpose.slam.tracking.predict import AHEAD, TrackingProblem

_SETTLED = 2e-4  # [m, rad] a step this small ends the alignment
_INDEPENDENT = 100.0  # pixels
_PARTS = 4  # of an image along each side, in which errors go together
_LONGEST = 0.2  # [m, rad] no step is longer
_FLAT = 0.05  # a distance that changes less along a metre says nothing about the surface
_DAMPING = 1e-4
_LEAST_SPREAD = 0.01  # of colours in [0, 1]
_BRIGHTER = 4.0  # times, at most, that one image is exposed longer than another


class Tracked(NamedTuple):
    """A frame's motion since the last one, and how well it explains the image."""

    T_ref_body: Float[Array, "4 4"]
    params: Params | None  # of the field, where it was brought to the frame
    loss: Float[Array, ""]  # of the image, in sigmas
    depth_error: Float[Array, ""]  # [m] median over valid pixels
    colour_error: Float[Array, ""]  # median, of colours in [0, 1]
    exposure: Float[Array, "3"]  # what its colours are to be multiplied by, to be as bright as the map's
    valid: Float[Array, ""]  # share of pixels with depth that the map explains
    iterations: Int[Array, ""]
    sigma: Float[Array, "2"]  # [m, rad] of the pose, by what the image says of it; NaN: not known
    covariance: Float[Array, "6 6"]  # of the pose, over right increments of the camera; NaN: not known
    information: Float[Array, "6 6"]  # of the image alone, over right increments of the camera; 0: not known
    line_delay: Float[Array, "2"]  # correction [s] by the image, its information; NaN: not asked for


@runtime_checkable
class TrackStep(Protocol):
    """A compiled step from what is expected of a frame, and its image, to its pose."""

    def __call__(
        self,
        scene_params: Params,
        fusion_state: Any,
        params: Params | None,
        problem: TrackingProblem,
        image: Image,
        max_depth: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> Tracked: ...


class Residuals(NamedTuple):
    """Rendered minus measured at pixels, each in its sigmas, and which pixels count."""

    depth: Float[Array, " n"]
    colour: Float[Array, "n 3"]
    inlier: Float[Array, " n"]  # 1 or 0, without gradient
    depth_error: Float[Array, ""]  # [m] median over explained pixels
    colour_error: Float[Array, ""]  # median over pixels that count, of colours in [0, 1]
    exposure: Float[Array, "3"]  # what the colours were multiplied by to be as bright as the map's
    valid: Float[Array, ""]  # share of the pixels with depth that the map explains


class Registration(NamedTuple):
    """A pose, how well it explains the image, and the information the image holds about it."""

    T_world_cam: Float[Array, "4 4"]
    information: Float[Array, "6 6"]  # Gauss-Newton's matrix over right increments
    by_parts: Float[Array, "6 6"]  # covariance that the image's errors make, by how its parts disagree
    share: Float[Array, "6 6"]  # of the prediction's error in the pose
    loss: Float[Array, ""]
    residuals: Residuals
    iterations: Int[Array, ""]


class Slopes(NamedTuple):
    """Derivatives of residuals by right increments of the camera's pose."""

    depth: Float[Array, "n 6"]
    colour: Float[Array, "n 3 6"]


def starts(T_world_cam: Float[Array, "4 4"], covariance: Float[Array, "6 6"]) -> Float[Array, "k 4 4"]:
    """Poses to try first: the predicted one, and those a sigma away along each axis of its covariance."""
    variance, axes = jnp.linalg.eigh(covariance)
    axes = (axes * jnp.sqrt(jnp.maximum(variance, 0))[None]).T
    away = se3.exp(jnp.concatenate([axes, -axes]))
    return jnp.concatenate([T_world_cam[None], se3.compose(T_world_cam, away)])


def best_start(
    sample_map: MapSampler, T_world_cam: Float[Array, "k 4 4"], pixels: Pixels, *, count: int = 150
) -> Float[Array, "4 4"]:
    """The candidate pose that explains the first `count` pixels best; unexplained ones count as bad."""
    few = jax.tree.map(lambda x: x[:count], pixels)

    def score(T):
        near = jax.vmap(sample_map)(back_project(few, T))
        worst = 20.0
        off = jnp.minimum(jnp.abs(near.distance) / depth_sigma(few.depth), worst)
        return jnp.mean(jnp.where((near.valid > 0) & (few.depth > 0), off, worst))

    return T_world_cam[jnp.argmin(jax.lax.map(score, T_world_cam))]


def surface_residuals(
    sample_map: MapSampler, T_world_cam: Float[Array, "4 4"], pixels: Pixels, config: TrackConfig
) -> tuple[Residuals, Slopes]:
    """Residuals of measured points against the map's surface and its colour there, and their derivatives.

    Outliers are points farther from it than its band and than three times the median: while the pose is far
    off all points pull, in the end those near a surface.
    """
    points = back_project(pixels, T_world_cam)

    def at(point):
        near, change = jax.linearize(sample_map, point)
        return near, jax.vmap(change)(jnp.eye(3, dtype=point.dtype))

    near, along = jax.vmap(at)(points)
    steep = jnp.linalg.norm(along.distance, axis=-1)
    valid = (pixels.depth > 0) & (near.valid > 0) & (steep > _FLAT)
    steep = jnp.maximum(steep, _FLAT)
    distance = near.distance / steep
    away = jnp.abs(distance)
    inlier = valid & (away < jnp.maximum(config.sample.band, 3 * median(away, valid)))
    sigma = depth_sigma(pixels.depth)
    coloured = inlier & (away < config.sample.band)
    gain = exposure(near.rgb, pixels.rgb, coloured)
    colour = near.rgb - gain[None] * pixels.rgb
    colour_error, spread = colour_spread(colour, coloured)
    colour = jnp.where(coloured[:, None], colour / spread, 0)
    share = jnp.sum(inlier) / jnp.maximum(jnp.sum(pixels.depth > 0), 1)
    weight, depth_error = inlier.astype(distance.dtype), median(away, inlier)
    found = Residuals(distance / sigma, colour, weight, depth_error, colour_error, gain, share)

    def by_pose(change):
        """From derivatives (n, 3) by the point in the world."""
        change_cam = jnp.matmul(change, T_world_cam[:3, :3], precision="highest")
        point_cam = pixels.direction_cam * pixels.depth[:, None]
        return jnp.concatenate([change_cam, jnp.cross(point_cam, change_cam)], axis=-1)

    by_colour = jnp.where(coloured[:, None, None], along.rgb / spread, 0)
    d_colour = jnp.stack([by_pose(by_colour[:, :, k]) for k in range(3)], axis=1)
    return found, Slopes(by_pose(along.distance / (steep * sigma)[:, None]), d_colour)


def exposure(
    map_rgb: Float[Array, "n 3"], rgb: Float[Array, "n 3"], counts: Bool[Array, " n"]
) -> Float[Array, "3"]:
    """What an image's colours are to be multiplied by to be as bright as the map's, without gradient.

    The ratio of their sums: of a product's least squares, noise and a wrong pose would make less.
    """
    total = lambda colour: jnp.sum(jnp.where(counts[:, None], jax.lax.stop_gradient(colour), 0), axis=0)
    ratio = total(map_rgb) / jnp.maximum(total(rgb), 1e-6)
    return jnp.clip(ratio, 1 / _BRIGHTER, _BRIGHTER)


def register(
    sample_map: MapSampler,
    T_world_cam: Float[Array, "4 4"],
    T_world_predicted: Float[Array, "4 4"],
    covariance: Float[Array, "6 6"],
    pixels: Pixels,
    config: TrackConfig,
) -> Registration:
    """The pose near a start that brings measured points onto the map's surface, by Gauss-Newton steps.

    Residuals count by their size, within one sigma by their square: by squares throughout, a camera between
    furniture was lost. The predicted pose is a measurement too, with its covariance [m, rad]; against it the
    image counts as `_INDEPENDENT` pixels, since errors of a map go together.
    """
    prior = jnp.linalg.inv(covariance)
    part = _parts(pixels)

    def equations(T):
        found, by = surface_residuals(sample_map, T, pixels, config)
        residual, slope, weight = _stacked(found, by, config)
        weighted = weight[:, None] * slope
        away = se3.log(se3.compose(se3.inverse(T_world_predicted), T))
        expected = _weight(found) * prior
        information = jnp.matmul(weighted.T, slope, precision="highest")
        pull = jnp.matmul(expected, away, precision="highest")
        descent = jnp.matmul(residual, weighted, precision="highest") + pull
        return information, expected, descent, _errors(residual, slope, weight, part, expected), found

    def improve(carry):
        at, _ = carry
        information, expected, descent, errors, found = equations(at.T_world_cam)
        total = information + expected
        damped = total + _DAMPING * jnp.diag(jnp.diag(total)) + 1e-6 * jnp.eye(6)
        step = -jnp.linalg.solve(damped, descent)
        length = jnp.linalg.norm(step)
        step = step * jnp.minimum(1, _LONGEST / jnp.maximum(length, 1e-12))
        T = se3.compose(at.T_world_cam, se3.exp(step))
        loss = image_loss(found, config)
        return Registration(T, information, *errors, loss, found, at.iterations + 1), length

    def unsettled(carry):
        at, length = carry
        return (at.iterations < config.iterations) & (length > _SETTLED)

    count = pixels.depth.shape[0]
    zero = jnp.zeros(())
    nothing = Residuals(
        jnp.zeros(count), jnp.zeros((count, 3)), jnp.zeros(count), zero, zero, jnp.ones(3), zero
    )
    unknown = jnp.zeros((6, 6))
    start = Registration(T_world_cam, unknown, unknown, unknown, jnp.zeros(()), nothing, jnp.int32(0))
    return jax.lax.while_loop(unsettled, improve, (start, jnp.inf))[0]


def _errors(
    residual: Float[Array, " m"],
    slope: Float[Array, "m 6"],
    weight: Float[Array, " m"],
    part: Int[Array, " n"],
    expected: Float[Array, "6 6"],
) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """The covariance that the image's errors make, and the share of the prediction's error in the pose.

    Of estimating equations whose errors go together in unknown ways within parts of the image, and not beyond
    (Liang and Zeger 1986): what each part's residuals pull by is squared.
    """
    count = part.shape[0]
    rows = (weight * residual)[:, None] * slope
    of_pixels = rows[:count] + rows[count:].reshape(count, 3, 6).sum(axis=1)
    in_part = jax.nn.one_hot(part, _PARTS**2, axis=0)
    pulls = jnp.matmul(in_part, of_pixels, precision="highest")
    seen = jnp.sum(jnp.any(pulls != 0, axis=1))
    free = seen / jnp.maximum(seen - 6, 1)  # six of the parts' sums are made nothing by the pose
    # Beyond one sigma a residual pulls by its sign alone: it does not hold the pose.
    holds = jnp.where(jnp.abs(residual) <= 1, weight, 0)[:, None] * slope
    stiffness = jnp.matmul(holds.T, slope, precision="highest") + expected
    inverse = jnp.linalg.inv(stiffness + 1e-6 * jnp.eye(6))
    moves = jnp.matmul(pulls, inverse, precision="highest")
    share = jnp.matmul(inverse, expected, precision="highest")
    return free * jnp.matmul(moves.T, moves, precision="highest"), share


def _parts(pixels: Pixels) -> Int[Array, " n"]:
    """Which part of the image each pixel is in."""
    place = pixels.direction_cam[:, :2]
    first, last = jnp.min(place, axis=0), jnp.max(place, axis=0)
    share = (place - first[None]) / jnp.maximum(last - first, 1e-6)[None]
    cell = jnp.clip((_PARTS * share).astype(jnp.int32), 0, _PARTS - 1)
    return cell[:, 1] * _PARTS + cell[:, 0]


def _stacked(
    found: Residuals, by: Slopes, config: TrackConfig
) -> tuple[Float[Array, " m"], Float[Array, "m 6"], Float[Array, " m"]]:
    """Residuals of depth, then of colour, their derivatives by the pose, and their weights."""
    residual = jnp.concatenate([found.depth, found.colour.reshape(-1)])
    slope = jnp.concatenate([by.depth, by.colour.reshape(-1, 6)])
    w_depth = found.inlier / jnp.maximum(jnp.abs(found.depth), 1)
    w_colour = config.colour_weight / 3 * found.inlier[:, None] / jnp.maximum(jnp.abs(found.colour), 1)
    return residual, slope, jnp.concatenate([w_depth, w_colour.reshape(-1)])


def line_delay_correction(
    sample_map: MapSampler,
    found: Registration,
    prior: Float[Array, "6 6"],
    pixels: Pixels,
    row: Float[Array, " n"],
    twist_cam: Float[Array, "6"],
    config: TrackConfig,
) -> Float[Array, "2"]:
    """A step of Gauss-Newton on the time from row to row, at a registered pose, whatever that pose may be.

    A row that was read later than thought is moved by the camera's twist for that time.

    Returns:
        Correction [s] and its information [1/s^2], counted as `_INDEPENDENT` pixels.
    """
    at, by = surface_residuals(sample_map, found.T_world_cam, pixels, config)
    residual, slope, weight = _stacked(at, by, config)
    rows = jnp.concatenate([row, jnp.repeat(row, 3)])
    by_delay = jnp.matmul(slope, twist_cam, precision="highest") * rows
    weighted = weight[:, None] * slope
    own = jnp.matmul(weighted.T, slope, precision="highest") + _weight(at) * prior
    shared = jnp.matmul(by_delay, weighted, precision="highest")
    information = jnp.sum(weight * by_delay**2) - shared @ jnp.linalg.solve(own, shared)
    correction = -jnp.sum(weight * by_delay * residual) / jnp.maximum(information, 1e-12)
    return jnp.stack([correction, information / _weight(at)])


def pose_sigma(found: Registration, support: Float[Array, "6 6"]) -> Float[Array, "2"]:
    """Standard deviation [m, rad] of an aligned pose along its worst axis, by the image and its features."""
    covariance = jnp.linalg.inv(image_information(found) + support + 1e-6 * jnp.eye(6))
    worst = lambda block: jnp.sqrt(jnp.linalg.eigvalsh(block)[-1])
    return jnp.stack([worst(covariance[:3, :3]), worst(covariance[3:, 3:])])


def pose_covariance(found: Registration, problem: TrackingProblem) -> Float[Array, "6 6"]:
    """Covariance of a registered pose beside the map, over right increments of the camera."""
    share = found.share
    return found.by_parts + jnp.einsum("ij,jk,lk->il", share, problem.covariance, share, precision="highest")


def image_information(found: Registration) -> Float[Array, "6 6"]:
    """What an image says of its pose, counted as `_INDEPENDENT` pixels."""
    return found.information / _weight(found.residuals)


def _weight(found: Residuals) -> Float[Array, ""]:
    """How many times its own worth a pixel would count if none went together with another."""
    return jnp.maximum(jnp.sum(found.inlier), 1) / _INDEPENDENT


def make_register(
    sample_map: MapQuery, camera: Camera, config: TrackConfig, *, line_delay: bool = False
) -> TrackStep:
    """The compiled `TrackStep` of the method `gauss_newton`, which also asks images for the line delay."""

    @jax.jit
    def step(scene_params, fusion_state, params, problem, image, max_depth, key):
        del max_depth  # nothing is rendered
        sample = partial(sample_map, scene_params, fusion_state)
        pixels = sample_pixels(key, image, camera, config.pixels, edge=config.edge)
        T_ref_cam = se3.compose(problem.T_ref_body[AHEAD - 1], problem.T_body_cam)
        predicted = se3.compose(problem.T_world_ref, T_ref_cam)
        start = best_start(sample, starts(predicted, problem.covariance), pixels)
        found = register(sample, start, predicted, problem.covariance, pixels, config)
        T_world_body = se3.compose(found.T_world_cam, se3.inverse(problem.T_body_cam))
        residuals = found.residuals
        correction = jnp.full(2, jnp.nan)
        if line_delay:
            row, prior = project(camera, pixels.direction_cam)[:, 1], jnp.linalg.inv(problem.covariance)
            correction = line_delay_correction(sample, found, prior, pixels, row, problem.twist_cam, config)
        return Tracked(
            se3.compose(se3.inverse(problem.T_world_ref), T_world_body),
            params,
            found.loss,
            residuals.depth_error,
            residuals.colour_error,
            image.exposure * residuals.exposure,
            residuals.valid,
            found.iterations,
            pose_sigma(found, problem.support),
            pose_covariance(found, problem),
            image_information(found),
            correction,
        )

    return step


def colour_spread(
    colour: Float[Array, "n 3"], counts: Bool[Array, " n"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The median size of residuals of colour over the pixels that count, and what they are divided by."""
    error = median(jnp.mean(jnp.abs(colour), axis=-1), counts)
    return error, jnp.maximum(error, _LEAST_SPREAD)


def image_loss(residuals: Residuals, config: TrackConfig) -> Float[Array, ""]:
    """The L1 loss of depth and colour, means over the pixels that count."""
    colour = jnp.mean(jnp.abs(residuals.colour), axis=-1)
    return weighted_mean(jnp.abs(residuals.depth), residuals.inlier) + config.colour_weight * weighted_mean(
        colour, residuals.inlier
    )


def median(x: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median over the masked entries, without gradient; 0 when there are none."""
    ordered = jnp.sort(jnp.where(mask, jax.lax.stop_gradient(x), jnp.inf))
    middle = ordered[jnp.maximum(jnp.sum(mask) - 1, 0) // 2]
    return jnp.where(jnp.any(mask), middle, 0.0)
