"""Tracking: the pose field brought to one RGB-D frame and the inertial readings since the last one.

The whole inner loop is one compiled call. Times are seconds since the last frame and poses are motions of the
body since then, `T_ref_body` with ref = the body at the last frame, so that nothing recompiles and float32 is
enough however long the recording. What the field's own output refers to (the paper's table 9) and which clock
it reads are compositions on top, `slam/frames.py`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from jaxpose.fields import Params, project_onto_poses
from jaxpose.fields.intrinsic_motion import dof_loss
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.imu import ResidualSigmas
from jaxpose.scenes import SceneField
from jaxpose.slam.map.integrate import MapSample
from jaxpose.slam.observation import sample_pixels
from jaxpose.slam.tracking.objective import ImuWeights, TrackConfig, image_loss, image_residuals, imu_loss
from jaxpose.slam.tracking.predict import AHEAD, TrackingProblem
from jaxpose.slam.tracking.reference_frames import FramedField, Motion, ReferenceFrame
from jaxpose.slam.tracking.register import align, best_start, pose_sigma, starts

_POSE_SIGMA = 2e-3  # [m, rad] what the field should keep to poses within


class Tracked(NamedTuple):
    """The result: the field, the motion since the last frame, and how well it explains the image."""

    params: Params
    T_ref_body: Float[Array, "4 4"]
    loss: Float[Array, ""]  # of the image, in sigmas
    depth_error: Float[Array, ""]  # [m] median over valid pixels
    colour_error: Float[Array, ""]  # median, of colours in [0, 1]
    exposure: Float[Array, "3"]  # what its colours are to be multiplied by, to be as bright as the map's
    valid: Float[Array, ""]  # share of pixels with depth that the map explains
    iterations: Int[Array, ""]
    sigma: Float[Array, "2"]  # [m, rad] of the pose, by what the image says of it; NaN: not known


class FieldUpdate(NamedTuple):
    """What brings the field to a motion; compiled apart from the map, whose size may change.

    `motion` is the field's since the last frame, `auxiliary_loss` its loss beside the image's: against the
    readings, and for few degrees of freedom in the intrinsic frame. `fit` is Adam's way to a motion and to
    those, `project` that and Newton's to the poses at `interval.timestamps[AHEAD - 1:]`, the first of them
    `T_ref_body`.
    """

    motion: Motion
    auxiliary_loss: Callable[[Params, ReferenceFrame, TrackingProblem], Float[Array, ""]]
    fit: Callable[[Params, ReferenceFrame, TrackingProblem], Params]
    project: Callable[[Params, ReferenceFrame, TrackingProblem, Float[Array, "4 4"]], Params]


def make_field_update(
    framed: FramedField,
    config: TrackConfig,
    weights: ImuWeights,
    sigmas: ResidualSigmas,
    angle_of_view: float,
) -> FieldUpdate:
    """The field's part of tracking, for a frame of reference and inertial weights."""
    motion = framed.motion

    def auxiliary_loss(params, reference_frame, interval):
        total = imu_loss(motion(params, reference_frame), interval, weights, sigmas)
        if framed.parts is not None:
            _, inner = framed.parts
            T_inner = inner.pose(params["inner"], interval.t + reference_frame.clock)
            total = total + config.dof_weight * dof_loss(T_inner, angle_of_view)
        return total

    def descend(params, reference_frame, interval, timestamps, T_ref_body):
        def loss(params, i):
            del i
            error = jax.vmap(motion(params, reference_frame))(timestamps) - T_ref_body
            square = jnp.sum(error[:, :3] ** 2, axis=(-2, -1)) / _POSE_SIGMA**2
            # Square near zero, so that Adam settles; else by size.
            return jnp.mean(jnp.sqrt(1 + square)) + auxiliary_loss(
                params, reference_frame, interval
            ), jnp.zeros(0)

        return _descend(loss, params, config, config.field_steps, config.field_steps)[0][0]

    def fit(params, reference_frame, interval):
        return descend(params, reference_frame, interval, interval.timestamps, interval.T_ref_body)

    @jax.jit
    def project(before, reference_frame, interval, T_ref_body):
        # The motion found at this frame, and that of the frames before.
        timestamps = interval.timestamps[AHEAD - 1 :]
        poses = interval.T_ref_body[AHEAD - 1 :].at[0].set(T_ref_body)
        params = descend(before, reference_frame, interval, timestamps, poses) if any(weights) else before
        params = project_onto_poses(
            lambda p: jax.vmap(framed.direct(p, reference_frame))(timestamps), params, poses
        )
        # Newton's steps can end far off, or nowhere: the next frame then starts from what was there before.
        arrived = jnp.abs(motion(params, reference_frame)(interval.t) - T_ref_body).max() < 10 * _POSE_SIGMA
        return jax.tree.map(lambda new, old: jnp.where(arrived, new, old), params, before)

    return FieldUpdate(motion, auxiliary_loss, fit, project)


def make_track(
    scene: SceneField,
    sample_map: Callable[[Params, Any, Float[Array, "3"]], MapSample],
    camera: Camera,
    T_body_cam: Float[Array, "4 4"],
    config: TrackConfig,
    field_update: FieldUpdate,
):
    """The step `track(scene_params, memory, params, T_world_ref, gauge, interval, image, far, key)`.

    It returns `Tracked`. `sample_map(scene_params, memory, point)` is the map as alignment reads it. Its
    inner loops are compiled; the field starts from its own parameters `params`.
    """

    @jax.jit
    def aligned(scene_params, fusion_state, T_world_ref, interval, image, key):
        look = partial(sample_map, scene_params, fusion_state)
        pixels = sample_pixels(key, image, camera, config.pixels, edge=config.edge)
        tries = starts(interval.T_ref_body[AHEAD - 1], interval.sigma)
        T_world_tries = se3.compose(T_world_ref, se3.compose(tries, T_body_cam))
        start = best_start(look, T_world_tries, pixels)
        found = align(look, start, T_world_tries[0], interval.sigma, pixels, config)
        T_world_body = se3.compose(found.T_world_cam, se3.inverse(T_body_cam))
        seen = (
            found.loss,
            found.residuals.depth_error,
            found.residuals.colour_error,
            image.exposure * found.residuals.exposure,
            found.residuals.valid,
            found.iterations,
            pose_sigma(found),
        )
        return se3.compose(se3.inverse(T_world_ref), T_world_body), seen

    def gauss_newton(
        scene_params, fusion_state, params, T_world_ref, reference_frame, interval, image, far, key
    ):
        del far  # nothing is rendered
        T_ref_body, seen = aligned(scene_params, fusion_state, T_world_ref, interval, image, key)
        return Tracked(field_update.project(params, reference_frame, interval, T_ref_body), T_ref_body, *seen)

    @jax.jit
    def gradient(scene_params, fusion_state, params, T_world_ref, reference_frame, interval, image, far, key):
        del fusion_state
        params = field_update.fit(params, reference_frame, interval)
        query = partial(scene.query, scene_params)

        def loss(params, i):
            pixels = sample_pixels(jax.random.fold_in(key, i), image, camera, config.pixels, edge=config.edge)
            T_ref_body = field_update.motion(params, reference_frame)(interval.t)
            T_world_cam = se3.compose(T_world_ref, se3.compose(T_ref_body, T_body_cam))
            found = image_residuals(query, T_world_cam, pixels, far, config)
            total = image_loss(found, config)
            seen = jnp.stack([total, found.depth_error, found.colour_error, found.valid])
            return total + field_update.auxiliary_loss(params, reference_frame, interval), seen

        (params, (total, depth_error, colour_error, valid)), i = _descend(
            loss, params, config, config.iterations, config.patience
        )
        T_ref_body, unknown = field_update.motion(params, reference_frame)(interval.t), jnp.full(2, jnp.nan)
        exposure = jnp.asarray(image.exposure)
        return Tracked(params, T_ref_body, total, depth_error, colour_error, exposure, valid, i, unknown)

    return gauss_newton if config.method == "gauss_newton" else gradient


def _descend(objective, params, config: TrackConfig, iterations: int, patience: int):
    """Adam on `objective(params, i) -> (loss, seen)` until it no longer falls for `patience` iterations.

    Returns the parameters with running means of `seen`, and the iterations used. The loss is judged by
    running means too: pixels differ from one iteration to the next.
    """
    rates = _rates(params, {"translation": config.learning_rate, "rotation": config.rotation_rate})
    adam = optax.scale_by_adam()

    def improve(carry):
        params, state, mean, seen, best, best_at, i = carry
        (loss, now), gradient = jax.value_and_grad(objective, has_aux=True)(params, i)
        with jax.numpy_dtype_promotion("standard"):  # optax needs it
            direction, state = adam.update(gradient, state)
        fall = config.decay ** (i.astype(jnp.float32) / iterations)
        params = jax.tree.map(lambda p, rate, d: p - rate * fall * d, params, rates, direction)
        keep = jnp.where(i == 0, 0.0, 0.8)
        mean, seen = keep * mean + (1 - keep) * loss, keep * seen + (1 - keep) * now
        lower = mean < best * (1 - 1e-3)
        best, best_at = jnp.where(lower, mean, best), jnp.where(lower, i, best_at)
        return params, state, mean, seen, best, best_at, i + 1

    def unsettled(carry):
        *_, best_at, i = carry
        return (i < iterations) & (i - best_at <= patience)

    zero = jnp.zeros(jax.eval_shape(objective, params, jnp.int32(0))[1].shape)
    start = (params, adam.init(params), jnp.zeros(()), zero, jnp.inf, jnp.int32(0), jnp.int32(0))
    params, _, _, seen, *_, i = jax.lax.while_loop(unsettled, improve, start)
    return (params, seen), i


def _rates(params, rates):
    """Adam's rate for every leaf: that of the network it belongs to, however deep its name is."""

    def rate(path, leaf):
        names = [entry.key for entry in path if isinstance(entry, jax.tree_util.DictKey)]
        found = [rates[name] for name in names if name in rates]
        return jnp.asarray(found[0] if found else rates["translation"], leaf.dtype)

    return jax.tree_util.tree_map_with_path(rate, params)
