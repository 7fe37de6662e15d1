"""The picture of a comparison: both trajectories from above and from the side, and the errors."""

from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxpose.plots.style import (
    DPI,
    ESTIMATE,
    STYLE,
    paths,
    save,
)


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

    Errors of less than a metre are in cm.

    Args:
        path: PNG to write.
        t: times [s]; None: errors are drawn over the number of the pose.
        estimate: poses, aligned as their errors were computed.
        reference: poses they are compared with.
        translation_m: error of each pose [m].
        rotation_deg: error of each pose [deg].
        title: of the figure.
    """
    unit, factor = ("cm", 100.0) if np.nanmax(translation_m) < 1 else ("m", 1.0)
    errors, over = factor * translation_m, np.arange(float(len(estimate))) if t is None else t - t[0]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 8), dpi=DPI, layout="constrained")
        cells = figure.add_gridspec(4, 2, height_ratios=[2.6, 0.05, 1, 1])
        views = [figure.add_subplot(cells[0, k]) for k in range(2)]
        shade = paths(views, estimate, reference, errors, np.zeros(len(estimate), bool))
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
        save(figure, path)
