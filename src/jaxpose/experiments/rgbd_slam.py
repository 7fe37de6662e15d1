"""RGB-D SLAM: a camera tracked by a continuous pose field from colour and depth alone.

Without options it walks through a synthetic room at 5 Hz and writes a run folder under outputs/rgbd_slam.
`--data DIR` tracks a recording instead: 7-Scenes, TUM, Replica, ScanNet, EuRoC or a plain folder, found by
its files. The same as imu_slam, but for the default of `--imu`.
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

    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = SlamConfig(imu="none")


def run(config: Config, on_frame: slam_pipeline.OnFrame | None = None) -> slam_pipeline.Outcome:
    """Track the recording that `config` names, and write its run folder; see `slam_run.run`."""
    return slam_pipeline.run("rgbd_slam", config, on_frame)


def main(args: Sequence[str] | None = None) -> None:
    """The command: `python -m jaxpose.experiments.rgbd_slam`."""
    config = command.parse("rgbd_slam", Config, __doc__, args)
    command.guarded("rgbd_slam", lambda: report(*run(config, progress_bar())))


if __name__ == "__main__":
    main()
