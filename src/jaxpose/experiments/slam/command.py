"""Track an RGB-D camera, with or without an IMU, by a continuous pose field.

Without options it walks through a synthetic room, at 5 Hz with a 200 Hz IMU, and writes a run folder under
outputs/slam. `--data DIR` tracks a recording: 7-Scenes, TUM, ICL-NUIM, Replica, ScanNet, EuRoC or a plain
folder, found by its files, with its own IMU (EuRoC, `--imu-file`) or one simulated from its true poses.
`--imu none` goes without, `--compare` puts all IMU modes side by side.
"""

from collections.abc import Sequence

from jaxpose.experiments.imu_slam import Config
from jaxpose.experiments.outcome import Outcome
from jaxpose.experiments.progress import OnUpdate, silent
from jaxpose.experiments.slam import pipeline


def run(config: Config, on_update: OnUpdate = silent) -> Outcome:
    """Track a recording and write its run folder, as `pipeline.run` does.

    Args:
        config: the recording and how to track it.
        on_update: called with what the run is doing.

    Returns:
        The run folder, and its results; with `compare` those of each IMU mode under `modes`.

    Raises:
        DataError, OSError: for what cannot be read, tracked or written; then no folder is left behind.
    """
    return pipeline.run("slam", config, on_update)


def main(args: Sequence[str] | None = None, prog: str = "jaxpose slam") -> None:
    """The command `jaxpose slam`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    pipeline.command(prog, Config, __doc__, run, args)
