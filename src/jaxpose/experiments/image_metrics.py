"""How good trainings on photographs and on events are, in numbers that both report."""

import numpy as np
from jaxtyping import Float

from jaxpose.evaluation import image_quality
from jaxpose.evaluation.image_quality import lpips, ssim
from jaxpose.evaluation.trajectory_error import PoseErrors


def pose_numbers(errors: PoseErrors, extent: float) -> dict[str, float]:
    """Means of pose errors; translations also in percent of the cameras' extent."""
    return {
        "rotation_error_deg": errors.rotation_deg,
        "translation_error": errors.translation,
        "translation_error_percent": 100 * errors.translation / extent,
        "centre_error": errors.centre,
        "centre_error_percent": 100 * errors.centre / extent,
    }


def image_metrics(
    rendered: Float[np.ndarray, "h w 3"], reference: Float[np.ndarray, "h w 3"]
) -> dict[str, float | None]:
    """How alike two images in [0, 1] are; LPIPS is None without its weights, and for small images."""
    return {
        "psnr": image_quality.psnr(rendered, reference),
        "ssim": ssim(rendered, reference),
        "lpips": lpips(rendered, reference),
    }


def means(views: list[dict[str, float | None]]) -> dict[str, float | None]:
    """Means over views; None where a number could not be had."""
    columns = {name: [view[name] for view in views] for name in views[0]}
    return {
        name: None if None in values else float(np.mean([v for v in values if v is not None]))
        for name, values in columns.items()
    }
