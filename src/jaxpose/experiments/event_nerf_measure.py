"""How good a training on events is: pose errors over the motion, held-out views after a correction."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxpose import metrics, nerf
from jaxpose.events import GAMMA, log_intensity
from jaxpose.experiments.event_nerf_options import Problem
from jaxpose.experiments.event_nerf_setup import Setup
from jaxpose.experiments.joint_loop import pose_reader
from jaxpose.experiments.noisy_nerf_measure import pose_numbers
from jaxpose.fields import set_progress
from jaxpose.metrics import PoseErrors
from jaxpose.metrics_image import lpips, ssim
from jaxpose.nerf import TrainConfig
from jaxpose.plots_nerf import HeldOut
from jaxpose.train import State

_MOST_POSES = 200  # at which errors are measured
PROTOCOL = {
    "alignment": "similarity that maps estimated camera centres to the true ones (scale: ratio of spreads)",
    "rotation_error_deg": "angle to the true orientation after alignment, mean over at most 200 true poses "
    "evenly over the motion",
    "translation_error": "distance of world-to-camera translation vectors after alignment, mean over the "
    "same, as BARF defines it [scene units]",
    "centre_error": "distance of camera centres after alignment, mean over the same [scene units]",
    "psnr, ssim, lpips": "mean over the held-out views, their true poses brought into the estimate's frame "
    "by the alignment, no test-time optimisation; first slope and offset of log intensity are fitted for "
    "each colour over all views, as EventNeRF does",
}


class Measured(NamedTuple):
    """The numbers, the held-out views to draw, and errors over time."""

    numbers: dict[str, Any]
    views: list[HeldOut]
    t: Float[np.ndarray, " m"]
    at_start: PoseErrors
    at_end: PoseErrors
    T_estimate: Float[np.ndarray, "k 4 4"]  # at all the recording's stamps, aligned with the truth


def some(count: int) -> np.ndarray:
    """Which of so many poses are measured."""
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_POSES)).round().astype(int))


def measure(problem: Problem, setup: Setup, state: State) -> Measured:
    """Errors of the trained trajectory, and of what the scene shows from held-out poses."""
    recording = problem.recording
    at = some(len(recording.t))
    truth = recording.T_world_cam[at]
    T_world_cam = pose_reader(setup.field, recording.t)(state.pose)
    errors = metrics.pose_errors(T_world_cam[at], truth)
    at_start = metrics.pose_errors(problem.T_start[at], truth)
    views, seen = _held_out(problem, setup, state, truth, T_world_cam[at])
    numbers = {
        **pose_numbers(errors, problem.extent),
        **seen,
        "start": pose_numbers(at_start, problem.extent),
    }
    aligned = metrics.align(errors.alignment, T_world_cam)
    return Measured(numbers, views, recording.t[at], at_start, errors, aligned)


def corrected(
    rendered: Float[np.ndarray, "n h w 3"], truth: Float[np.ndarray, "n h w 3"], offset: float
) -> Float[np.ndarray, "n h w 3"]:
    """Renders in [0, 1] whose log intensity is mapped to the truth's by a slope and an offset per colour.

    Events tell changes only: brightness and contrast of what is made from them are not known. Least squares
    over all views (EventNeRF, PEERS B4).
    """
    result = np.empty_like(rendered)
    for colour in range(3):
        x, y = (log_intensity(images[..., colour], offset).ravel() for images in (rendered, truth))
        slope, level = np.polynomial.polynomial.polyfit(x, y, 1)[::-1] if np.ptp(x) > 0 else (0.0, y.mean())
        intensity = np.exp(slope * x + level) - offset
        result[..., colour] = np.clip(intensity, 0, 1).reshape(truth.shape[:3]) ** (1 / GAMMA)
    return result


def _held_out(
    problem: Problem,
    setup: Setup,
    state: State,
    truth: Float[np.ndarray, "m 4 4"],
    estimate: Float[np.ndarray, "m 4 4"],
) -> tuple[list[HeldOut], dict[str, float | None]]:
    held_out = problem.recording.held_out
    if held_out is None:
        return [], {"psnr": None, "ssim": None, "lpips": None}
    to_estimate = metrics.procrustes(truth, estimate)
    config = TrainConfig(steps=1, rays=1, samples=2 * setup.train.samples, chunk=64)
    viewer = nerf.viewer(
        setup.scene, held_out.camera, setup.depths, config, background=problem.background
    )  # fmt: skip
    scene = set_progress(state.scene, jnp.ones(()))
    rendered = [
        viewer.image(scene, jnp.asarray(T, jnp.float32))
        for T in metrics.align(to_estimate, held_out.T_world_cam)
    ]
    photographs = held_out.rgb / 255
    rgb = np.clip(np.stack([np.asarray(colour, np.float64) for colour, _ in rendered]), 0, 1)
    rgb = corrected(rgb, photographs, setup.train.offset)
    views = [
        HeldOut(name, photograph, image, np.asarray(depth, np.float64))
        for name, photograph, image, (_, depth) in zip(
            held_out.files, held_out.rgb, rgb, rendered, strict=True
        )
    ]
    pairs = list(zip(rgb, photographs, strict=True))
    perceptual = [value for image, photograph in pairs if (value := lpips(image, photograph)) is not None]
    return views, {
        "psnr": float(np.mean([metrics.psnr(*pair) for pair in pairs])),
        "ssim": float(np.mean([ssim(*pair) for pair in pairs])),
        "lpips": float(np.mean(perceptual)) if perceptual else None,
    }
