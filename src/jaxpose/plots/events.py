"""Pictures of events and of what is made from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from jaxpose.events import Events
from jaxpose.plots.style import DPI, ESTIMATE, LOST, STYLE, save

_WINDOWS = 4
_MOST = 3  # events of a pixel at the end of the scale


def balance(events: Events, height: int, width: int, span: tuple[float, float]) -> Float[np.ndarray, "h w"]:
    """Brighter minus darker events of each pixel.

    Args:
        events: in the order of time.
        height: of the sensor [px].
        width: of the sensor [px].
        span: first time, and the one before which events count [s].

    Returns:
        A count per pixel.
    """
    inside = slice(*np.searchsorted(events.t, span))
    total = np.zeros((height, width))
    np.add.at(total, (events.y[inside], events.x[inside]), events.polarity[inside].astype(float))
    return total


def windows(path: Path | str, events: Events, height: int, width: int, title: str) -> None:
    """The events of four short times, evenly over the recording: brighter red, darker blue.

    Args:
        path: PNG to write.
        events: in the order of time.
        height: of the sensor [px].
        width: of the sensor [px].
        title: of the figure.
    """
    first, last = float(events.t[0]), float(events.t[-1])
    # As long as it takes for one pixel in four to report something.
    length = (last - first) * min(1.0, height * width / (4 * max(len(events.t), 1)))
    starts = first + (np.arange(_WINDOWS) + 0.5) / _WINDOWS * (last - first - length)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 1.5 + 2.6 * height / width), dpi=DPI, layout="constrained")
        panels: Any = figure.subplots(1, _WINDOWS)
        for axes, start in zip(panels, starts, strict=True):
            shown = axes.imshow(
                balance(events, height, width, (start, start + length)),
                cmap="RdBu_r",
                vmin=-_MOST,
                vmax=_MOST,
            )
            axes.set(xticks=[], yticks=[], title=f"{start:.3f} to {start + length:.3f} s")
            axes.grid(False)
        figure.colorbar(
            shown, ax=panels, orientation="horizontal", shrink=0.3, aspect=40,
            label="events brighter (red) less darker (blue)",
        )  # fmt: skip
        figure.suptitle(title)
        save(figure, path)


def errors(
    path: Path | str,
    t: Float[np.ndarray, " m"],
    start: Sequence[Float[np.ndarray, " m"]],
    end: Sequence[Float[np.ndarray, " m"]],
    title: str,
) -> None:
    """Pose errors over the motion, at the start of a training and at its end.

    Args:
        path: PNG to write.
        t: times [s].
        start: rotation [deg] and translation [scene units] errors at the start.
        end: the same at the end.
        title: of the figure.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 4.6), dpi=DPI, layout="constrained")
        panels: Any = figure.subplots(2, 1, sharex=True)
        labels = ("rotation error [deg]", "translation error [units]")
        for axes, label, before, after in zip(panels, labels, start, end, strict=True):
            axes.plot(t, before, color=LOST, lw=1.2, label="start")
            axes.plot(t, after, color=ESTIMATE, lw=1.4, label="estimate")
            axes.set(ylabel=label, ylim=(0, None))
        panels[-1].set(xlabel="time [s]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        figure.suptitle(title)
        save(figure, path)
