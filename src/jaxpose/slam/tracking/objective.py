"""What tracking minimises: the image's residuals against the map, and the inertial ones against the field."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxpose import imu as inertial
from jaxpose.fields import PoseFn
from jaxpose.imu import ResidualSigmas
from jaxpose.losses import weighted_mean
from jaxpose.render import Query
from jaxpose.slam.observation import Pixels, SampleConfig, depth_sigma, render_pixels
from jaxpose.slam.tracking.predict import TrackingProblem

_LEAST_SPREAD = 0.01  # of colours in [0, 1]


@dataclass(frozen=True)
class TrackConfig:
    """How one frame is tracked.

    `gradient` is the paper's: Adam on the field through the renderer, pixels drawn anew in each iteration.
    `gauss_newton` first moves the pose itself by second-order steps onto the map's surface, then brings the
    field there (`align.py`).
    """

    method: Literal["gauss_newton", "gradient"] = "gauss_newton"
    pixels: int = 5000  # 200 to 1000 for `gradient`, which draws new ones in each iteration
    edge: int = 8  # [px] border left out
    iterations: int = 25  # at most; 150 for `gradient`
    patience: int = 30  # of `gradient`: iterations without a lower loss after which to stop
    learning_rate: float = 1e-3  # Adam, of TransNet [per translation_scale]
    rotation_rate: float = 2e-4  # of RotsNet
    decay: float = 0.1  # of both rates over the iterations
    field_steps: int = 60  # Adam steps of bringing the field to the motion that is predicted or found
    colour_weight: float = 0.1  # of the colour residual against the depth residual, both in sigmas
    dof_weight: float = 0.1  # of L_dof, in the frame intrinsic under `gradient`
    minimum_valid: float = 0.2  # share of the pixels the map must explain
    sample: SampleConfig = SampleConfig()


class ImuWeights(NamedTuple):
    """Weights of the three inertial losses (METHOD section 5, point 4); 0 leaves one out."""

    loose: float = 0.0
    tight: float = 0.0
    accelerometer: float = 0.0


class Residuals(NamedTuple):
    """Rendered minus measured at pixels, each in its sigmas, and which pixels count."""

    depth: Float[Array, " n"]
    colour: Float[Array, "n 3"]
    inlier: Float[Array, " n"]  # 1 or 0, without gradient
    depth_error: Float[Array, ""]  # [m] median over explained pixels
    colour_error: Float[Array, ""]  # median over pixels that count, of colours in [0, 1]
    exposure: Float[Array, "3"]  # what the colours were multiplied by to be as bright as the map's
    valid: Float[Array, ""]  # share of the pixels with depth that the map explains


def image_residuals(
    query: Query, T_world_cam: Float[Array, "4 4"], pixels: Pixels, far: Float[Array, ""], config: TrackConfig
) -> Residuals:
    """Residuals of depth and colour (paper eq. 4).

    The sigma of depth is that of the rendered distribution and of the sensor; that of colour is the
    residuals' own spread, so that colour that is badly registered to depth counts for less. Pixels off by ten
    times the median are outliers, as in NICE-SLAM, and so are those where the map has nothing yet.
    """
    seen = render_pixels(query, T_world_cam, pixels, far, config.sample)
    error = seen.depth - pixels.depth
    sigma = jnp.sqrt(jax.lax.stop_gradient(seen.variance) + depth_sigma(pixels.depth) ** 2)
    depth = error / sigma
    valid = (pixels.depth > 0) & (seen.opacity > 0.5)
    # However well the others fit, three sigmas are no outlier.
    inlier = valid & (jnp.abs(depth) < jnp.maximum(10 * median(jnp.abs(depth), valid), 3))
    colour = seen.rgb - pixels.rgb
    colour_error, spread = colour_spread(colour, inlier)
    share = jnp.sum(valid) / jnp.maximum(jnp.sum(pixels.depth > 0), 1)
    weight = jax.lax.stop_gradient(inlier.astype(depth.dtype))
    depth_error = median(jnp.abs(error), valid)
    return Residuals(depth, colour / spread, weight, depth_error, colour_error, jnp.ones(3), share)


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


def imu_loss(
    motion: PoseFn, interval: TrackingProblem, weights: ImuWeights, sigmas: ResidualSigmas
) -> Float[Array, ""]:
    """The weighted inertial L1 losses, each in its sigmas, means over readings and axes."""
    if not any(weights):
        return jnp.zeros(())
    readings = interval.readings
    found = inertial.imu_residuals(
        motion,
        jnp.where(readings.mask, readings.imu.t, 0),
        jnp.asarray(readings.imu.omega_body),
        readings.acceleration_body,
        readings.R_ref_body,
    )  # what is not read below is not computed
    mask = jnp.broadcast_to(readings.mask[:, None], (readings.mask.shape[0], 3)).astype(jnp.float32)
    total = jnp.zeros(())
    for weight, residual, sigma in zip(weights, found, sigmas, strict=True):
        if weight:
            total = total + weight * weighted_mean(jnp.abs(residual) / sigma, mask)
    return total


def median(x: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median over the masked entries, without gradient; 0 when there are none."""
    ordered = jnp.sort(jnp.where(mask, jax.lax.stop_gradient(x), jnp.inf))
    middle = ordered[jnp.maximum(jnp.sum(mask) - 1, 0) // 2]
    return jnp.where(jnp.any(mask), middle, 0.0)
