"""The picture of a run while it goes."""

from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from jaxpose.plots.slam import View
from jaxpose.plots.style import ESTIMATE, LOST, save


def preview(
    path: Path | str, T_world_cam: Float[np.ndarray, "n 4 4"], lost: Bool[np.ndarray, " n"], view: View
) -> None:
    """The cameras so far from above, and the last frame beside the map as seen from its estimated pose.

    From above is along the world axis nearest to the cameras' mean up.

    Args:
        path: PNG to write.
        T_world_cam: poses of the frames so far.
        lost: frames that tracking lost.
        view: the last frame, and the map from its pose.
    """
    up = int(np.abs(T_world_cam[:, :3, 1].mean(axis=0)).argmax())
    a, b = sorted({0, 1, 2} - {up})
    figure = Figure(figsize=(9, 3.6), dpi=80)
    above, *cells = (figure.add_subplot(2, 4, k) for k in ((1, 6), 3, 4, 7, 8))
    centres = T_world_cam[:, [a, b], 3]
    above.plot(*centres.T, color=ESTIMATE, lw=1.2)
    above.plot(*centres[lost].T, "x", color=LOST, ms=5)
    above.plot(*centres[-1], "o", color="black", ms=5)
    above.set_aspect("equal", adjustable="datalim")
    above.set(title=f"{view.label}, {len(lost)} frames, {int(lost.sum())} lost", xlabel="m")
    depth = [np.where(x > 0, x, np.nan) for x in (view.depth, view.rendered_depth)]
    deepest = float(np.nanmax(depth[0])) if np.isfinite(depth[0]).any() else 1.0
    shown = (view.rgb, np.clip(view.rendered_rgb, 0, 1), *depth)
    names = ("colour", "map", "depth", "depth of the map")
    for axes, image, name in zip(cells, shown, names, strict=True):
        axes.imshow(image, vmin=0, vmax=deepest, cmap=matplotlib.colormaps["viridis"])
        axes.set_title(name, fontsize=8)
        axes.set_axis_off()
    save(figure, path)
