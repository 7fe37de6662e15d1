"""How good a training on events is: pose errors over the motion, held-out views after a correction."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.datasets.types import Photographs, take
from jaxpose.evaluation import trajectory_error
from jaxpose.evaluation.trajectory_error import PoseErrors
from jaxpose.events import GAMMA, contrast, log_intensity
from jaxpose.experiments.event_nerf.model import Model
from jaxpose.experiments.event_nerf.options import Problem
from jaxpose.experiments.image_metrics import image_metrics, means, pose_numbers
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.experiments.training_loop import pose_reader
from jaxpose.fields import piecewise_geodesic, set_progress
from jaxpose.geometry.rigid import Similarity, vector_angle
from jaxpose.plots.nerf import HeldOut
from jaxpose.training import photometric
from jaxpose.training.photometric import RenderImage, TrainConfig
from jaxpose.training.steps import State

_MOST_POSES = 200  # at which errors are measured
_MULTIPLES = (-1.0, 0.0, 0.5, 0.8, 1.0, 1.25, 2.0)  # of the motion, along which contrast is measured
PROTOCOL = {
    "alignment": "similarity that maps estimated camera centres to the true ones (scale: ratio of spreads)",
    "rotation_error_deg": "angle to the true orientation after alignment, mean over at most 200 true poses "
    "evenly over the motion",
    "constant_rotation_error_deg": "angle of the mean turn from true to estimated orientation, in the "
    "camera's axes: what is left of a wrong axis' offset",
    "translation_error": "distance of world-to-camera translation vectors after alignment, mean over the "
    "same, as BARF defines it [scene units]",
    "centre_error": "distance of camera centres after alignment, mean over the same [scene units]",
    "image_metrics": "psnr, ssim, lpips: mean over the held-out views, their true poses brought into the "
    "estimate's frame by the alignment, no test-time refinement; first slope and offset of log intensity are "
    "fitted for each colour over all views, as EventNeRF does",
    "frames": "the same numbers for the camera's own images during the events, rendered at their timestamps",
    "displacement": "of the camera from first to last event in its own axes, and its angle to the true one; "
    "variance of the warped events along multiples of it, depths as rendered",
}


class GroundTruth(NamedTuple):
    """Some of the true poses during the events, and where the training starts at the same instants."""

    t: Float[np.ndarray, " m"]
    T_world_cam: Float[np.ndarray, "m 4 4"]
    T_start: Float[np.ndarray, "m 4 4"]


class Measured(NamedTuple):
    """The numbers, views to draw beside photographs, and where there is ground truth errors over time."""

    numbers: dict[str, Any]
    held_out: list[HeldOut]
    frames: list[HeldOut]  # the camera's own
    at_start: PoseErrors | None
    at_end: PoseErrors | None
    alignment: Similarity  # of the estimate with the ground truth; none where there is no ground truth


def find_truth(problem: Problem) -> GroundTruth | None:
    """None where fewer than three true poses are known during the events: an alignment would fit anything."""
    recording, (first, last) = problem.recording, problem.span
    during = np.flatnonzero((recording.t >= first) & (recording.t <= last))
    if len(during) < 3:
        return None
    at = during[np.unique(np.linspace(0, len(during) - 1, min(len(during), _MOST_POSES)).round().astype(int))]
    start = piecewise_geodesic(*(jnp.asarray(x, jnp.float32) for x in problem.start[:2]))
    T_start = jax.jit(jax.vmap(partial(start.pose, {})))(jnp.asarray(recording.t[at], jnp.float32))
    return GroundTruth(recording.t[at], recording.T_world_cam[at], np.asarray(T_start, np.float64))


def measure(
    problem: Problem, model: Model, state: State, ground_truth: GroundTruth | None, on_update: OnUpdate
) -> Measured:
    """Errors of the trained trajectory, what the scene shows, and how sharp the motion makes the events."""
    scene = set_progress(state.scene, jnp.ones(()))
    recording = problem.recording
    # Twice as finely as in training, whose samples are drawn anew in every step.
    finely = TrainConfig(steps=1, rays=1, samples=2 * model.train.samples, chunk=64)
    look = lambda camera: (
        photometric.viewer(model.scene, camera, problem.depths, finely, background=problem.background).image
    )
    at_start = at_end = None
    numbers: dict[str, Any] = {}
    to_truth = Similarity(1.0, np.eye(3), np.zeros(3))
    views, seen = [], {"psnr": None, "ssim": None, "lpips": None}
    if ground_truth is not None:
        estimate = pose_reader(model.field, ground_truth.t)(state.pose)
        at_end = trajectory_error.pose_errors(estimate, ground_truth.T_world_cam)
        at_start = trajectory_error.pose_errors(ground_truth.T_start, ground_truth.T_world_cam)
        extent = problem.metadata["extent"]
        numbers = pose_numbers(at_end, extent) | {"start": pose_numbers(at_start, extent)}
        numbers["constant_rotation_error_deg"] = constant_rotation_deg(
            trajectory_error.align(at_end.alignment, estimate), ground_truth.T_world_cam
        )
        to_truth = at_end.alignment
        if recording.held_out is not None:
            to_estimate = trajectory_error.procrustes(ground_truth.T_world_cam, estimate)
            poses = trajectory_error.align(to_estimate, recording.held_out.T_world_cam)
            views = _seen(look(recording.held_out.camera), scene, recording.held_out, poses, model, on_update)
            seen = _alike(views)
    numbers |= seen
    frames = []
    if recording.frames is not None:
        inside = (recording.frames.t >= problem.span[0]) & (recording.frames.t <= problem.span[1])
        photographs = take(recording.frames, np.flatnonzero(inside))
        if len(photographs.t):
            poses = pose_reader(model.field, photographs.t)(state.pose)
            frames = _seen(look(recording.camera), scene, photographs, poses, model, on_update)
            numbers["frames"] = _alike(frames)
    if problem.slides:
        numbers["displacement"] = _displacement(
            problem, model, state, scene, ground_truth, look(recording.camera)
        )
    return Measured(numbers, views, frames, at_start, at_end, to_truth)


def constant_rotation_deg(
    estimate: Float[np.ndarray, "m 4 4"], ground_truth: Float[np.ndarray, "m 4 4"]
) -> float:
    """Angle of the mean turn from true to estimated orientations, in camera axes: a wrong axis leaves it."""
    turns = np.swapaxes(ground_truth[:, :3, :3], 1, 2) @ estimate[:, :3, :3]
    return float(np.degrees(Rotation.from_matrix(turns).mean().magnitude()))


def corrected(
    rendered: Float[np.ndarray, "n h w 3"], ground_truth: Float[np.ndarray, "n h w 3"], offset: float
) -> Float[np.ndarray, "n h w 3"]:
    """Renders in [0, 1] whose log intensity is mapped to ground truth's by a slope and an offset per colour.

    Events tell changes only: brightness and contrast of what is made from them are not known. Least squares
    over all views (EventNeRF, Rudnev et al. 2023).
    """
    result = np.empty_like(rendered)
    for colour in range(3):
        x, y = (log_intensity(images[..., colour], offset).ravel() for images in (rendered, ground_truth))
        slope, level = np.polynomial.polynomial.polyfit(x, y, 1)[::-1] if np.ptp(x) > 0 else (0.0, y.mean())
        intensity = np.exp(slope * x + level) - offset
        result[..., colour] = np.clip(intensity, 0, 1).reshape(ground_truth.shape[:3]) ** (1 / GAMMA)
    return result


def _seen(
    image: RenderImage,
    scene: Any,
    photographs: Photographs,
    poses: Float[np.ndarray, "n 4 4"],
    model: Model,
    on_update: OnUpdate,
) -> list[HeldOut]:
    """What the scene shows from poses beside photographs, its log intensity corrected to theirs."""
    rendered = []
    for number, T in enumerate(poses):
        on_update(Update("rendering views", number, len(poses), "views"))
        rendered.append(jax.block_until_ready(image(scene, jnp.asarray(T, jnp.float32))))
    rgb = np.clip(np.stack([np.asarray(colour, np.float64) for colour, _ in rendered]), 0, 1)
    rgb = corrected(rgb, photographs.rgb / 255, model.train.offset)
    return [
        HeldOut(name, photograph, colour, np.asarray(depth, np.float64))
        for name, photograph, colour, (_, depth) in zip(
            photographs.files, photographs.rgb, rgb, rendered, strict=True
        )
    ]


def _alike(views: list[HeldOut]) -> dict[str, float | None]:
    return means([image_metrics(view.rendered_rgb, view.rgb / 255) for view in views])


def _displacement(
    problem: Problem,
    model: Model,
    state: State,
    scene: Any,
    ground_truth: GroundTruth | None,
    image: RenderImage,
) -> dict[str, Any]:
    """The direction of a short motion against ground truth's, and contrasts along multiples of the motion.

    Events are carried by the scene's own depth from the middle of the time.
    """
    first, last = problem.span
    ends = np.array([first, (first + last) / 2, last])
    T_first, T_middle, T_last = pose_reader(model.field, ends)(state.pose)
    displacement = T_middle[:3, :3].T @ (T_last[:3, 3] - T_first[:3, 3])
    recording = problem.recording
    _, depth = image(scene, jnp.asarray(T_middle, jnp.float32))
    nearness = 1 / np.maximum(np.asarray(depth), 1e-3)[recording.events.y, recording.events.x]
    located = contrast.locate(recording.camera, recording.events)
    contrast_of = jax.jit(
        lambda displacement: jnp.var(
            contrast.warped(recording.camera, located, jnp.asarray(nearness), displacement / (last - first))
        )
    )
    result: dict[str, Any] = {
        "displacement": displacement,
        "contrasts": [
            {"multiple": k, "contrast": float(contrast_of(jnp.asarray(k * displacement, jnp.float32)))}
            for k in _MULTIPLES
        ],
    }
    if ground_truth is None:
        return result
    T_true = ground_truth.T_world_cam
    true_displacement = T_true[len(T_true) // 2, :3, :3].T @ (T_true[-1, :3, 3] - T_true[0, :3, 3])
    begins = problem.start.T[-1, :3, 3] - problem.start.T[0, :3, 3]
    return result | {
        "direction_error_deg": _angle_deg(displacement, true_displacement),
        "start_direction_error_deg": _angle_deg(begins, true_displacement),
    }


def _angle_deg(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    return float(np.degrees(vector_angle(a, b)))
