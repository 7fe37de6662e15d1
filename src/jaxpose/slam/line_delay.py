"""The time from row to row of a rolling shutter, by how well frames fit the map when it is assumed."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.pipeline import Progress, track_all

_READ_S = 1 / 60  # in which a sensor reads an image, at most


class LineDelay(NamedTuple):
    """What was found."""

    line_delay_us: float
    sigma_us: float
    observed: bool  # False: the motion says less of it than that sensors read an image within 1/60 s


def estimate_line_delay(
    recording: Recording, config: SlamConfig, on_frame: Callable[[Progress], None] | None = None
) -> LineDelay:
    """The line delay at which frames ask for no correction of it.

    A map that was made with a wrong line delay agrees with frames that have it: a run asks for a small part
    of what is missing. So runs with different line delays are compared: the true one is where a line through
    what two of them ask for crosses zero, the two that ask for least.

    Args:
        recording: frames whose times are those of their first rows.
        config: settings of the runs.
        on_frame: called after every frame of each run.

    Returns:
        The line delay and one sigma of it, by the images' own sigmas and the slope.

    Raises:
        DataError: where the motion does not tell, or a run cannot be tracked.
    """
    half = _READ_S / recording.camera.height / 2
    runs = [_asked(recording, config, delay, on_frame) for delay in (0.0, half)]
    runs.append(_asked(recording, config, _zero(recording, *runs)[0], on_frame))
    first, second, _ = sorted(runs, key=lambda run: abs(run.correction_s))
    found, slope = _zero(recording, first, second)
    sigma = first.sigma_s / abs(slope)
    return LineDelay(1e6 * found, 1e6 * sigma, sigma < half)


class _Asked(NamedTuple):
    """The correction that the frames of a run ask for, when a line delay is assumed."""

    assumed_s: float
    correction_s: float
    sigma_s: float


def _asked(recording: Recording, config: SlamConfig, delay_s: float, on_frame) -> _Asked:
    asking = replace(config, line_delay_us=1e6 * delay_s, estimate=("line-delay",))
    told = track_all(recording, asking, on_frame).frames.line_delay
    correction, information = told[np.isfinite(told).all(axis=1)].T
    total = float(information.sum())
    if total <= 0:
        raise DataError(f"{recording.name}: line delay: expected registered frames, got none")
    return _Asked(delay_s, float(correction @ information) / total, total**-0.5)


def _zero(recording: Recording, a: _Asked, b: _Asked) -> tuple[float, float]:
    """The line delay [s] at which two runs together ask for nothing, and the slope of what they ask for."""
    slope = (b.correction_s - a.correction_s) / (b.assumed_s - a.assumed_s)
    if not slope < 0:
        raise DataError(f"{recording.name}: line delay: this motion says nothing of it")
    return a.assumed_s - a.correction_s / slope, slope
