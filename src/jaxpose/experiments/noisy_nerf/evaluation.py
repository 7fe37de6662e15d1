"""Errors of a training: of its poses, and of held-out views, with and without test-time pose refinement."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, PRNGKeyArray

from jaxpose.datasets.types import Photographs
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.image_metrics import POSE_NUMBERS, image_metrics, means, pose_numbers
from jaxpose.experiments.noisy_nerf.model import Model
from jaxpose.experiments.noisy_nerf.options import Config, Problem
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.fields import set_progress
from jaxpose.geometry.rigid import Similarity
from jaxpose.plots.nerf import HeldOut
from jaxpose.structure import evenly_exposed, matching_exposure
from jaxpose.training import photometric
from jaxpose.training.photometric import Viewer
from jaxpose.training.steps import State

PROTOCOL = {
    "alignment": "similarity that maps estimated camera centres to the true ones (scale: ratio of spreads), "
    "as in BARF",
    "rotation_error_deg": "angle to the true orientation after alignment, mean over the training views",
    "translation_error": "distance of world-to-camera translation vectors after alignment, mean over the "
    "training views, as BARF defines it [scene units]",
    "centre_error": "distance of camera centres after alignment, mean over training views [scene units]",
    "image_metrics": "psnr, ssim, lpips: mean over the held-out views, their true poses brought into the "
    "estimate's frame by the alignment; test_time_refined: after test-time refinement of each pose on its "
    "photograph; where exposures differ, each render is brought to its photograph's by a gain of each colour",
}


# Where what photographs share contradicts the poses of the data.
CONTRADICTED_PROTOCOL = PROTOCOL | {
    "image_metrics": "psnr, ssim, lpips: mean over the held-out views, from where the trajectory is at their "
    "times, as the data's poses disagree with the photographs; test_time_refined: after test-time refinement "
    "of each pose on its photograph",
}
# Where no pose is known there is nothing to align with, and no view can be placed but by training on it.
UNPOSED_PROTOCOL = {
    **dict.fromkeys(PROTOCOL, "not measured: no poses are known"),
    "image_metrics": "psnr, ssim, lpips: mean over some of the views trained on, from the poses found",
}
_TRAINING_VIEWS = 4


class _Shown(NamedTuple):
    """What is looked at: a trained scene, and how."""

    viewer: Viewer
    scene: Any
    varied: bool  # whether photographs are exposed differently


class _Seen(NamedTuple):
    """One view of it beside its photograph."""

    numbers: dict[str, float | None]
    view: HeldOut
    exposure: Float[np.ndarray, "3"]  # how many times brighter the photograph is than the scene


class Measured(NamedTuple):
    """The numbers, views to draw, and poses aligned with the ground truth, where there is any."""

    numbers: dict[str, Any]
    views: list[HeldOut]
    T_start: Float[np.ndarray, "n 4 4"]
    T_estimate: Float[np.ndarray, "n 4 4"]
    alignment: Similarity  # of the latter
    posed: bool  # whether there is ground truth


def measure(
    config: Config,
    problem: Problem,
    model: Model,
    state: State,
    T_world_cam: Float[np.ndarray, "n 4 4"],
    T_held_out: Float[np.ndarray, "m 4 4"] | None,
    on_update: OnUpdate,
) -> Measured:
    """Errors of the trained poses, and of what the scene shows from held-out ones, else from trained ones.

    `T_held_out` are those in the world of the training; None: the stated ones, brought there.
    """
    viewer = photometric.viewer(
        model.scene,
        problem.train.camera,
        model.depths,
        model.train,
        refine_steps=config.test_pose_steps,
        refine_optimizer=optax.adam(model.refine_rate),
        sampler=model.sampler,
    )
    shown = _Shown(viewer, set_progress(state.scene, jnp.ones(())), model.varied)
    if not np.isfinite(problem.train.T_world_cam).all():
        return _measure_training_views(problem, shown, T_world_cam, on_update)
    ground_truth = problem.train.T_world_cam
    errors = trajectory_error.pose_errors(T_world_cam, ground_truth)
    at_start = trajectory_error.pose_errors(problem.T_start, ground_truth)
    to_estimate = trajectory_error.procrustes(ground_truth, T_world_cam)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 1), len(problem.held_out.t))
    if T_held_out is None:
        T_held_out = trajectory_error.align(to_estimate, problem.held_out.T_world_cam)
    as_aligned, as_refined, views = [], [], []
    on_update(Update("rendering held-out views", 0, len(keys), "views"))
    for index, (key, pose) in enumerate(zip(keys, T_held_out, strict=True)):
        seen = _seen(shown, problem.held_out, index, pose)
        as_aligned.append(seen.numbers)
        views.append(seen.view)
        if config.test_pose_steps:
            as_refined.append(_test_time_refined(shown, problem.held_out, index, pose, seen.exposure, key))
        on_update(Update("rendering held-out views", index + 1, len(keys), "views"))
    numbers = {
        **pose_numbers(errors, problem.extent),
        **means(as_aligned),
        "test_time_refined": means(as_refined) if as_refined else None,
        "start": pose_numbers(at_start, problem.extent),
        "max": {
            "rotation_error_deg": np.nanmax(errors.rotation_errors_deg),
            "translation_error": np.nanmax(errors.translation_errors),
        },
        "held_out": as_aligned,
    }
    return Measured(
        numbers,
        views,
        trajectory_error.align(at_start.alignment, problem.T_start),
        trajectory_error.align(errors.alignment, T_world_cam),
        errors.alignment,
        True,
    )


def _measure_training_views(
    problem: Problem,
    shown: _Shown,
    T_world_cam: Float[np.ndarray, "n 4 4"],
    on_update: OnUpdate,
) -> Measured:
    """What the scene shows of photographs without known poses, from the poses found for them."""
    rows = np.unique(np.linspace(0, len(T_world_cam) - 1, _TRAINING_VIEWS).round().astype(int))
    on_update(Update("rendering training views"))
    seen = [_seen(shown, problem.train, int(row), T_world_cam[row]) for row in rows]
    unknown = dict.fromkeys(POSE_NUMBERS)
    numbers = {
        **unknown,
        **means([each.numbers for each in seen]),
        "test_time_refined": None,
        "start": unknown,
        "max": {"rotation_error_deg": None, "translation_error": None},
        "held_out": [],
    }
    still = Similarity(1.0, np.eye(3), np.zeros(3))
    return Measured(numbers, [each.view for each in seen], problem.T_start, T_world_cam, still, False)


def _test_time_refined(
    shown: _Shown,
    held_out: Photographs,
    index: int,
    pose: Float[np.ndarray, "4 4"],
    exposure: Float[np.ndarray, "3"],
    key: PRNGKeyArray,
) -> dict[str, float | None]:
    rgb = held_out.rgb[index]
    mask = None if held_out.mask is None else held_out.mask[index]
    if shown.varied:
        (rgb,), (known,) = evenly_exposed(rgb[None], exposure[None])
        mask = known if mask is None else known & mask
    at, counts = jnp.asarray(pose, jnp.float32), None if mask is None else jnp.asarray(mask)
    moved = shown.viewer.refine_pose(shown.scene, at, jnp.asarray(rgb), key, counts)
    return _seen(shown, held_out, index, np.asarray(moved, np.float64)).numbers


def _seen(shown: _Shown, photographs: Photographs, index: int, pose: Float[np.ndarray, "4 4"]) -> _Seen:
    """A photograph's view rendered from a pose, as bright as the photograph."""
    rgb, depth = shown.viewer.image(shown.scene, jnp.asarray(pose, jnp.float32))
    photograph, rendered = photographs.rgb[index], np.asarray(rgb, np.float64)
    mask = None if photographs.mask is None else photographs.mask[index]
    counted = slice(None) if mask is None else mask
    exposure = matching_exposure(rendered[counted], photograph[counted]) if shown.varied else np.ones(3)
    rendered = np.clip(rendered * exposure, 0, 1)
    view = HeldOut(photographs.files[index], photograph, rendered, np.asarray(depth, np.float64))
    return _Seen(image_metrics(rendered, photograph / 255, mask), view, exposure)
