"""Pictures of a radiance field and its poses: cameras in 3D, held-out views, errors over the steps."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from jaxpose.evaluation.image_quality import psnr
from jaxpose.plots.style import (
    AXES,
    DPI,
    ESTIMATE,
    GROUND_TRUTH,
    LOST,
    SENSOR,
    STYLE,
    gapped,
    save,
    view_axes,
)

_TICK = 0.13  # length of a drawn frustum, in extents of the true cameras
_IN_ORDER = {"projection": "3d", "computed_zorder": False}  # what is drawn later is in front
_FARTHEST = 4.0  # median depths that have colours of their own
_MOST_FRUSTA = 30
_PATH_STEP = 0.4  # from view to view, in extents; cameras that jump farther are on no path
_WORST = 0.3  # colour difference at the end of its scale
_RUNS = (ESTIMATE, LOST, SENSOR, "#5b8c5a", "#7d5ba6", "#3d3d3d")


class HeldOut(NamedTuple):
    """A photograph that the scene was not fitted to, beside what the scene shows from its pose."""

    label: str
    rgb: UInt8[np.ndarray, "h w 3"]
    rendered_rgb: Float[np.ndarray, "h w 3"]  # in [0, 1]
    rendered_depth: Float[np.ndarray, "h w"]  # [scene units], 0 or NaN where there is none


class History(NamedTuple):
    """What a run reported as it went; NaN where something was not measured."""

    steps: Int[np.ndarray, " n"]
    loss: Float[np.ndarray, " n"]
    psnr: Float[np.ndarray, " n"]  # [dB]
    rotation_deg: Float[np.ndarray, " n"]
    translation: Float[np.ndarray, " n"]


def cameras(
    path: Path | str,
    ground_truth: Float[np.ndarray, "n 4 4"] | None,
    start: Float[np.ndarray, "n 4 4"],
    estimate: Float[np.ndarray, "n 4 4"],
    title: str,
) -> None:
    """Cameras in 3D: start and ground truth on the left, estimate and ground truth on the right.

    A line joins each camera with its true place; of many cameras only some are drawn as frusta. Upright is
    the world axis nearest to the cameras' mean up.

    Args:
        path: PNG to write.
        ground_truth: camera-to-world poses [scene units]; None: not known, so not drawn.
        start: poses before a training, aligned as their errors were computed.
        estimate: poses after it, aligned in the same way.
        title: of the figure.
    """
    place = estimate if ground_truth is None else ground_truth
    across, along, up, sign = view_axes(place)
    order = [across, along, up]
    if np.linalg.det(np.eye(3)[order]) * sign < 0:
        order[:2] = along, across  # or the picture would be a mirror image
    centres = place[:, :3, 3]
    extent = float(np.linalg.norm(centres - centres.mean(0), axis=1).max()) or 1.0
    length = _TICK * extent
    is_path = np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)) < _PATH_STEP * extent
    shown = slice(None, None, -(-len(place) // _MOST_FRUSTA))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 5.4), dpi=DPI, layout="constrained")
        panels: list[Any] = list(figure.subplots(1, 2, subplot_kw=_IN_ORDER))
        for axes, poses, color, name in zip(
            panels, (start, estimate), (LOST, ESTIMATE), ("start", "estimate"), strict=True
        ):
            drawn = [(poses, color, 0.9)]
            if ground_truth is not None:
                joints = np.stack([poses[:, order, 3], ground_truth[:, order, 3]], axis=1)
                joints = joints if is_path else joints[shown]
                axes.add_collection3d(Line3DCollection(list(joints), colors=color, lw=0.8, alpha=0.35))
                drawn.insert(0, (ground_truth, GROUND_TRUTH, 1.7))
            for T, shade, width in drawn:
                if is_path:
                    axes.plot(*T[:, order, 3].T, color=shade, lw=width)
                edges = _frusta(T[shown], length)[..., order]
                axes.add_collection3d(Line3DCollection(list(edges), colors=shade, lw=width))
            axes.set(title=name if ground_truth is None else f"{name} and ground truth")
        _equal_axes(panels, np.concatenate([place, start, estimate])[:, order, 3], length, sign < 0)
        for axes in panels:
            axes.set(xlabel=AXES[order[0]], ylabel=AXES[order[1]], zlabel=AXES[order[2]])
            axes.view_init(elev=28, azim=-58)
            axes.tick_params(labelsize=7)
            axes.locator_params(nbins=5)
        colors = {"start": LOST, "estimate": ESTIMATE}
        if ground_truth is not None:
            colors = {"ground truth": GROUND_TRUTH, **colors}
        keys = [Line2D([], [], color=color, lw=1.6, label=name) for name, color in colors.items()]
        figure.legend(handles=keys, loc="outside lower center", ncols=3)
        figure.suptitle(title)
        save(figure, path)


def held_out(
    path: Path | str, views: Sequence[HeldOut], title: str, *, photograph: str = "held-out photograph"
) -> None:
    """Photograph, render, depth and colour difference side by side, one row a view.

    Args:
        path: PNG to write.
        views: of which the first four are drawn.
        title: of the figure.
        photograph: title of the first column.
    """
    views = views[:4]
    depths = np.concatenate([view.rendered_depth.ravel() for view in views])
    depths = depths[(depths > 0) & np.isfinite(depths)]
    # Rays that see very far, as through a scene that never ends, would take the colours from all others.
    near, middle, far = np.percentile(depths, (2, 50, 95)) if len(depths) else (0.0, 1.0, 1.0)
    far = min(far, _FARTHEST * middle)
    height, width = views[0].rendered_depth.shape
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(11, 1.1 + len(views) * (10.6 / 4 * height / width + 0.06)), dpi=DPI, layout="constrained"
        )
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.045)  # type: ignore[union-attr]
        cells = figure.add_gridspec(len(views) + 1, 4, height_ratios=[1] * len(views) + [0.04])
        shades: list[Any] = []
        for number, view in enumerate(views):
            row = [figure.add_subplot(cells[number, k]) for k in range(4)]
            for axes, name in zip(row, (photograph, "render", "depth", "colour difference"), strict=True):
                axes.set(xticks=[], yticks=[], title=name if number == 0 else None)
                axes.grid(False)
                axes.spines[:].set_visible(False)
            rendered = np.clip(view.rendered_rgb, 0, 1)
            depth = np.where(view.rendered_depth > 0, view.rendered_depth, np.nan)
            difference = np.abs(rendered - view.rgb / 255).mean(-1)
            row[0].imshow(view.rgb)
            row[1].imshow(rendered)
            shades = [
                row[2].imshow(depth, cmap=gapped("viridis"), vmin=near, vmax=far),
                row[3].imshow(difference, cmap="magma", vmin=0, vmax=_WORST),
            ]
            row[0].set_ylabel(view.label)
            _note(row[3], f"PSNR {psnr(rendered, view.rgb / 255):.2f} dB")
        for shade, column, label in zip(
            shades, (2, 3), ("depth [scene units], grey: none", "mean of |difference|, of 1"), strict=True
        ):
            bar = figure.add_subplot(cells[-1, column])
            figure.colorbar(shade, cax=bar, orientation="horizontal", label=label)
        figure.suptitle(title)
        save(figure, path)


def curves(
    path: Path | str, runs: Mapping[str, History], title: str, *, translation_unit: str = "scene units"
) -> None:
    """Loss, PSNR and pose errors over the steps; errors and loss on logarithmic scales.

    Args:
        path: PNG to write.
        runs: one line each, by label.
        title: of the figure.
        translation_unit: of the translation errors.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 6), dpi=DPI, layout="constrained")
        panels: list[Axes] = list(np.asarray(figure.subplots(2, 2, sharex=True)).ravel())
        labels = ("loss", "PSNR [dB]", "rotation error [deg]", f"translation error [{translation_unit}]")
        for k, (axes, label) in enumerate(zip(panels, labels, strict=True)):
            for number, (name, run) in enumerate(runs.items()):
                values = np.asarray(run[1 + k])
                known = np.isfinite(values)
                marker = "o" if known.sum() < 40 else None
                color = _RUNS[number % len(_RUNS)]
                axes.plot(
                    run.steps[known], values[known], color=color, lw=1.3, marker=marker, ms=3, label=name
                )
            axes.set(ylabel=label)
            if k != 1 and any((run[1 + k] > 0).any() for run in runs.values()):
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axes.yaxis.set_minor_formatter(NullFormatter())
            if k > 1:
                axes.set(xlabel="step")
        if len(runs) > 1:
            handles = panels[0].get_legend_handles_labels()
            figure.legend(*handles, loc="outside lower center", ncols=min(len(runs), 4))
        figure.suptitle(title)
        save(figure, path)


def _equal_axes(
    panels: Sequence[Any], points: Float[np.ndarray, "n 3"], margin: float, upside_down: bool
) -> None:
    """Limits that hold all points in every panel, a unit equally long on all axes."""
    points = points[np.isfinite(points).all(1)]
    centre, half = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0) / 2 + margin
    half = np.maximum(half, 0.4 * half.max())  # flat paths need air for the labels
    lower, upper = centre - half, centre + half
    for axes in panels:
        axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]))
        axes.set_zlim((upper[2], lower[2]) if upside_down else (lower[2], upper[2]))
        axes.set_box_aspect(half, zoom=0.97)


def _frusta(T_world_cam: Float[np.ndarray, "n 4 4"], length: float) -> Float[np.ndarray, "m 2 3"]:
    """The edges of a small pyramid per camera, from its centre to the corners of its image."""
    corners = length * np.array([[-0.5, -0.4, 1], [0.5, -0.4, 1], [0.5, 0.4, 1], [-0.5, 0.4, 1]])
    centres = T_world_cam[:, None, :3, 3]
    points = centres + np.einsum("nij,kj->nki", T_world_cam[:, :3, :3], corners)
    spokes = np.stack([np.broadcast_to(centres, points.shape), points], axis=2)
    frame = np.stack([points, np.roll(points, -1, axis=1)], axis=2)
    edges = np.concatenate([spokes, frame], axis=1).reshape(-1, 2, 3)
    return edges[np.isfinite(edges).all((1, 2))]


def _note(axes: Axes, text: str) -> None:
    axes.text(
        0.02, 0.03, text, transform=axes.transAxes, fontsize=7.5,
        bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5},
    )  # fmt: skip
