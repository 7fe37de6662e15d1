"""Tracking: the pose field brought to one RGB-D frame and the inertial readings since the last one.

The whole inner loop is one compiled call. Times are seconds since the last frame and poses are motions of the
body since then, `T_ref_body` with ref = the body at the last frame, so that nothing recompiles and float32 is
enough however long the recording. What the field's own output refers to (the paper's table 9) and which clock
it reads are compositions on top, `slam/frames.py`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from jaxpose import se3
from jaxpose.camera import Camera
from jaxpose.fields import Params, pin
from jaxpose.imu import ResidualSigmas
from jaxpose.scenes import SceneField
from jaxpose.slam.align import align
from jaxpose.slam.frames import Framed
from jaxpose.slam.objective import ImuWeights, TrackConfig, image_loss, image_residuals, imu_loss
from jaxpose.slam.observe import sample_pixels
from jaxpose.slam.predict import AHEAD

_POSE_SIGMA = 2e-3  # [m, rad] what the field should keep to poses within


class Tracked(NamedTuple):
    """The result: the field, the motion since the last frame, and how well it explains the image."""

    params: Params
    T_ref_body: Float[Array, "4 4"]
    loss: Float[Array, ""]  # of the image, in sigmas
    depth_error: Float[Array, ""]  # [m] median over valid pixels
    valid: Float[Array, ""]  # share of pixels with depth that the map explains
    iterations: Int[Array, ""]


def make_track(
    scene: SceneField,
    framed: Framed,
    camera: Camera,
    T_body_cam: Float[Array, "4 4"],
    config: TrackConfig,
    weights: ImuWeights,
    sigmas: ResidualSigmas,
):
    """The compiled tracking step `track(scene_params, params, T_world_ref, gauge, interval, image, far, key)`.

    It returns `Tracked`. The field starts from its own parameters, brought to the interval's predicted motion.
    """

    motion = framed.motion

    def bring(params, gauge, interval, T_ref_body, stamps):
        """The field at the motion given at the stamps, and close to the inertial readings."""

        def loss(params):
            move = motion(params, gauge)
            error = jax.vmap(move)(stamps) - T_ref_body
            square = jnp.sum(error[:, :3] ** 2, axis=(-2, -1)) / _POSE_SIGMA**2
            # Square near zero, so that Adam settles; else by size.
            return jnp.mean(jnp.sqrt(1 + square)) + imu_loss(move, interval, weights, sigmas)

        objective = lambda params, i: (loss(params), jnp.zeros(0))
        (params, _), _ = _descend(objective, params, config, config.field_steps, config.field_steps)
        return params

    def gauss_newton(scene_params, params, T_world_ref, gauge, interval, image, far, key):
        pixels = sample_pixels(key, image, camera, config.pixels, edge=config.edge)
        start = se3.compose(T_world_ref, se3.compose(interval.T_ref_body[AHEAD - 1], T_body_cam))
        found = align(partial(scene.query, scene_params), start, pixels, far, config)
        T_world_body = se3.compose(found.T_world_cam, se3.inverse(T_body_cam))
        T_ref_body = se3.compose(se3.inverse(T_world_ref), T_world_body)
        # The motion found at this frame, and that of the frames before.
        stamps, poses = interval.stamps[AHEAD - 1 :], interval.T_ref_body[AHEAD - 1 :].at[0].set(T_ref_body)
        if any(weights):
            params = bring(params, gauge, interval, poses, stamps)
        params = pin(lambda p: jax.vmap(framed.direct(p, gauge))(stamps), params, poses)
        return Tracked(
            params,
            motion(params, gauge)(interval.t),
            found.loss,
            found.residuals.depth_error,
            found.residuals.valid,
            found.iterations,
        )

    def gradient(scene_params, params, T_world_ref, gauge, interval, image, far, key):
        params = bring(params, gauge, interval, interval.T_ref_body, interval.stamps)
        query = partial(scene.query, scene_params)

        def loss(params, i):
            move = motion(params, gauge)
            pixels = sample_pixels(jax.random.fold_in(key, i), image, camera, config.pixels, edge=config.edge)
            T_world_cam = se3.compose(T_world_ref, se3.compose(move(interval.t), T_body_cam))
            found = image_residuals(query, T_world_cam, pixels, far, config)
            total = image_loss(found, config)
            seen = jnp.stack([total, found.depth_error, found.valid])
            return total + imu_loss(move, interval, weights, sigmas), seen

        (params, seen), i = _descend(loss, params, config, config.iterations, config.patience)
        return Tracked(params, motion(params, gauge)(interval.t), *seen, i)

    return jax.jit(gauss_newton if config.method == "gauss_newton" else gradient)


def _descend(objective, params, config: TrackConfig, iterations: int, patience: int):
    """Adam on `objective(params, i) -> (loss, seen)` until it no longer falls for `patience` iterations.

    Returns the parameters with running means of `seen`, and the iterations used. The loss is judged by running
    means too: pixels differ from one iteration to the next.
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
    """Adam's rate for every leaf: that of the network it belongs to, at whatever depth the networks' names are."""

    def rate(path, leaf):
        names = [entry.key for entry in path if isinstance(entry, jax.tree_util.DictKey)]
        found = [rates[name] for name in names if name in rates]
        return jnp.asarray(found[0] if found else rates["translation"], leaf.dtype)

    return jax.tree_util.tree_map_with_path(rate, params)
