"""The end of a run, compiled while its frames are tracked: that leaves a core idle, and XLA Python's lock."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np

from jaxpose.datasets.types import Recording
from jaxpose.estimate.smoothing import compile_ahead
from jaxpose.slam.batch import estimated_beside_poses
from jaxpose.slam.config import SlamConfig


@contextmanager
def end_compiled(recording: Recording, config: SlamConfig) -> Iterator[None]:
    """Compile what makes the final trajectory of a recording; it is there when what this holds is done.

    What ends by an error waits for no more than the function that is being compiled.

    Args:
        recording: what is tracked.
        config: settings of the run.
    """
    imu, first = recording.imu, recording.t[0]
    if imu is None or config.uses_field or not config.uses_gyroscope:
        yield
        return
    stopped, imu = threading.Event(), imu._replace(t=np.asarray(imu.t, np.float64) - first)

    def work() -> None:
        with suppress(Exception):  # what fails here fails again where it is needed
            compile_ahead(recording.t - first, imu, estimated_beside_poses(config), stopped.is_set)

    thread = threading.Thread(target=work, name="compile ahead")
    thread.start()
    try:
        yield
        thread.join()
    finally:
        stopped.set()
