"""RGB-D-inertial SLAM: a camera tracked by a continuous pose field, frames and IMU on the same trajectory.

Without options it walks through a synthetic room, at 5 Hz with a 200 Hz IMU, and writes a run folder under
outputs/imu_slam. `--data DIR` tracks a recording instead, in a layout found by its files, with its own IMU
(EuRoC) or one simulated from its true poses. `--compare` puts all IMU modes side by side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from jaxpose.experiments import command
from jaxpose.experiments.slam import pipeline as slam_pipeline
from jaxpose.experiments.slam.options import Options
from jaxpose.experiments.slam.report import progress_bar, report
from jaxpose.slam.pipeline import SlamConfig


@dataclass(frozen=True)
class Config(Options):
    """`Options`, with the IMU mode that the experiment is about."""

    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = SlamConfig(imu="combined")


def run(config: Config, on_frame: slam_pipeline.OnFrame | None = None) -> slam_pipeline.Outcome:
    """Track the recording that `config` names, and write its run folder; see `slam_run.run`."""
    return slam_pipeline.run("imu_slam", config, on_frame)


def main(args: Sequence[str] | None = None) -> None:
    """The command: `python -m jaxpose.experiments.imu_slam`."""
    config = command.parse("imu_slam", Config, __doc__, args)
    command.guarded("imu_slam", lambda: report(*run(config, progress_bar())))


if __name__ == "__main__":
    main()
