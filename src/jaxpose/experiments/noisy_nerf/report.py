"""What the noisy-pose experiment prints: progress, then numbers with their protocol."""

import math
from pathlib import Path
from typing import Any

from jaxpose.experiments.devices import follower_report
from jaxpose.experiments.outcome import SMOKE, cost_text, markdown_table, number

_COLUMNS: tuple[str, ...] = (
    "run", "RE [deg]", "TE [units]", "TE [%]", "centres [%]", "PSNR [dB]", "SSIM", "LPIPS", "train [s]",
)  # fmt: skip


def describe_step(extent: float, loss: float, rotation_deg: float, translation: float) -> dict[str, str]:
    """Where a training is, in words.

    Args:
        extent: largest distance between true cameras [scene units]; NaN where none is known.
        loss: mean squared colour error.
        rotation_deg: mean rotation error [deg].
        translation: mean translation error [scene units].

    Returns:
        The words by their names.
    """
    words = {"loss": f"{loss:.5f}", "PSNR": f"{-10 * math.log10(loss):.2f} dB"}
    if math.isfinite(extent):
        words["off"] = f"{rotation_deg:.2f} deg {100 * translation / extent:.2f}%"
    return words


def table(runs: dict[str, dict[str, Any]]) -> str:
    """Results side by side, in Markdown."""
    rows = [_COLUMNS] + [
        (
            label,
            number(run["rotation_error_deg"], 3),
            number(run["translation_error"], 4),
            number(run["translation_error_percent"], 3),
            number(run["centre_error_percent"], 3),
            number(run["psnr"], 2),
            number(run["ssim"], 3),
            number(run["lpips"], 3),
            f"{run['train_s']:.0f}",
        )
        for label, run in runs.items()
    ]
    return markdown_table(rows)


def _registered(found: dict[str, Any] | None) -> list[str]:
    """What features alone have found; nothing where they were not asked or too few."""
    if not found or not found["photographs"]:
        return []
    error = "" if found["rotation_error_deg"] is None else f": {found['rotation_error_deg']:.2f} deg"
    error = ": the poses of the data agree, and stay" if found["given_poses_kept"] else error
    stops = found["exposure_stops"]
    exposed = [f"  exposures    differ by {stops:.2f} stops: photographs are brought to one"] if stops else []
    off, stated = found["stated_off"], []
    if off is not None:
        wrong = "" if 0.5 < off < 2 else f": state {'larger' if off > 1 else 'smaller'} ones"
        stated = [f"  stated       poses are {off:.2f} times their sigmas off, by features{wrong}"]
    return [
        f"  features     place {found['photographs']} photographs by {found['points']} points, "
        f"{found['noise_px']:.2f} px{error}",
        *stated,
        *exposed,
    ]


def _sure(sigmas: dict[str, float] | None) -> list[str]:
    """How sure the poses are."""
    if sigmas is None:
        return []
    return [
        f"  sigmas       {sigmas['position']:.3g} scene units and {sigmas['rotation_deg']:.2g} deg an axis "
        f"(median): {sigmas['times_features']:.1f} times features' own, as colours have moved poses"
    ]


def report(folder: Path, results: dict[str, Any]) -> str:
    """The numbers of a run with their protocol, and where everything is."""
    if "process" in results:
        return follower_report(results)
    runs = results.get("runs") or {results["training"]["pose"] if "training" in results else "": results}
    one = next(iter(runs.values()))
    data, training, start, protocol = one["data"], one["training"], one["start"], one["protocol"]
    width, height = data["size"]
    smoke = SMOKE if results["smoke"] else ""
    refined = {label: run["test_time_refined"] for label, run in runs.items() if run["test_time_refined"]}
    at_start, share = [], ""
    if start["rotation_error_deg"] is not None:
        at_start = [
            f"               {start['rotation_error_deg']:.2f} deg, "
            f"{start['translation_error_percent']:.2f}% (centres {start['centre_error_percent']:.2f}%) "
            "at the start"
        ]
        share = f"; in percent of the cameras' extent, {data['extent']:.3g}"
    lines = [
        f"noisy_nerf: {data['data']}, {data['images']} views of {width}x{height}, "
        f"preset {training['preset']}, {training['steps']} steps of {training['rays']} rays x "
        f"{training['samples']} samples, seed {results['seed']}{smoke}",
        *(f"  note         {note}" for note in data["notes"]),
        f"  noise        {data['noise']}{':' if at_start else ''}",
        *at_start,
        *_registered(one.get("registration")),
        *_sure(one.get("sigmas")),
        "",
        table(runs),
        "",
        f"  RE           {protocol['rotation_error_deg']}",
        f"  TE           {protocol['translation_error']}{share}",
        f"  alignment    {protocol['alignment']}",
        f"  PSNR ...     {protocol['image_metrics']}",
        *(
            f"  refined      {label}: PSNR {run['psnr']:.2f} dB, SSIM {run['ssim']:.3f}, "
            f"LPIPS {number(run['lpips'], 3)}"
            for label, run in refined.items()
        ),
        *(
            f"  shutter      {label}: {run['shutter']['line_delay_us']:.1f} us a row, exposure "
            f"{run['shutter']['exposure_ms']:.2f} ms ({run['shutter']['shutter']})"
            for label, run in runs.items()
            if run["shutter"]["line_delay_us"] or run["shutter"]["exposure_ms"]
        ),
        f"  cost         {cost_text(results)}",
        f"  written to   {folder}",
    ]
    return "\n".join(lines)
