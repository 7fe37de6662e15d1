"""What the event experiment says: a bar while it trains, then numbers with their protocol."""

from pathlib import Path
from typing import Any

from jaxpose.experiments import training_loop
from jaxpose.experiments.command import markdown_table, number
from jaxpose.experiments.training_loop import OnProgress, Progress

_COLUMNS: tuple[str, ...] = (
    "run", "RE start", "RE [deg]", "TE start", "TE [units]", "TE [%]", "PSNR [dB]", "SSIM", "LPIPS",
    "train [s]",
)  # fmt: skip


def progress_bar() -> OnProgress:
    """A callback for `run` that draws a bar on stderr for each training."""

    def describe(progress: Progress) -> dict[str, str]:
        off = f"{progress.rotation_deg:.2f} deg {progress.translation:.4f} units"
        return {"loss": f"{progress.loss:.5f}", "off": off}

    return training_loop.progress_bar(describe)


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
    runs = results.get("runs") or {results["training"]["pose"]: results}
    one = next(iter(runs.values()))
    data, training, protocol = one["data"], one["training"], one["protocol"]
    width, height = data["size"]
    smoke = "  SMOKE RUN, the numbers mean nothing" if results["smoke"] else ""
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
        f"  PSNR ...     {protocol['psnr, ssim, lpips']}",
        *(line for run in runs.values() for line in _beside(run)),
        f"  cost         {results['wall_s']:.0f} s in all, "
        f"{results['peak_rss_bytes'] / 2**30:.2f} GiB of memory at most",
        f"  written to   {folder}",
    ]
    return "\n".join(lines)


def _beside(run: dict[str, Any]) -> list[str]:
    """What only some data have: the camera's own images, a motion that was not known."""
    lines = []
    if "axis wrong" in run["data"]["poses"]:
        lines.append(
            f"  axis         off by {run['constant_rotation_error_deg']:.2f} deg as found (mean turn)"
        )
    if "frames" in run:
        frames = run["frames"]
        lines.append(
            f"  frames       PSNR {frames['psnr']:.2f} dB, SSIM {frames['ssim']:.3f} beside the camera's own"
        )
    if "slide" in run:
        slide = run["slide"]
        contrasts = ", ".join(f"{value:.2f} at {k}" for k, value in slide["contrast"].items())
        lines.append(f"  contrast     of events warped along multiples of the motion found: {contrasts}")
        if "direction_error_deg" in slide:
            lines.append(
                f"  direction    {slide['direction_error_deg']:.2f} deg from the true one, "
                f"{slide['start_direction_error_deg']:.2f} at the start"
            )
    return lines
