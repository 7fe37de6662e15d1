"""The picture of a suite: each case's error over its seeds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from jaxpose.plots.style import DPI, ESTIMATE, LOST, STYLE, save


def accuracy(path: Path | str, rows: Sequence[dict[str, Any]]) -> None:
    """Draw the median of each case's ATE with its range; red where frames were lost or runs failed.

    Args:
        path: of the PNG.
        rows: of the suite's results.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 0.8 + 0.28 * len(rows)), dpi=DPI, layout="constrained")
        axes = figure.subplots()
        for k, row in enumerate(rows):
            lost = row["frames_lost"] is None or row["frames_lost"]["max"] > 0 or row["failures"]
            color, ate = LOST if lost else ESTIMATE, row["ate_m"]
            if ate is not None:
                median, least, most = (100 * ate[name] for name in ("median", "min", "max"))
                axes.plot([least, most], [k, k], color=color, linewidth=2, solid_capstyle="round")
                axes.plot(median, k, "o", color=color, markersize=5)
            else:
                axes.text(0.01, k, "no result", color=LOST, va="center", transform=axes.get_yaxis_transform())
        axes.set_yticks(range(len(rows)), [f"{row['recording']}, {row['rate']}" for row in rows])
        axes.invert_yaxis()
        axes.set_xscale("log")
        axes.set_xlabel("ATE [cm], median and range over the seeds; red: frames lost or runs failed")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
        save(figure, path)
