"""Pictures of a run, each one PNG that appears whole or not at all; numpy in, SI units, no global state."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.ndimage import uniform_filter1d

from jaxpose.plots.style import (
    AXES,
    DPI,
    ESTIMATE,
    GROUND_TRUTH,
    LOST,
    SENSOR,
    STYLE,
    gapped,
    paths,
    save,
)

_VIEW_TITLES = ("input colour", "rendered colour", "input depth", "rendered depth", "rendered - input depth")
_MODES = {
    "none": "#8a8a8a",
    "loose": "#5aa5d6",
    "tight": "#1f5fa8",
    "accelerometer": "#e0902f",
    "combined": "#b5322d",
}


class View(NamedTuple):
    """One frame beside what the scene shows from its estimated pose; depth [m], 0 where there is none."""

    label: str
    rgb: UInt8[np.ndarray, "h w 3"]
    rendered_rgb: Float[np.ndarray, "k l 3"]  # in [0, 1]
    depth: Float[np.ndarray, "k l"]
    rendered_depth: Float[np.ndarray, "k l"]


def trajectory(
    path: Path | str,
    estimate: Float[np.ndarray, "n 4 4"],
    reference: Float[np.ndarray, "n 4 4"] | None,
    lost: Bool[np.ndarray, " n"],
    title: str,
    covariance: Float[np.ndarray, "n 6 6"] | None = None,
) -> None:
    """Camera centres from above and from the side, coloured by their distance to the reference, if any.

    The view from above is along the world axis nearest to the cameras' mean up. Ellipses that hold 90% of the
    places that some poses may have are drawn as many times enlarged as the legend says.

    Args:
        path: PNG to write.
        estimate: poses, aligned as their errors were computed.
        reference: ground truth; None: there is none.
        lost: frames that tracking lost.
        title: of the figure.
        covariance: of the poses, over increments [m, rad] on the right; None: not known.
    """
    off = None if reference is None else 100 * _distances(estimate, reference)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 5.2), dpi=DPI, layout="constrained")
        views: list[Axes] = list(figure.subplots(1, 2))
        shade = paths(views, estimate, reference, off, lost, covariance)
        if shade is not None:
            figure.colorbar(shade, ax=views, label="distance to the ground truth [cm]", shrink=0.9, pad=0.015)
        figure.suptitle(title)
        save(figure, path)


def errors(
    path: Path | str,
    t: Float[np.ndarray, " n"],
    translation_m: Float[np.ndarray, " n"],
    rotation_deg: Float[np.ndarray, " n"],
    lost: Bool[np.ndarray, " n"],
    title: str,
    covariance: Float[np.ndarray, "n 6 6"] | None = None,
) -> None:
    """Errors of every frame over time, beside what they were said to be, and the frames that tracking lost.

    Args:
        path: PNG to write.
        t: times of the frames [s].
        translation_m: errors [m], NaN where there is no ground truth.
        rotation_deg: errors [deg], NaN where there is no ground truth.
        lost: frames that tracking lost.
        title: of the figure.
        covariance: of the poses, over increments [m, rad] on the right; None: not known.
    """
    sigmas = [None, None]
    if covariance is not None:
        squares = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=-1)
        sigmas = [100 * np.sqrt(squares[:, 0]), np.degrees(np.sqrt(squares[:, 1]))]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10, 5), dpi=DPI, layout="constrained")
        rows: list[Axes] = list(figure.subplots(2, 1, sharex=True))
        of_both = zip((100 * translation_m, rotation_deg), sigmas, strict=True)
        for axes, (values, sigma), unit, name in zip(
            rows, of_both, ("cm", "deg"), ("translation", "rotation"), strict=True
        ):
            rmse = float(np.sqrt(np.nanmean(values**2)))
            axes.plot(t, values, "-o", color=ESTIMATE, lw=1.2, ms=2.5)
            axes.axhline(rmse, color=ESTIMATE, lw=0.9, ls="--", label=f"RMSE {rmse:.2f} {unit}")
            _mark(axes, t, lost)
            top = 1.05 * np.nanmax(values)
            if sigma is not None:
                axes.fill_between(t, sigma, color=SENSOR, alpha=0.3, lw=0, label="one sigma, as stated")
                top = max(top, min(1.05 * float(np.nanmax(sigma)), 3 * top))
            axes.set(ylabel=f"{name} error [{unit}]")
            axes.set_ylim(0, top if top > 0 else None)
            axes.legend(loc="upper left", ncols=3)
        rows[-1].set(xlabel="time [s]", xlim=(t[0], t[-1]))
        figure.suptitle(title)
        save(figure, path)


def renders(path: Path | str, views: Sequence[View], title: str) -> None:
    """Input and rendered colour and depth side by side, one row a frame, and where the depths differ.

    Args:
        path: PNG to write.
        views: one a row.
        title: of the figure.
    """
    worst = 10.0  # [cm], the end of the error's scale
    deepest = float(np.percentile(np.concatenate([v.depth[v.depth > 0] for v in views] + [np.ones(1)]), 99))
    height, width = views[0].depth.shape
    row_height = 10.6 / 5 * height / width + 0.06
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 1.1 + len(views) * row_height), dpi=DPI, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.045)  # type: ignore[union-attr]
        cells = figure.add_gridspec(len(views) + 1, 5, height_ratios=[1] * len(views) + [0.05])
        depth_shade = error_shade = None
        for number, view in enumerate(views):
            row = [figure.add_subplot(cells[number, k]) for k in range(5)]
            for axes in row:
                axes.set(xticks=[], yticks=[])
                axes.grid(False)
                axes.spines[:].set_visible(False)
            both = (view.depth > 0) & (view.rendered_depth > 0)
            error = np.where(both, 100 * (view.rendered_depth - view.depth), np.nan)
            row[0].imshow(view.rgb)
            row[1].imshow(np.clip(view.rendered_rgb, 0, 1))
            for axes, depth in ((row[2], view.depth), (row[3], view.rendered_depth)):
                depth_shade = axes.imshow(_known(depth), cmap=gapped("viridis"), vmin=0, vmax=deepest)
            error_shade = row[4].imshow(error, cmap=gapped("RdBu_r"), vmin=-worst, vmax=worst)
            row[0].set_ylabel(view.label)
            median = f"{np.nanmedian(np.abs(error)):.1f} cm" if both.any() else "unknown"
            row[4].text(
                0.02, 0.03, f"median |error| {median}", transform=row[4].transAxes, fontsize=7.5,
                bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5},
            )  # fmt: skip
            if number == 0:
                for axes, name in zip(row, _VIEW_TITLES, strict=True):
                    axes.set_title(name)
        for shade, where, label in (
            (depth_shade, cells[-1, 2:4], "depth [m], grey: none"),
            (error_shade, cells[-1, 4], "difference [cm]"),
        ):
            assert shade is not None
            figure.colorbar(shade, cax=figure.add_subplot(where), orientation="horizontal", label=label)
        figure.suptitle(title)
        save(figure, path)


def inertial(
    path: Path | str,
    t: Float[np.ndarray, " s"],
    gyro: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    accelerometer: tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]],
    title: str,
) -> None:
    """Readings of an IMU and derivatives of a field, in body axes.

    Args:
        path: PNG to write.
        t: times [s].
        gyro: body rates [rad/s], read and of the field.
        accelerometer: accelerations without gravity [m/s^2], read and of the field.
        title: of the figure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 6), dpi=DPI, layout="constrained")
        grid = np.asarray(figure.subplots(3, 2, sharex=True, sharey="col"))
        for column, (read, field), unit, name in zip(
            grid.T,
            (gyro, accelerometer),
            ("rad/s", "m/s²"),
            ("body rate", "acceleration without gravity"),
            strict=True,
        ):
            rms = float(np.sqrt(np.mean((read - field) ** 2)))
            for k, axes in enumerate(column):
                axes.plot(t, read[:, k], color=SENSOR, lw=1.3, label="IMU", zorder=3)
                axes.plot(t, field[:, k], color=ESTIMATE, lw=1.1, label="derivative of the field")
                axes.set(ylabel=f"{AXES[k]} [{unit}]")
            span = float(np.percentile(np.abs(read), 99.8))
            column[0].set_ylim(
                -1.4 * span, 1.4 * span
            )  # a field that is wild at its ends must not hide the rest
            column[0].set_title(f"{name}: RMS difference {rms:.3g} {unit}")
            column[-1].set(xlabel="time [s]", xlim=(t[0], t[-1]))
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        figure.suptitle(title)
        save(figure, path)


def comparison(
    path: Path | str,
    t: Float[np.ndarray, " n"],
    errors_m: Mapping[str, Float[np.ndarray, " n"]],
    title: str,
) -> None:
    """Translation error over time and its root mean square, one curve and one bar per IMU mode.

    Args:
        path: PNG to write.
        t: times of the frames [s].
        errors_m: error of each frame [m], by IMU mode.
        title: of the figure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 4.2), dpi=DPI, layout="constrained")
        curves, bars = figure.subplots(1, 2, width_ratios=(2.4, 1))
        rmse = {name: 100 * float(np.sqrt(np.nanmean(values**2))) for name, values in errors_m.items()}
        for name, values in errors_m.items():
            curves.plot(t, 100 * values, color=_MODES.get(name), lw=1.3, label=name)
        curves.set(xlabel="time [s]", ylabel="translation error [cm]", xlim=(t[0], t[-1]))
        if max(rmse.values()) > 10 * min(
            rmse.values()
        ):  # one lost the camera: the others shall stay readable
            curves.set_yscale("log")
            bars.set_xscale("log")
            bars.xaxis.set_minor_formatter(NullFormatter())  # the bars carry their numbers
        curves.legend(loc="best", ncols=2)
        names = list(rmse)[::-1]
        drawn = bars.barh(names, [rmse[n] for n in names], color=[_MODES.get(n, ESTIMATE) for n in names])
        bars.bar_label(drawn, fmt="%.2f", padding=3)
        bars.margins(x=0.18)
        bars.set(xlabel="ATE-RMSE [cm]")
        bars.grid(False)
        figure.suptitle(title)
        save(figure, path)


def freedom(
    path: Path | str,
    t: Float[np.ndarray, " n"],
    before: Int[np.ndarray, " n"],
    after: Int[np.ndarray, " n"],
    title: str,
) -> None:
    """Degrees of freedom over time, as means of ten motions, and how often each occurs.

    Args:
        path: PNG to write.
        t: times of the frames [s].
        before: of the motion from frame to frame.
        after: of the same motion in the intrinsic frame.
        title: of the figure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 3.6), dpi=DPI, layout="constrained")
        curves, bars = figure.subplots(1, 2, width_ratios=(2.4, 1))
        for k, (name, dof, colour) in enumerate((
            ("frame to frame", before, GROUND_TRUTH),
            ("intrinsic frame", after, ESTIMATE),
        )):  # fmt: skip
            label = f"{name}, mean {dof.mean():.2f}"
            curves.plot(t, dof, color=colour, lw=0, marker=".", ms=3, alpha=0.5)
            curves.plot(t, uniform_filter1d(dof.astype(float), 10), color=colour, lw=1.6, label=label)
            share = np.bincount(dof, minlength=7) / len(dof)
            bars.bar(np.arange(7) + 0.4 * k - 0.2, share, width=0.4, color=colour)
        curves.set(xlabel="time [s]", ylabel="degrees of freedom", ylim=(-0.2, 6.2), xlim=(t[0], t[-1]))
        curves.legend(loc="best", ncols=2)
        bars.set(xlabel="degrees of freedom", ylabel="share of motions")
        figure.suptitle(title)
        save(figure, path)


def _distances(estimate: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"]) -> np.ndarray:
    return np.linalg.norm(estimate[:, :3, 3] - reference[:, :3, 3], axis=1)


def _mark(axes: Axes, t: Float[np.ndarray, " n"], lost: Bool[np.ndarray, " n"]) -> None:
    """A stripe at each lost frame."""
    for number, at in enumerate(t[lost]):
        label = f"lost ({int(lost.sum())} frames)" if number == 0 else None
        axes.axvline(at, color=LOST, lw=3, alpha=0.35, label=label, zorder=0)


def _known(depth: Float[np.ndarray, "k l"]) -> Float[np.ndarray, "k l"]:
    return np.where(depth > 0, depth, np.nan)
