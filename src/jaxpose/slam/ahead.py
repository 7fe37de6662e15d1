"""What a run will need, compiled while frames are tracked: that leaves a core idle, and XLA Python's lock.

What fails here fails again where it is needed.
"""

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpose._memory import give_back_memory
from jaxpose.datasets.types import Recording
from jaxpose.estimate.smoothing import compile_ahead
from jaxpose.slam.batch import estimated_beside_poses
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.map.backend import map_backend, scene_params
from jaxpose.slam.observation import Image
from jaxpose.slam.tracking.relocalise import CENTRES
from jaxpose.slam.types import SlamState

_COMPILED_FIRST = 2  # frames


@contextmanager
def end_compiled(
    recording: Recording, config: SlamConfig, on_frame: Callable[[Any], None] | None
) -> Iterator[Callable[[Any], None] | None]:
    """Compile what makes the final trajectory of a recording; it is there when what this holds is done.

    It begins when the first two frames, which compile themselves, are through. What ends by an error waits
    for no more than the function that is being compiled.

    Args:
        recording: what is tracked.
        config: settings of the run.
        on_frame: what is called after every frame.

    Yields:
        What is to be called after every frame.
    """
    imu, first, stopped = recording.imu, recording.t[0], threading.Event()
    if imu is None or config.uses_field or not config.uses_gyroscope:
        yield on_frame
        return

    def work() -> None:
        with suppress(Exception):
            readings = imu._replace(t=np.asarray(imu.t, np.float64) - first)
            compile_ahead(recording.t - first, readings, estimated_beside_poses(config), stopped.is_set)

    thread, frames = threading.Thread(target=work, name="compile ahead"), itertools.count(1)

    def on_frame_and_begin(progress: Any) -> None:
        if next(frames) == _COMPILED_FIRST:
            thread.start()
        if on_frame is not None:
            on_frame(progress)

    try:
        yield on_frame_and_begin
        if thread.ident is not None:
            thread.join()
    finally:
        stopped.set()


def compile_search(state: SlamState, image: Image) -> None:
    """Begin to compile the search for a camera in doubt, so that the first doubt does not wait for it.

    Args:
        state: after its first frame was mapped.
        image: of that frame.
    """
    assert state.map is not None
    poses, sigma = jnp.zeros((CENTRES, 4, 4), jnp.float32), jnp.zeros(2, jnp.float32)
    args = scene_params(state.map), state.map.fusion_state, poses, sigma, image, jax.random.key(0)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), args)  # the map will be donated
    search = map_backend(state).relocalise

    def work() -> None:
        with suppress(Exception):
            search.lower(*shapes).compile()
            give_back_memory()

    threading.Thread(target=work, name="compile search").start()
