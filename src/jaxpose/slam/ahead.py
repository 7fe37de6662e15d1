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
from jaxpose.scenes.voxel_blocks import next_capacity
from jaxpose.slam.batch import estimated_beside_poses
from jaxpose.slam.config import SlamConfig
from jaxpose.slam.map.backend import map_backend, pool_size, scene_params
from jaxpose.slam.map.photometric import MapState
from jaxpose.slam.observation import Image
from jaxpose.slam.tracker import tracking_problem
from jaxpose.slam.tracking.predict import MotionPrediction
from jaxpose.slam.tracking.relocalise import CENTRES
from jaxpose.slam.types import SlamState

_COMPILED_FIRST = 2  # frames
_NEARLY_FULL = 0.75  # of a pool


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
        state: with room in its map for the first frame.
        image: of that frame.
    """
    assert state.map is not None
    _begin([(map_backend(state).relocalise, *_search_arguments(state.map, image))])


def compile_growth(state: SlamState, used: int, image: Image, expected: MotionPrediction) -> None:
    """Begin to compile what a larger pool of blocks needs, once the present one is three quarters full.

    Args:
        state: with room in its map for a frame.
        used: rows of the pool that were in use before there was.
        image: of that frame.
        expected: of its motion.
    """
    now, capacity = pool_size(state)
    if not used < _NEARLY_FULL * capacity <= now:
        return
    larger = next_capacity(capacity, state.config.map_budget)
    if larger is None:
        return
    assert state.map is not None
    backend = map_backend(state)
    resized = lambda x: jax.ShapeDtypeStruct((larger, *x.shape[1:]), x.dtype)
    blocks = state.map.params
    blocks = blocks._replace(coords=resized(blocks.coords), values=resized(blocks.values))
    grown = state.map._replace(params=blocks)
    problem = tracking_problem(state, state.frames, expected, np.random.default_rng(0))
    seen = state.params, problem, image, jnp.float32(0), jax.random.key(0)
    _begin([
        (backend.track, grown.params, grown.fusion_state, *seen),
        (backend.update, grown, image, jnp.zeros((4, 4), jnp.float32)),
        (backend.relocalise, *_search_arguments(grown, image)),
    ])  # fmt: skip


def _search_arguments(state: MapState, image: Image) -> tuple[Any, ...]:
    poses, sigma = jnp.zeros((CENTRES, 4, 4), jnp.float32), jnp.zeros(2, jnp.float32)
    return scene_params(state), state.fusion_state, poses, sigma, image, jax.random.key(0)


def _begin(calls: list[tuple[Any, ...]]) -> None:
    """Compile functions for such arguments in a thread, unless the program ends meanwhile."""
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), [args for _, *args in calls])

    def work() -> None:  # the arguments themselves may be donated meanwhile
        for (function, *_), args in zip(calls, shapes, strict=True):
            if not threading.main_thread().is_alive():
                return  # nobody is left to need it
            with suppress(Exception):
                function.lower(*args).compile()
            give_back_memory()

    threading.Thread(target=work, name="compile ahead").start()
