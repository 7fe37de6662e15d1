"""What the noisy-pose experiment says: a bar while it trains, then numbers with their protocol."""

import math
from pathlib import Path
from typing import Any

from jaxpose.experiments import training_loop
from jaxpose.experiments.command import markdown_table, number
from jaxpose.experiments.training_loop import OnProgress, Progress

_COLUMNS: tuple[str, ...] = (
    "run", "RE [deg]", "TE [units]", "TE [%]", "centres [%]", "PSNR [dB]", "SSIM", "LPIPS", "train [s]",
)  # fmt: skip


def progress_bar() -> OnProgress:
    """A callback for `run` that draws a bar on stderr for each training."""

    def describe(progress: Progress) -> dict[str, str]:
        off = f"{progress.rotation_deg:.2f} deg {100 * progress.translation / progress.extent:.2f}%"
        psnr = f"{-10 * math.log10(progress.loss):.2f} dB"
        return {"loss": f"{progress.loss:.5f}", "PSNR": psnr, "off": off}

    return training_loop.progress_bar(describe)


def table(runs: dict[str, dict[str, Any]]) -> str:
    """Results side by side, in Markdown."""
    rows = [_COLUMNS] + [
        (
            label,
            f"{run['rotation_error_deg']:.3f}",
            f"{run['translation_error']:.4f}",
            f"{run['translation_error_percent']:.3f}",
            f"{run['centre_error_percent']:.3f}",
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
    runs = results.get("runs") or {results["training"]["pose"] if "training" in results else "": results}
    one = next(iter(runs.values()))
    data, training, start, protocol = one["data"], one["training"], one["start"], one["protocol"]
    width, height = data["size"]
    smoke = "  SMOKE RUN, the numbers mean nothing" if results["smoke"] else ""
    settled = {label: run["settled"] for label, run in runs.items() if run["settled"]}
    lines = [
        f"noisy_nerf: {data['data']}, {data['images']} views of {width}x{height}, "
        f"preset {training['preset']}, {training['steps']} steps of {training['rays']} rays x "
        f"{training['samples']} samples, seed {results['seed']}{smoke}",
        *(f"  note         {note}" for note in data["notes"]),
        f"  noise        {data['noise']}:",
        f"               {start['rotation_error_deg']:.2f} deg, {start['translation_error_percent']:.2f}% "
        f"(centres {start['centre_error_percent']:.2f}%) at the start",
        "",
        table(runs),
        "",
        f"  RE           {protocol['rotation_error_deg']}",
        f"  TE           {protocol['translation_error']}; in percent of the cameras' extent, "
        f"{data['extent']:.3g}",
        f"  alignment    {protocol['alignment']}",
        f"  PSNR ...     {protocol['psnr, ssim, lpips']}",
        *(
            f"  settled      {label}: PSNR {run['psnr']:.2f} dB, SSIM {run['ssim']:.3f}, "
            f"LPIPS {number(run['lpips'], 3)}"
            for label, run in settled.items()
        ),
        f"  cost         {results['wall_s']:.0f} s in all, "
        f"{results['peak_rss_bytes'] / 2**30:.2f} GiB of memory at most",
        f"  written to   {folder}",
    ]
    return "\n".join(lines)
