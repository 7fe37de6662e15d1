"""Preset paper on one GPU within a time: its step, and as many steps of TM 20% as fit.

First the step of 4096 rays x 128 samples with more and more rays at once, and with each precision of
products: time, FLOPs by the compiler's count (a product of n numbers counts 2 n), share of what a product of
large matrices reaches beside it, memory. Then `jaxpose nerf --preset paper --noise-translation 0.2` with the
fastest, until the time is up; called again with the same folder it goes on from the checkpoint, which is at
most 30 seconds old. The time of the whole training is that of the steps measured, times their number.

    python benchmarks/paper_on_gpu.py --out outputs/paper            # 12 minutes
    python benchmarks/paper_on_gpu.py --out outputs/paper --minutes 60
    python benchmarks/paper_on_gpu.py --out outputs/tried --minutes 5 --rays 32 --image-width 24 \
        --orbit-views 8 --at-once 16 32                              # on a CPU
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from timing import in_turn, machine, milliseconds

from jaxpose.errors import DataError
from jaxpose.experiments import devices
from jaxpose.experiments.devices import DeviceConfig, Precision
from jaxpose.experiments.noisy_nerf import model as noisy_nerf
from jaxpose.experiments.noisy_nerf import pipeline
from jaxpose.experiments.noisy_nerf.options import Config as NerfConfig
from jaxpose.experiments.noisy_nerf.options import load
from jaxpose.experiments.progress import Update

PRECISIONS: tuple[Precision, ...] = ("tensorfloat32", "float32", "bfloat16")


@dataclass(frozen=True)
class Config:
    """What fits, and where it goes on."""

    out: Path  # the run folder
    minutes: float = 12.0  # in all
    rays: int = 4096
    image_width: int = 400  # [px]
    orbit_views: int = 100
    at_once: tuple[int, ...] = (256, 1024, 4096)  # rays, tried one after the other
    precision: Precision = "tensorfloat32"  # of the training
    repeats: int = 5


class TimeIsUp(Exception):
    """Ends a training between two of its steps."""


def product_rate(precision: Precision, size: int) -> float:
    """FLOP/s of a float32 product of matrices: what networks can reach at most."""
    a = jax.random.normal(jax.random.key(0), (size, size))
    with jax.default_matmul_precision(devices.PRODUCTS[precision]):
        product = jax.jit(lambda a: a @ a)
        return 2 * size**3 / in_turn({"product": lambda: product(a)}, 5)["product"].min()


def step_flop(config: NerfConfig, problem) -> float:
    """FLOPs of a step, counted in one chunk, as the compiler takes a loop's body once."""
    whole = noisy_nerf.build(replace(config, devices=DeviceConfig(at_once=config.rays)), problem)
    state = jax.eval_shape(whole.trainer.start, jax.random.key(0))
    return whole.trainer.advance.lower(state, whole.views, 1).cost_analysis()["flops"]


def timed(config: NerfConfig, problem, flop: float, peak: float, repeats: int) -> float | None:
    """Median seconds of a step, printed beside the rest; None where it does not fit."""
    job = devices.join(config.devices, {}, lambda update: None)
    name = f"  {config.devices.at_once:5} at once, {config.precision:13}"
    try:
        with devices.guarded(job):
            built = noisy_nerf.build(config, problem)
            state, views = built.trainer.start(jax.random.key(0)), built.views
            with devices.spread_over(job, config.precision):
                step = built.trainer.advance.lower(state, views, 1).compile()
            devices.check_memory(step)
            taken = in_turn({"step": lambda: step(state, views)}, repeats)["step"]
    except DataError as error:
        print(f"{name} {error}", flush=True)
        return None
    median = float(np.median(taken))
    needs = devices.needed_bytes(step) / 2**30
    print(
        f"{name} {milliseconds(taken)}, {flop / median / 1e12:.3g} TFLOP/s, "
        f"{100 * flop / median / peak:.0f}% of a product's {peak / 1e12:.3g}, {needs:.2f} GiB",
        flush=True,
    )
    return median


def timings(config: NerfConfig, at_once: Sequence[int], repeats: int) -> int:
    """Print them; returns how many rays at once are fastest."""
    problem = load(config)
    flop = step_flop(config, problem)
    large = 2048 if jax.default_backend() == "cpu" else 16384
    print(f"step of {config.rays} rays: {flop / 1e12:.3g} TFLOP")
    with_at_once = lambda n: replace(config, devices=DeviceConfig(count=1, at_once=n))
    peak = product_rate(config.precision, large)
    taken = {n: timed(with_at_once(n), problem, flop, peak, repeats) for n in at_once}
    fits = {n: seconds for n, seconds in taken.items() if seconds is not None}
    if not fits:
        raise SystemExit("paper_on_gpu: expected a step that fits the device, got none")
    fastest = min(fits, key=lambda n: fits[n])
    for precision in PRECISIONS:
        # A CPU has one precision.
        if precision != config.precision and jax.default_backend() != "cpu":
            other = replace(with_at_once(fastest), precision=precision)
            timed(other, problem, flop, product_rate(precision, large), repeats)
    return fastest


def trained(config: NerfConfig, until: float) -> None:
    """Train until the time is up or the steps are done, and print how far it came."""
    began: list[tuple[float, int]] = []

    def watch(update: Update) -> None:
        if update.phase == "training":
            now = time.perf_counter()
            began.append((now, update.done))
            if now + (now - began[-2][0] if len(began) > 1 else 0) > until:
                raise TimeIsUp

    try:
        outcome = pipeline.run(config, watch)
        print(f"finished: {outcome.results['rotation_error_deg']:.4f} degrees, {config.out}")
    except TimeIsUp:
        pass
    if len(began) < 2:
        print("no 200 steps fitted")
        return
    (first_s, first), (last_s, last) = began[0], began[-1]
    each = (last_s - first_s) / (last - first)
    steps = noisy_nerf.PAPER.steps if config.steps is None else config.steps
    print(
        f"steps {first} to {last} of {steps}: {1e3 * each:.1f} ms each; {steps} such steps take "
        f"{steps * each / 3600:.2f} hours"
    )
    with np.load(config.out / "checkpoint.npz") as file:
        history = file[".history"]
    done = history[np.isfinite(history[:, 0])]
    if len(done):
        step, loss, rotation, translation, seconds = done[-1]
        print(
            f"checkpoint at step {step:.0f}: loss {loss:.5f}, rotation {rotation:.3f} degrees, translation "
            f"{translation:.4f} units, after {seconds:.0f} s of training"
        )


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    until = time.perf_counter() + 60 * config.minutes
    print(machine(), flush=True)
    settings = NerfConfig(
        preset="paper",
        noise_translation=0.2,
        rays=config.rays,
        image_width=config.image_width,
        orbit_views=config.orbit_views,
        precision=config.precision,
        out=config.out,
        resume=config.out.exists(),
    )
    fastest = timings(settings, config.at_once, config.repeats)
    print(f"memory {jnp.zeros(()).device.memory_stats() or 'is not counted here'}")
    trained(replace(settings, devices=DeviceConfig(count=1, at_once=fastest)), until)


if __name__ == "__main__":
    main()
