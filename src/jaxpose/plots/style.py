"""The style that all pictures share, and what several of them draw."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxpose.files.atomic import atomic

DPI = 120
GROUND_TRUTH, ESTIMATE, LOST, SENSOR = "#8a8a8a", "#1f5fa8", "#d1342f", "#f0a860"
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
}
AXES = "xyz"
_ELLIPSES = 12  # of a trajectory
_CHI2_90 = 4.605  # of chi-squared of two numbers
_LARGEST, _LEAST = 0.05, 1e-12  # of the trajectory's extent, that ellipses are enlarged to; [m] of one


def save(figure: Figure, path: Path | str) -> None:
    """Write a figure as a PNG that appears whole or not at all.

    Args:
        figure: to draw.
        path: of the file.
    """
    with atomic(path) as temporary:
        figure.savefig(temporary)


def view_axes(poses: Float[np.ndarray, "n 4 4"]) -> tuple[int, int, int, int]:
    """The axes of a view from above and of one from the side.

    Args:
        poses: camera-to-world poses of cameras that are held upright.

    Returns:
        The wider and the narrower horizontal world axis, the vertical one, and the sign of up along it.
    """
    mean_up = -poses[:, :3, 1].mean(axis=0)  # y of a camera is down
    up = int(np.abs(mean_up).argmax())
    extent = np.ptp(poses[:, :3, 3], axis=0)
    across, along = sorted({0, 1, 2} - {up}, key=lambda k: -extent[k])
    return across, along, up, 1 if mean_up[up] >= 0 else -1


def paths(
    views: Sequence[Axes],
    estimate: Float[np.ndarray, "n 4 4"],
    reference: Float[np.ndarray, "n 4 4"] | None,
    distances: Float[np.ndarray, " n"] | None,
    lost: Bool[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n 6 6"] | None = None,
) -> LineCollection | None:
    """Draw camera centres from above and from the side.

    Args:
        views: two axes to draw in.
        estimate: poses, aligned with the reference.
        reference: ground truth, NaN where there is none; None: not drawn.
        distances: what colours the estimate; None: nothing does.
        lost: poses that are marked.
        covariance: of the poses, over increments [m, rad] on the right; ellipses around some of them hold
            90% of the places that it allows; None: none are drawn.

    Returns:
        What a colour bar is made from; None without distances.
    """
    ground_truth = estimate if reference is None else reference
    usable = np.isfinite(ground_truth).all(axis=(1, 2))
    across, along, up, sign = view_axes(ground_truth[usable])
    shade, keys = None, list[Line2D]()
    for axes, (a, b), name in zip(
        views, ((across, along), (across, up)), ("from above", "from the side"), strict=True
    ):
        centres = estimate[:, [a, b], 3]
        if reference is not None:
            axes.plot(*reference[usable][:, [a, b], 3].T, color=GROUND_TRUTH, lw=3.5, alpha=0.5)
        if distances is None:
            axes.plot(*centres.T, color=ESTIMATE, lw=1.4)
        else:
            shade = shaded_path(axes, centres, distances)
        axes.plot(*centres[0], "o", color="black", ms=5, zorder=4)
        axes.plot(*centres[lost].T, "x", color=LOST, ms=6, mew=1.6, zorder=5)
        axes.set(title=name, xlabel=f"{AXES[a]} [m]", ylabel=f"{AXES[b]} [m]")
        if covariance is not None:
            keys = _ellipses(axes, estimate, covariance, [a, b])
        axes.set_aspect("equal", adjustable="datalim")
        axes.autoscale_view()
    if sign < 0:
        views[1].invert_yaxis()
    handles = trajectory_legend(reference is not None, bool(lost.any())) + keys
    views[0].legend(handles=handles, loc="best")
    return shade


def _ellipses(
    axes: Axes, estimate: Float[np.ndarray, "n 4 4"], covariance: Float[np.ndarray, "n 6 6"], ab: list[int]
) -> list[Line2D]:
    """Draw ellipses of 90% along two world axes, larger by a power of ten that the legend's entry names."""
    some = np.linspace(0, len(estimate) - 1, min(_ELLIPSES, len(estimate))).round().astype(int)
    R = estimate[some, :3, :3]
    of_place = _CHI2_90 * R @ covariance[some, :3, :3] @ np.swapaxes(R, 1, 2)
    largest = math.sqrt(max(np.linalg.eigvalsh(of_place).max(), _LEAST**2))
    extent = np.ptp(estimate[:, :3, 3], axis=0).max()
    times = 10 ** math.floor(math.log10(max(_LARGEST * extent / largest, 1.0)))
    turn = np.linspace(0, 2 * np.pi, 49)
    squares, axis = np.linalg.eigh(of_place[np.ix_(range(len(some)), ab, ab)])
    rings = axis @ (times * np.sqrt(squares)[..., None] * np.stack([np.cos(turn), np.sin(turn)]))
    rings = estimate[some][:, ab, 3] + np.moveaxis(rings, -1, 0)
    axes.add_collection(
        LineCollection(list(np.moveaxis(rings, 0, 1)), colors="black", linewidths=0.8, zorder=4)
    )
    label = "90% ellipse" + f", {times} times as large" * (times > 1)
    return [Line2D([], [], color="black", marker="o", mfc="none", ls="", ms=7, mew=0.8, label=label)]


def shaded_path(
    axes: Axes, centres: Float[np.ndarray, "n 2"], values: Float[np.ndarray, " n"]
) -> LineCollection:
    """Draw a path coloured by a value at each of its points (their mean along each segment).

    Args:
        axes: to draw in.
        centres: points of the path.
        values: from 0 on, NaN where there is none.

    Returns:
        What a colour bar is made from.
    """
    segments = np.stack([centres[:-1], centres[1:]], axis=1)
    means = (values[:-1] + values[1:]) / 2
    shades = ListedColormap(matplotlib.colormaps["plasma_r"](np.linspace(0.15, 1, 256)))  # not the palest
    line = LineCollection(list(segments), cmap=shades, lw=2, zorder=3)
    line.set_array(means)
    finite = values[np.isfinite(values)]
    line.set_clim(0, float(finite.max()) if len(finite) else 1.0)
    axes.add_collection(line)
    return line


def trajectory_legend(ground_truth: bool, lost: bool) -> list[Line2D]:
    """Entries of the legend of a trajectory.

    Args:
        ground_truth: whether it is drawn too.
        lost: whether lost frames are marked.

    Returns:
        An entry for everything that is drawn.
    """
    keys = (
        [Line2D([], [], color=GROUND_TRUTH, lw=3.5, alpha=0.5, label="ground truth")] if ground_truth else []
    )
    keys.append(Line2D([], [], color="#9c2c8c" if ground_truth else ESTIMATE, lw=2, label="estimate"))
    keys.append(Line2D([], [], color="black", marker="o", ls="", ms=5, label="start"))
    if lost:
        keys.append(Line2D([], [], color=LOST, marker="x", ls="", mew=1.6, label="lost"))
    return keys


def gapped(name: str):
    """A colour map that shows NaN in light grey.

    Args:
        name: of matplotlib's.

    Returns:
        The map.
    """
    return matplotlib.colormaps[name].with_extremes(bad="#dcdcdc")
