"""What the event experiment prints: progress, then numbers with their protocol."""

from pathlib import Path
from typing import Any

from jaxpose.experiments.devices import follower_report
from jaxpose.experiments.outcome import SMOKE, cost_text, markdown_table, number

_COLUMNS: tuple[str, ...] = (
    "run", "RE start", "RE [deg]", "TE start", "TE [units]", "TE [%]", "PSNR [dB]", "SSIM", "LPIPS",
    "train [s]",
)  # fmt: skip


def describe_step(loss: float, rotation_deg: float, translation: float) -> dict[str, str]:
    """Where a training is, in words.

    Args:
        loss: of the events.
        rotation_deg: mean rotation error [deg].
        translation: mean translation error [scene units].

    Returns:
        The words by their names.
    """
    return {"loss": f"{loss:.5f}", "off": f"{rotation_deg:.2f} deg {translation:.4f} units"}


def table(runs: dict[str, dict[str, Any]]) -> str:
    """Results side by side, in Markdown; n/a where there is nothing to compare with."""
    rows = [_COLUMNS] + [
        (
            label,
            number(run.get("start", {}).get("rotation_error_deg"), 3),
            number(run.get("rotation_error_deg"), 3),
            number(run.get("start", {}).get("translation_error"), 4),
            number(run.get("translation_error"), 4),
            number(run.get("translation_error_percent"), 3),
            number(run["psnr"], 2),
            number(run["ssim"], 3),
            number(run["lpips"], 3),
            f"{run['train_s']:.0f}",
        )
        for label, run in runs.items()
    ]
    return markdown_table(rows)


def report(folder: Path, results: dict[str, Any]) -> str:
    """The numbers of a run with their protocol, and where everything is."""
    if "process" in results:
        return follower_report(results)
    runs = results.get("runs") or {results["training"]["pose"]: results}
    one = next(iter(runs.values()))
    data, training, protocol = one["data"], one["training"], one["protocol"]
    width, height = data["size"]
    smoke = SMOKE if results["smoke"] else ""
    lines = [
        f"event_nerf: {data['data']}, {data['events']} events of {width}x{height} ({data['mosaic']}) in "
        f"{data['span_s']:.3g} s, preset {training['preset']}, {training['steps']} steps of "
        f"{training['events']} events x {training['samples']} samples, {training['loss']} loss, "
        f"threshold {training['threshold']:g}, seed {results['seed']}{smoke}",
        *(f"  note         {note}" for note in data["notes"]),
        *(f"  poses        {label}: {run['data']['poses']}" for label, run in runs.items()),
        "",
        table(runs),
        "",
        f"  RE           {protocol['rotation_error_deg']}",
        f"  TE           {protocol['translation_error']}; in percent of the cameras' extent, "
        f"{data['extent']:.3g}",
        f"  alignment    {protocol['alignment']}",
        f"  PSNR ...     {protocol['image_metrics']}",
        *(line for run in runs.values() for line in _more(run)),
        f"  cost         {cost_text(results)}",
        f"  written to   {folder}",
    ]
    return "\n".join(lines)


def _more(run: dict[str, Any]) -> list[str]:
    """What only some data have: the camera's own images, a motion that was not known."""
    lines = []
    if "axis wrong" in run["data"]["poses"]:
        lines.append(
            f"  axis         off by {run['constant_rotation_error_deg']:.2f} deg as found (mean turn)"
        )
    sensor = run["data"]["sensor"]
    if sensor["dead_time_s"] is not None:
        lines.append(
            f"  dead time    {1e3 * sensor['dead_time_s']:.2f} ms of a pixel after an event, at most"
        )
    if sensor["threshold_spread"] is not None:
        lines.append(
            f"  thresholds   spread {100 * sensor['threshold_spread']:.1f}% over pixels, by their balance"
        )
    turned = run["data"]["turned_by_deg"]
    if turned is not None:
        lines.append(
            f"  turned       all cameras by {turned:.2f} deg about their y axes, by contrast of events"
        )
    if "frames" in run:
        frames = run["frames"]
        lines.append(
            f"  frames       PSNR {frames['psnr']:.2f} dB, SSIM {frames['ssim']:.3f} beside the camera's own"
        )
    if "displacement" in run:
        found = run["displacement"]
        contrasts = ", ".join(f"{at['contrast']:.2f} at {at['multiple']:g}" for at in found["contrasts"])
        lines.append(f"  contrast     of events warped along multiples of the motion found: {contrasts}")
        if "direction_error_deg" in found:
            lines.append(
                f"  direction    {found['direction_error_deg']:.2f} deg from the true one, "
                f"{found['start_direction_error_deg']:.2f} at the start"
            )
    return lines
