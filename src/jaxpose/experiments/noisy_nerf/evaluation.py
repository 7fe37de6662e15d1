"""Errors of a training: of its poses, and of held-out views, with and without test-time pose refinement."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, PRNGKeyArray

from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.image_metrics import image_metrics, means, pose_numbers
from jaxpose.experiments.noisy_nerf.model import Model
from jaxpose.experiments.noisy_nerf.options import Config, Problem
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.fields import set_progress
from jaxpose.geometry.rigid import Similarity
from jaxpose.plots.nerf import HeldOut
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
    "photograph",
}


class Measured(NamedTuple):
    """The numbers, the held-out views to draw, and poses aligned with the ground truth."""

    numbers: dict[str, Any]
    views: list[HeldOut]
    T_start: Float[np.ndarray, "n 4 4"]
    T_estimate: Float[np.ndarray, "n 4 4"]
    alignment: Similarity  # of the latter


def measure(
    config: Config,
    problem: Problem,
    model: Model,
    state: State,
    T_world_cam: Float[np.ndarray, "n 4 4"],
    on_update: OnUpdate,
) -> Measured:
    """Errors of the trained poses, and of what the scene shows from held-out ones."""
    ground_truth = problem.train.T_world_cam
    errors = trajectory_error.pose_errors(T_world_cam, ground_truth)
    at_start = trajectory_error.pose_errors(problem.T_start, ground_truth)
    to_estimate = trajectory_error.procrustes(ground_truth, T_world_cam)
    viewer = photometric.viewer(
        model.scene,
        problem.train.camera,
        model.depths,
        model.train,
        refine_steps=config.test_pose_steps,
        refine_optimizer=optax.adam(model.refine_rate),
    )
    scene = set_progress(state.scene, jnp.ones(()))
    keys = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 1), len(problem.held_out.t))
    as_aligned, as_refined, views = [], [], []
    on_update(Update("rendering held-out views", 0, len(keys), "views"))
    for index, key in enumerate(keys):
        pose = trajectory_error.align(to_estimate, problem.held_out.T_world_cam[index : index + 1])[0]
        image, view = _seen(viewer, scene, problem, index, pose)
        as_aligned.append(image)
        views.append(view)
        if config.test_pose_steps:
            as_refined.append(_test_time_refined(viewer, scene, problem, index, pose, key))
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
    )


def _test_time_refined(
    viewer: Viewer,
    scene: Any,
    problem: Problem,
    index: int,
    pose: Float[np.ndarray, "4 4"],
    key: PRNGKeyArray,
) -> dict[str, float | None]:
    rgb = jnp.asarray(problem.held_out.rgb[index])
    moved = viewer.refine_pose(scene, jnp.asarray(pose, jnp.float32), rgb, key)
    return _seen(viewer, scene, problem, index, np.asarray(moved, np.float64))[0]


def _seen(
    viewer: Viewer, scene: Any, problem: Problem, index: int, pose: Float[np.ndarray, "4 4"]
) -> tuple[dict[str, float | None], HeldOut]:
    """A held-out photograph rendered from a pose: how alike they are, and both."""
    rgb, depth = viewer.image(scene, jnp.asarray(pose, jnp.float32))
    rendered = np.clip(np.asarray(rgb, np.float64), 0, 1)
    photograph = problem.held_out.rgb[index]
    label = problem.held_out.files[index]
    return image_metrics(rendered, photograph / 255), HeldOut(
        label, photograph, rendered, np.asarray(depth, np.float64)
    )
