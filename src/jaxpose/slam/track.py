"""Tracking: the pose field optimised against one RGB-D frame and the inertial readings since the last one.

The whole inner loop is one compiled call. Times are seconds since the last frame and poses are motions of the
body since then, `T_ref_body` with ref = the body at the last frame, so that nothing recompiles and float32 is
enough however long the recording. What the field's own output refers to (the paper's table 9) is a composition
on top, `Frame`.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxpose import imu as inertial
from jaxpose import se3
from jaxpose.camera import Camera
from jaxpose.fields import Params, PoseField, PoseFn, fit
from jaxpose.imu import ResidualSigmas
from jaxpose.losses import weighted_mean
from jaxpose.scenes import SceneField
from jaxpose.slam.frames import Motion
from jaxpose.slam.observe import Image, Pixels, SampleConfig, depth_sigma, render_pixels, sample_pixels
from jaxpose.slam.predict import Interval


@dataclass(frozen=True)
class TrackConfig:
    """How one frame is tracked."""

    pixels: int = 400  # drawn anew in every iteration
    edge: int = 8  # [px] border left out
    iterations: int = 40  # at most
    patience: int = 8  # iterations without a lower loss after which to stop
    learning_rate: float = 1e-3  # Adam, of TransNet [per translation_scale]
    rotation_rate: float = 2e-4  # of RotsNet
    decay: float = 0.1  # of both rates over `iterations`
    start_steps: int = 30  # of fitting the field to the predicted motion
    colour_weight: float = 0.2  # of the colour residual against the depth residual, both in sigmas
    minimum_valid: float = 0.2  # share of the pixels the map must explain
    sample: SampleConfig = SampleConfig()


class ImuWeights(NamedTuple):
    """Weights of the three inertial losses (METHOD section 5, point 4); 0 leaves one out of the computation."""

    loose: float = 0.0
    tight: float = 0.0
    accelerometer: float = 0.0


class Tracked(NamedTuple):
    """The result: the field, the motion since the last frame, and how well it explains the image."""

    params: Params
    T_ref_body: Float[Array, "4 4"]
    loss: Float[Array, ""]  # mean over the last iterations, in sigmas
    depth_error: Float[Array, ""]  # [m] median over valid pixels
    valid: Float[Array, ""]  # share of pixels with depth that the map explains
    iterations: Int[Array, ""]


def render_loss(
    query, T_world_cam: Float[Array, "4 4"], pixels: Pixels, far: Float[Array, ""], config: TrackConfig
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Float[Array, ""]]]:
    """Depth and colour residuals in sigmas (paper eq. 4); also the median depth error [m] and the valid share.

    The depth's sigma is that of the rendered distribution and of the sensor; the colour's is the residuals' own
    spread, so that colour that is badly registered to depth counts for less. Pixels off by ten times the median
    are left out, as in NICE-SLAM.
    """
    seen = render_pixels(query, T_world_cam, pixels, far, config.sample)
    has_depth = pixels.depth > 0
    error = jnp.abs(seen.depth - pixels.depth)
    sigma = jnp.sqrt(jax.lax.stop_gradient(seen.variance) + depth_sigma(pixels.depth) ** 2)
    valid = has_depth & (seen.opacity > 0.5)
    residual = error / sigma
    inlier = valid & (residual < 10 * _median(residual, valid))
    colour = jnp.mean(jnp.abs(seen.rgb - pixels.rgb), axis=-1)
    spread = jnp.maximum(_median(colour, inlier), 0.01)
    weight = jax.lax.stop_gradient(inlier.astype(error.dtype))
    loss = weighted_mean(residual, weight) + config.colour_weight * weighted_mean(colour / spread, weight)
    share = jnp.sum(valid) / jnp.maximum(jnp.sum(has_depth), 1)
    return loss, (_median(error, valid), share)


def imu_loss(
    motion: PoseFn, interval: Interval, weights: ImuWeights, sigmas: ResidualSigmas
) -> Float[Array, ""]:
    """The weighted inertial L1 losses, each in units of its sigma, as means over readings and axes."""
    mask = jnp.broadcast_to(interval.readings.mask[:, None], (interval.readings.mask.shape[0], 3)).astype(
        jnp.float32
    )
    times = jnp.where(interval.readings.mask, interval.readings.imu.t, 0)
    if weights.accelerometer:
        residuals = inertial.imu_residuals(
            motion,
            times,
            interval.readings.imu.omega_body,
            interval.readings.acceleration_body,
            interval.readings.R_ref_body,
        )
        terms = residuals._asdict()
    else:
        terms = {}
        if weights.tight:
            terms["tight"] = inertial.gyro_tight_residual(motion, times, interval.readings.imu.omega_body)
        if weights.loose:
            terms["loose"] = inertial.gyro_loose_residual(motion, times, interval.readings.R_ref_body)
    total = jnp.zeros(())
    for name, weight in weights._asdict().items():
        if weight:
            total = total + weight * weighted_mean(jnp.abs(terms[name]) / getattr(sigmas, name), mask)
    return total


def make_track(
    scene: SceneField,
    field: PoseField,
    motion: Motion,
    camera: Camera,
    T_body_cam: Float[Array, "4 4"],
    config: TrackConfig,
    weights: ImuWeights,
    sigmas: ResidualSigmas,
):
    """The compiled tracking step `track(scene_params, params, T_world_ref, gauge, interval, image, far, key)`.

    First the field is fitted to the interval's predicted motion, then optimised on pixels drawn anew each
    iteration until its loss no longer falls.
    """
    rates = {"translation": config.learning_rate, "rotation": config.rotation_rate}
    adam = optax.scale_by_adam()

    def loss_fn(params, scene_params, T_world_ref, gauge, interval, image, far, key):
        move = motion(params, gauge)
        pixels = sample_pixels(key, image, camera, config.pixels, edge=config.edge)
        T_world_cam = se3.compose(T_world_ref, se3.compose(move(interval.t), T_body_cam))
        loss, (error, share) = render_loss(
            partial(scene.query, scene_params), T_world_cam, pixels, far, config
        )
        if any(weights):
            loss = loss + imu_loss(move, interval, weights, sigmas)
        return loss, (error, share)

    @jax.jit
    def track(scene_params, params, T_world_ref, gauge, interval, image, far, key) -> Tracked:
        rate_tree = _rates(params, rates)
        moving = PoseField(field.init, lambda p, t: motion(p, gauge)(t))
        params = fit(
            moving, interval.stamps, interval.T_ref_body, params=params, steps=config.start_steps,
            learning_rate=rate_tree, decay=0.1,
        ).params  # fmt: skip

        def improve(carry):
            params, state, loss, error, share, best, best_at, i = carry
            grad_fn = jax.value_and_grad(loss_fn, has_aux=True)
            (now, (error_now, share_now)), gradient = grad_fn(
                params, scene_params, T_world_ref, gauge, interval, image, far, jax.random.fold_in(key, i)
            )
            with jax.numpy_dtype_promotion("standard"):
                direction, state = adam.update(gradient, state)
            fall = config.decay ** (i.astype(jnp.float32) / config.iterations)
            params = jax.tree.map(lambda p, r, d: p - r * fall * d, params, rate_tree, direction)
            # Pixels differ from one iteration to the next: judge by running means.
            keep = jnp.where(i == 0, 0.0, 0.8)
            loss, error, share = (
                keep * old + (1 - keep) * new
                for old, new in ((loss, now), (error, error_now), (share, share_now))
            )
            lower = loss < best * (1 - 1e-3)
            best, best_at = jnp.where(lower, loss, best), jnp.where(lower, i, best_at)
            return params, state, loss, error, share, best, best_at, i + 1

        def unsettled(carry):
            *_, best_at, i = carry
            return (i < config.iterations) & (i - best_at <= config.patience)

        zero = jnp.zeros(())
        start = (params, adam.init(params), zero, zero, zero, jnp.inf, jnp.int32(0), jnp.int32(0))
        params, _, loss, error, share, *_, i = jax.lax.while_loop(unsettled, improve, start)
        return Tracked(params, motion(params, gauge)(interval.t), loss, error, share, i)

    return track


def _rates(params, rates):
    """Adam's rate for every leaf: that of the network it belongs to, at whatever depth the networks' names are."""

    def rate(path, leaf):
        names = [entry.key for entry in path if isinstance(entry, jax.tree_util.DictKey)]
        found = [rates[name] for name in names if name in rates]
        return jnp.asarray(found[0] if found else rates["translation"], leaf.dtype)

    return jax.tree_util.tree_map_with_path(rate, params)


def _median(x: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median over the masked entries, without gradient; 0 when there are none."""
    ordered = jnp.sort(jnp.where(mask, jax.lax.stop_gradient(x), jnp.inf))
    middle = ordered[jnp.maximum(jnp.sum(mask) - 1, 0) // 2]
    return jnp.where(jnp.any(mask), middle, 0.0)
