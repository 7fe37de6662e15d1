"""The picture of a comparison: both trajectories from above and from the side, and the errors."""

from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxpose.plots.slam import _AXES, _STYLE, DPI, ESTIMATE, TRUTH, _keys, _save, _shaded, _view_axes


def comparison(
    path: Path | str,
    t: Float[np.ndarray, " n"] | None,
    estimate: Float[np.ndarray, "n 4 4"],
    reference: Float[np.ndarray, "n 4 4"],
    translation_m: Float[np.ndarray, " n"],
    rotation_deg: Float[np.ndarray, " n"],
    title: str,
) -> None:
    """Positions from above and from the side, the estimate's coloured by its error, and errors over time.

    `estimate` is drawn as it comes: align it as its error was computed. The time starts at the first
    timestamp; without `t` [s] errors are drawn over the number of the pose. Errors of less than a metre are
    in cm.
    """
    across, along, up, sign = _view_axes(reference)
    unit, factor = ("cm", 100.0) if np.nanmax(translation_m) < 1 else ("m", 1.0)
    errors, over = factor * translation_m, np.arange(float(len(estimate))) if t is None else t - t[0]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(11, 8), dpi=DPI, layout="constrained")
        cells = figure.add_gridspec(4, 2, height_ratios=[2.6, 0.05, 1, 1])
        views = [figure.add_subplot(cells[0, k]) for k in range(2)]
        shade = None
        for axes, (a, b), name in zip(
            views, ((across, along), (across, up)), ("from above", "from the side"), strict=True
        ):
            axes.plot(*reference[:, [a, b], 3].T, color=TRUTH, lw=3.5, alpha=0.5)
            centres = estimate[:, [a, b], 3]
            shade = _shaded(axes, centres, errors)
            axes.plot(*centres[0], "o", color="black", ms=5, zorder=4)
            axes.set(title=name, xlabel=f"{_AXES[a]} [m]", ylabel=f"{_AXES[b]} [m]")
            axes.set_aspect("equal", adjustable="datalim")
            axes.autoscale_view()
        if sign < 0:
            views[1].invert_yaxis()
        views[0].legend(handles=_keys(ground_truth=True, lost=False), loc="best")
        assert shade is not None
        label = f"distance to the reference [{unit}]"
        figure.colorbar(shade, cax=figure.add_subplot(cells[1, :]), orientation="horizontal", label=label)
        below: list[Axes] = [figure.add_subplot(cells[row, :]) for row in (2, 3)]
        for axes, values, of, its in zip(
            below, (errors, rotation_deg), ("translation", "rotation"), (unit, "deg"), strict=True
        ):
            rmse = float(np.sqrt(np.nanmean(values**2)))
            axes.plot(over, values, color=ESTIMATE, lw=1.1)
            axes.axhline(rmse, color=ESTIMATE, lw=0.9, ls="--", label=f"RMSE {rmse:.3g} {its}")
            axes.set(ylabel=f"{of} error [{its}]")
            if len(over) > 1:
                axes.set_xlim(over[0], over[-1])
            axes.set_ylim(bottom=0)
            axes.legend(loc="upper left")
        below[-1].set(xlabel="pose" if t is None else "time since the first [s]")
        figure.suptitle(title)
        _save(figure, path)
