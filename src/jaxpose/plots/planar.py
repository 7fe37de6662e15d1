"""Pictures of planar alignment: the image that was found with its patches, and corner errors over steps."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxpose.plots.style import DPI, ESTIMATE, LOST, STYLE, save

_GROUND_TRUTH, _START, _ESTIMATE = "#ffffff", "#f5c518", "#35c8f5"  # over a photograph, not over paper
_FIELDS = {"posenet": ESTIMATE, "per_frame": "#e0902f", "spline_reset": "#b5322d", "bspline": "#5a9e5a"}
_FLOOR = 1e-4  # [px] of a logarithmic axis


def reconstruction(
    path: Path | str,
    photograph: Float[np.ndarray, "h w 3"],
    found: Float[np.ndarray, "h w 3"],
    covered: Bool[np.ndarray, "h w"],
    outlines: Mapping[str, Float[np.ndarray, "n 4 2"]],
    title: str,
) -> None:
    """A photograph with the outlines of its patches beside the image that was found with them.

    Args:
        path: PNG to write.
        photograph: colours in [0, 1].
        found: colours in [0, 1].
        covered: pixels that a patch covers; the others, of which nothing is known, are faded in both.
        outlines: corners [px] of the patches, under the names ground_truth, start and estimate.
        title: of the figure.
    """
    fade = np.where(covered, 1.0, 0.3)[..., None]
    height, width = photograph.shape[:2]
    colours = {"ground_truth": _GROUND_TRUTH, "start": _START, "estimate": _ESTIMATE}
    styles = {"ground_truth": (3.4, "solid"), "start": (2.2, "dashed"), "estimate": (1.3, "solid")}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12, 12 * 0.5 * height / width + 0.9), dpi=DPI, layout="constrained")
        left, right = figure.subplots(1, 2)
        for axes, picture, drawn, name in (
            (left, photograph, ("ground_truth", "estimate", "start"), "photograph, patches on it"),
            (right, found, ("estimate",), "image found, from the patches alone"),
        ):
            axes.imshow(np.clip(picture, 0, 1) * fade, interpolation="nearest")
            for key in drawn:
                lw, style = styles[key]
                axes.add_collection(
                    PolyCollection(
                        list(outlines[key] - 0.5), facecolors="none", edgecolors=colours[key], lw=lw, ls=style
                    )
                )
            axes.set(title=name, xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
            axes.grid(False)
        keys = [
            Line2D([], [], color=colours[k], lw=styles[k][0], ls=styles[k][1], label=k.replace("_", " "))
            for k in outlines
        ]
        legend = figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), frameon=True)
        legend.get_frame().set(facecolor="#6b6b6b", edgecolor="none")
        for text in legend.get_texts():
            text.set_color("white")
        figure.suptitle(title)
        save(figure, path)


def corner_errors(
    path: Path | str,
    steps: Float[np.ndarray, " c"],
    curves: Mapping[str, Float[np.ndarray, "m c"]],
    success_px: float,
    title: str,
) -> None:
    """Corner errors over steps: a thin line per motion, the median bold, a panel per pose field.

    Args:
        path: PNG to write.
        steps: at which errors are known.
        curves: errors [px] of each motion, by pose field.
        success_px: error below which a motion is found.
        title: of the figure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(max(6.0, 3.6 * len(curves)), 4.2), dpi=DPI, layout="constrained")
        panels: list[Axes] = list(figure.subplots(1, len(curves), sharey=True, squeeze=False)[0])
        for axes, (name, errors) in zip(panels, curves.items(), strict=True):
            colour = _FIELDS.get(name, ESTIMATE)
            shown = np.maximum(errors, _FLOOR)
            axes.plot(steps, shown.T, color=colour, lw=0.8, alpha=0.4)
            axes.plot(steps, np.median(shown, axis=0), color=colour, lw=2.4, label="median")
            axes.axhline(success_px, color=LOST, lw=1, ls="dashed", label=f"success: below {success_px:g} px")
            won = int((errors[:, -1] < success_px).sum())
            axes.set(yscale="log", xlabel="step", xlim=(steps[0], steps[-1]))
            axes.set_title(f"{name}: {won} of {len(errors)} motions")
        panels[0].set_ylabel("corner error [px]")
        panels[0].legend(loc="lower left")
        figure.suptitle(title)
        save(figure, path)
