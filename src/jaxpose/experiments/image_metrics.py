"""How good trainings on photographs and on events are, in numbers that both report."""

import numpy as np
from jaxtyping import Bool, Float

from jaxpose.evaluation import image_quality
from jaxpose.evaluation.image_quality import lpips, ssim
from jaxpose.evaluation.trajectory_error import PoseErrors

POSE_NUMBERS = (
    "rotation_error_deg",
    "translation_error",
    "translation_error_percent",
    "centre_error",
    "centre_error_percent",
)


def pose_numbers(errors: PoseErrors, extent: float) -> dict[str, float]:
    """Means of pose errors; translations also in percent of the cameras' extent."""
    values = (
        errors.rotation_deg,
        errors.translation,
        100 * errors.translation / extent,
        errors.centre,
        100 * errors.centre / extent,
    )
    return dict(zip(POSE_NUMBERS, values, strict=True))


def image_metrics(
    rendered: Float[np.ndarray, "h w 3"],
    reference: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> dict[str, float | None]:
    """How alike two images in [0, 1] are; LPIPS is None without its weights, and for small images.

    Where pixels do not count by the mask, PSNR leaves them out, and the others see the reference.
    """
    if mask is not None and not mask.any():
        return {"psnr": None, "ssim": None, "lpips": None}
    counted = slice(None) if mask is None else mask
    rendered_whole = rendered if mask is None else np.where(mask[..., None], rendered, reference)
    return {
        "psnr": image_quality.psnr(rendered[counted], reference[counted]),
        "ssim": ssim(rendered_whole, reference),
        "lpips": lpips(rendered_whole, reference),
    }


def means(views: list[dict[str, float | None]]) -> dict[str, float | None]:
    """Means over views; None where a number could not be had."""
    columns = {name: [view[name] for view in views] for name in views[0]}
    return {
        name: None if None in values else float(np.mean([v for v in values if v is not None]))
        for name, values in columns.items()
    }
