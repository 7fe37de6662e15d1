"""What the benchmarks share: repeated timing, its median and spread, and what it was measured on."""

import os
import time
from collections.abc import Callable

import jax
import numpy as np


def machine() -> str:
    """One line: the processor or accelerator, its cores, and how busy the machine is."""
    load = os.getloadavg()[0]
    device = jax.devices()[0]
    return (
        f"jax {jax.__version__}, {device.device_kind}, {len(os.sched_getaffinity(0))} cores, load {load:.1f}"
    )


def in_turn(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, np.ndarray]:
    """Wall time [s] of `repeats` calls of each, after one that compiles.

    They take turns, so that a machine whose speed drifts treats them alike.
    """
    for run in runs.values():
        jax.block_until_ready(run())
    times = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            jax.block_until_ready(run())
            times[name].append(time.perf_counter() - start)
    return {name: np.array(taken) for name, taken in times.items()}


def milliseconds(times: np.ndarray) -> str:
    """Median, and the range that holds the middle half."""
    low, middle, high = 1e3 * np.percentile(times, [25, 50, 75])
    return f"{middle:8.2f} ms   (middle half {low:.2f} to {high:.2f})"


def product_gflops(size: int = 2048, repeats: int = 5) -> float:
    """The best rate of a float32 matrix product now: the ceiling of what networks can reach."""
    a = jax.random.normal(jax.random.key(0), (size, size))
    product = jax.jit(lambda a: a @ a)
    return 2 * size**3 / in_turn({"product": lambda: product(a)}, repeats)["product"].min() / 1e9
