"""RGB-D SLAM: a camera tracked by a continuous pose field from colour and depth alone.

Without options it walks through a synthetic room at 5 Hz and writes a run folder under outputs/rgbd_slam.
`--data DIR` tracks a recording instead: 7-Scenes, TUM, Replica, ScanNet, EuRoC or a plain folder, found by
its files. The same as imu_slam, but for the default of `--imu`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from jaxpose import command
from jaxpose.experiments import slam_run
from jaxpose.experiments.slam_options import Options
from jaxpose.experiments.slam_report import progress_bar, report
from jaxpose.slam.run import SlamConfig


@dataclass(frozen=True)
class Config(Options):
    """`Options`, with the IMU mode that the experiment is about."""

    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = SlamConfig(imu="none")


def run(config: Config, on_frame: slam_run.OnFrame | None = None) -> slam_run.Outcome:
    """Track the recording that `config` names, and write its run folder; see `slam_run.run`."""
    return slam_run.run("rgbd_slam", config, on_frame)


def main(args: Sequence[str] | None = None) -> None:
    """The command: `python -m jaxpose.experiments.rgbd_slam`."""
    config = command.parse("rgbd_slam", Config, __doc__, args)
    command.guarded("rgbd_slam", lambda: report(*run(config, progress_bar())))


if __name__ == "__main__":
    main()
