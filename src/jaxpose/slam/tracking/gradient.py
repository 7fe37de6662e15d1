"""Tracking as in the paper: Adam on the pose field, through the renderer and against the inertial readings.

The whole inner loop is one compiled call. Times are seconds since the last frame and poses are motions of the
body since then, `T_ref_body` with ref = the body at the last frame, so that nothing recompiles and float32 is
enough however long the recording. `register.py` is the default, and faster.
"""

from functools import partial

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from jaxpose import imu as inertial
from jaxpose.fields import PoseFn
from jaxpose.fields.intrinsic_motion import dof_loss
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, angle_of_view
from jaxpose.losses import weighted_mean
from jaxpose.optim import minimize, scale_by_rates
from jaxpose.render import Query
from jaxpose.scenes import SceneField
from jaxpose.slam.config import ImuWeights, TrackConfig
from jaxpose.slam.observation import Pixels, depth_sigma, render_pixels, sample_pixels
from jaxpose.slam.tracking.predict import TrackingProblem
from jaxpose.slam.tracking.reference_frames import FramedField
from jaxpose.slam.tracking.register import (
    Residuals,
    Tracked,
    TrackStep,
    colour_spread,
    image_loss,
    median,
)

_POSE_SIGMA = 2e-3  # [m, rad] what the field should keep to predicted poses within


def make_gradient(
    scene: SceneField, framed: FramedField, camera: Camera, config: TrackConfig, weights: ImuWeights
) -> TrackStep:
    """The compiled `TrackStep` of the method `gradient`: the field starts from its own parameters.

    It is first brought to the predicted motion, so that the image needs few of the costly iterations.
    """
    view = angle_of_view(camera)[0]

    def auxiliary_loss(params, problem: TrackingProblem):
        total = imu_loss(framed.motion(params, problem.reference_frame), problem, weights)
        if framed.parts is not None:
            _, inner = framed.parts
            T_inner = inner.pose(params["inner"], problem.reference_frame.time(problem.t))
            total = total + config.dof_weight * dof_loss(T_inner, view)
        return total

    def fit(params, problem: TrackingProblem):
        def loss(params, i):
            del i
            motion = framed.motion(params, problem.reference_frame)
            error = jax.vmap(motion)(problem.timestamps) - problem.T_ref_body
            square = jnp.sum(error[:, :3] ** 2, axis=(-2, -1)) / _POSE_SIGMA**2
            # Square near zero, so that Adam settles; else by size.
            return jnp.mean(jnp.sqrt(1 + square)) + auxiliary_loss(params, problem), jnp.zeros(0)

        return _descend(loss, params, config, config.field_steps, config.field_steps)[0][0]

    @jax.jit
    def step(scene_params, fusion_state, params, problem, image, max_depth, key):
        del fusion_state
        params = fit(params, problem)
        query = partial(scene.query, scene_params)

        def loss(params, i):
            pixels = sample_pixels(jax.random.fold_in(key, i), image, camera, config.pixels, edge=config.edge)
            T_ref_body = framed.motion(params, problem.reference_frame)(problem.t)
            T_world_cam = se3.compose(problem.T_world_ref, se3.compose(T_ref_body, problem.T_body_cam))
            found = image_residuals(query, T_world_cam, pixels, max_depth, config)
            total = image_loss(found, config)
            seen = jnp.stack([total, found.depth_error, found.colour_error, found.valid])
            return total + auxiliary_loss(params, problem), seen

        (params, (total, depth_error, colour_error, valid)), iterations = _descend(
            loss, params, config, config.iterations, config.patience
        )
        T_ref_body = framed.motion(params, problem.reference_frame)(problem.t)
        exposure, unknown = jnp.asarray(image.exposure), jnp.full(2, jnp.nan)
        return Tracked(
            T_ref_body, params, total, depth_error, colour_error, exposure, valid, iterations, unknown,
            jnp.full((6, 6), jnp.nan), jnp.zeros((6, 6)), jnp.full(2, jnp.nan),
        )  # fmt: skip

    return step


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


def imu_loss(motion: PoseFn, problem: TrackingProblem, weights: ImuWeights) -> Float[Array, ""]:
    """The weighted inertial L1 losses, each in its sigmas, means over readings and axes."""
    if not any(weights):
        return jnp.zeros(())
    readings = problem.readings
    found = inertial.imu_residuals(
        motion,
        jnp.where(readings.mask, readings.imu.t, 0),
        jnp.asarray(readings.imu.omega_body),
        readings.acceleration_body,
        readings.R_ref_body,
    )  # what is not read below is not computed
    mask = jnp.broadcast_to(readings.mask[:, None], (readings.mask.shape[0], 3)).astype(jnp.float32)
    total = jnp.zeros(())
    for weight, residual, sigma in zip(weights, found, problem.imu_sigmas, strict=True):
        if weight:
            total = total + weight * weighted_mean(jnp.abs(residual) / sigma, mask)
    return total


def _descend(objective, params, config: TrackConfig, iterations: int, patience: int):
    """Adam on `objective(params, i) -> (loss, seen)` until it no longer falls for `patience` iterations.

    Returns the parameters with running means of `seen`, and the iterations used. The loss is judged by
    running means too: pixels differ from one iteration to the next.
    """
    rates = _rates(params, {"translation": config.learning_rate, "rotation": config.rotation_rate})
    decay = lambda rate: optax.exponential_decay(rate, iterations, config.decay)
    tx = optax.chain(optax.scale_by_adam(), scale_by_rates(jax.tree.map(decay, rates)))
    found = minimize(objective, params, tx, iterations, has_aux=True, smoothing=0.8, patience=patience)
    return (found.params, found.aux), found.steps


def _rates(params, rates):
    """Adam's rate for every leaf: that of the network it belongs to, however deep its name is."""

    def rate(path, leaf):
        names = [entry.key for entry in path if isinstance(entry, jax.tree_util.DictKey)]
        found = [rates[name] for name in names if name in rates]
        return jnp.asarray(found[0] if found else rates["translation"], leaf.dtype)

    return jax.tree_util.tree_map_with_path(rate, params)
