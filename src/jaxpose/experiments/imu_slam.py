"""RGB-D-inertial SLAM: a camera tracked by a continuous pose field, frames and IMU on the same trajectory.

Without options it walks through a synthetic room, at 5 Hz with a 200 Hz IMU, and writes a run folder under
outputs/imu_slam. `--data DIR` tracks a recording instead, in a layout found by its files, with its own IMU
(EuRoC) or one simulated from its true poses. `--compare` puts all IMU modes side by side.
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

    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = SlamConfig(imu="combined")


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
    return pipeline.run("imu_slam", config, on_update)


def main(args: Sequence[str] | None = None) -> None:
    """The command `python -m jaxpose.experiments.imu_slam`."""
    pipeline.command(MODULE + "imu_slam", Config, __doc__, run, args)


if __name__ == "__main__":
    main()
