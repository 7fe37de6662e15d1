"""RGB-D SLAM: a camera tracked by a continuous pose field from colour and depth alone.

Without options it walks through a synthetic room at 5 Hz and writes a run folder under outputs/rgbd_slam.
`--data DIR` tracks a recording instead: 7-Scenes, TUM, ICL-NUIM, Replica, ScanNet, EuRoC or a plain folder,
found by its files. The same as imu_slam, but for the default of `--imu`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from jaxpose.experiments.command import MODULE
from jaxpose.experiments.outcome import Outcome
from jaxpose.experiments.progress import OnUpdate, silent
from jaxpose.experiments.slam import pipeline
from jaxpose.experiments.slam.options import Options
from jaxpose.slam import SlamConfig


@dataclass(frozen=True)
class Config(Options):
    """`Options`, with the IMU mode that the experiment is about."""

    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = SlamConfig(imu="none")


def run(config: Config, on_update: OnUpdate = silent) -> Outcome:
    """Track a recording and write its run folder.

    Args:
        config: the recording and how to track it.
        on_update: called with what the run is doing.

    Returns:
        The run folder, and its results; with `compare` those of each IMU mode under `modes`.

    Raises:
        DataError, OSError: for what cannot be read, tracked or written; then no folder is left behind.
    """
    return pipeline.run("rgbd_slam", config, on_update)


def main(args: Sequence[str] | None = None) -> None:
    """The command `python -m jaxpose.experiments.rgbd_slam`."""
    pipeline.command(MODULE + "rgbd_slam", Config, __doc__, run, args)


if __name__ == "__main__":
    main()
