"""What the planar experiment prints: numbers with their protocol."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.experiments.outcome import SMOKE, cost_text, markdown_table, number
from jaxpose.experiments.planar import pyramid
from jaxpose.experiments.planar.options import Config
from jaxpose.experiments.planar.task import PATCHES, PROTOCOL, Photo
from jaxpose.experiments.planar.warps import RESET_EVERY, SPLINE_KNOTS, Warps

SUCCESS_PX = 1.0  # mean corner error below which a motion is found
_COLUMNS: tuple[str, ...] = (
    "pose",
    "success",
    "CE mean [px]",
    "CE median [px]",
    "CE range [px]",
    "PSNR mean [dB]",
    "s / motion",
)


def protocol(config: Config, photo: Photo, warps: Warps) -> dict[str, Any]:
    """How the numbers of a run came about, in words and numbers."""
    assert config.image is not None
    path, setup = config.image, config.setup
    height, width = photo.rgb.shape[:2]
    return {
        "image": path.name,
        "size": (width, height),
        "patches": PATCHES[setup],
        "patch_px": photo.crop,
        "motions": PROTOCOL[setup],
        "start": "the identity, that is the centre crop, for all patches",
        "reference_frame": "patch 0 is the centre crop in ground truth and in the estimate, the others are "
        "relative to it",
        "corner_error": "distance of the four warped corners from ground truth, mean over corners and over "
        "all patches but patch 0, whose error is zero by construction; no alignment afterwards",
        "success": f"corner error below {SUCCESS_PX:g} px",
        "psnr": "of all pixels of all patches, patch 0 included",
        **(_adam(config, warps) if config.preset == "paper" else _gauss_newton(photo)),
    }


def _adam(config: Config, warps: Warps) -> dict[str, Any]:
    rates = warps.rates if isinstance(warps.rates, dict) else {"pose": warps.rates}
    reset = f"every {RESET_EVERY} steps to the least-squares natural cubic spline with {SPLINE_KNOTS} knots"
    return {
        "image_found": "neural",
        "steps": config.steps,
        "points_per_patch_and_step": config.points,
        "rates": rates | {"image": 1e-3},
        "pose_rates_decay_to": warps.decay,
        "reset": "none" if warps.reset is None else reset,
    }


def _gauss_newton(photo: Photo) -> dict[str, Any]:
    return {
        "image_found": "pixels, bilinear between them as the patches were cut",
        "steps": pyramid.count(photo.crop),
        "blurs_px": pyramid.blurs(photo.crop),
    }


def summary(motions: list[dict[str, Any]]) -> dict[str, Any]:
    """The distribution of the motions' numbers, and the numbers themselves."""
    keys = ("motion", "corner_error_px", "start_corner_error_px", "psnr", "success", "seconds")
    found = [motion["success"] for motion in motions]
    return {
        "success_rate": sum(found) / len(found),
        "failures": [motion["motion"] for motion in motions if not motion["success"]],
        "corner_error_px": _spread(motions, "corner_error_px"),
        "start_corner_error_px": _spread(motions, "start_corner_error_px"),
        "psnr": _spread(motions, "psnr"),
        "seconds_per_motion": _spread(motions, "seconds"),
        "motions": [{key: motion[key] for key in keys} for motion in motions],
    }


def table(by_field: dict[str, dict[str, Any]]) -> str:
    """Results of several pose fields side by side, in Markdown."""
    rows = [_COLUMNS]
    for pose, results in by_field.items():
        error, count = results["corner_error_px"], len(results["motions"])
        rows.append((
            pose,
            f"{count - len(results['failures'])} of {count}",
            number(error["mean"], 3),
            number(error["median"], 3),
            f"{number(error['min'], 3)} to {number(error['max'], 3)}",
            number(results["psnr"]["mean"], 2),
            number(results["seconds_per_motion"]["median"], 1),
        ))  # fmt: skip
    return markdown_table(rows)


def report(folder: Path, results: dict[str, Any]) -> str:
    """The numbers of a run with their protocol, and where everything is."""
    by_field = results.get("fields", {results.get("pose"): results})
    one = next(iter(by_field.values()))
    about = one["protocol"]
    width, height = about["size"]
    smoke = SMOKE if results["smoke"] else ""
    start = one["start_corner_error_px"]
    patches = f"{about['patches']} patches of {about['patch_px']} px"
    return "\n".join([
        f"planar: {about['image']} {width}x{height}, {one['setup']} set-up, {patches}, "
        f"{len(one['motions'])} motions, preset {one['preset']}, {about['steps']} steps, "
        f"seed {results['seed']}{smoke}",
        "",
        table(by_field),
        "",
        f"  CE           {about['corner_error']};",
        f"               {number(start['mean'], 1)} px at the start, {number(start['min'], 1)} to "
        f"{number(start['max'], 1)}",
        f"  success      {about['success']}",
        f"  PSNR         {about['psnr']}",
        f"  cost         {cost_text(results)}; s / motion: median",
        f"  written to   {folder}",
    ])  # fmt: skip


def _spread(motions: list[dict[str, Any]], key: str) -> dict[str, float]:
    values = np.array([motion[key] for motion in motions], float)  # what is not finite is null in a file
    return {"mean": values.mean(), "median": np.median(values), "min": values.min(), "max": values.max()}
