"""Cost of one joint training step on events, both losses, at the size of EventNeRF's batch.

A step compares pixels of a sensor of 346 x 260 at two instants each, renders both with 256 samples a ray
(EventNeRF: 64 in one network, these and 128 more in another), takes the gradient with respect to scene and
PoseNet, and one step of Adam on both. FLOPs are the compiler's own count of the step before it optimises.

    python benchmarks/event_step.py --help
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from timing import in_turn, machine, milliseconds, product_gflops

from jaxpose import fields, scenes
from jaxpose._memory import peak_rss_bytes
from jaxpose.events import PixelIndex
from jaxpose.geometry.camera import Camera
from jaxpose.training import events as event_training
from jaxpose.training.events import EventData, EventTrainConfig
from jaxpose.training.photometric import Depths
from jaxpose.training.steps import Decay, Trainer, adam

WIDTH, HEIGHT = 346, 260
CAMERA = Camera(400.0, 400.0, 172.5, 129.5, WIDTH, HEIGHT)
SPAN = (0.0, 10.0)
RATES = {"translation": Decay(2e-4, 2e-6), "rotation": Decay(5e-5, 5e-7)}


@dataclass(frozen=True)
class Config:
    """What to measure."""

    events: int = 1024  # pixels compared in a step
    samples: int = 256  # along each ray
    chunk: int = 16  # pixels computed at a time
    repeats: int = 5
    recorded: int = 2_000_000  # events of the recording


def data(count: int) -> EventData:
    """Events of random pixels at random times."""
    generator = np.random.default_rng(0)
    pixel = np.sort(generator.integers(0, WIDTH * HEIGHT, count))
    per_pixel = np.bincount(pixel, minlength=WIDTH * HEIGHT)
    t = generator.uniform(*SPAN, count)
    t = t[np.lexsort((t, pixel))]
    level = np.cumsum(generator.choice([-1, 1], count))
    first = np.cumsum(per_pixel) - per_pixel
    whole = lambda x: jnp.asarray(x, jnp.int32)
    streams = PixelIndex(
        jnp.asarray(t, jnp.float32), whole(pixel), whole(level), whole(first), whole(per_pixel)
    )
    return EventData(streams, jnp.ones((WIDTH * HEIGHT, 3)))


def trainer(loss: event_training.Loss, config: Config, chunk: int) -> Trainer:
    field = fields.posenet(fields.PoseNetConfig(span=SPAN))
    start = jnp.eye(4).at[2, 3].set(-4.0)
    field = fields.right_correction(field, fields.constant(start))
    train = EventTrainConfig(events=config.events, samples=config.samples, chunk=chunk, loss=loss)
    optimizer = adam({"scene": 5e-4, "pose": RATES}, train.steps)
    return event_training.trainer(scenes.nerf(), field, CAMERA, Depths(2.0, 6.0), SPAN, optimizer, train)


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    print(machine(), f"{product_gflops():.0f} GFLOP/s in a 2048 x 2048 product", sep=", ")
    recorded = data(config.recorded)
    runs, gflop = {}, {}
    for loss in ("window", "asynchronous"):
        compiled = trainer(loss, config, config.chunk)
        state = compiled.start(jax.random.key(0))
        runs[loss] = lambda compiled=compiled, state=state: compiled.advance(state, recorded, 1)[1]
        # In one chunk, as the count takes a loop's body once.
        whole = trainer(loss, config, config.events)
        gflop[loss] = whole.advance.lower(state, recorded, 1).cost_analysis()["flops"] / 1e9
    times = in_turn(runs, config.repeats)
    print(
        f"\n{config.events} events x 2 instants x {config.samples} samples, {config.chunk} events at a time"
    )
    for loss, taken in times.items():
        rate = gflop[loss] / np.median(taken)
        print(f"  {loss:13} {milliseconds(taken)}, {gflop[loss]:7.1f} GFLOP, {rate:4.0f} GFLOP/s")
    print(f"  {peak_rss_bytes() / 2**30:.2f} GiB of memory at most")


if __name__ == "__main__":
    main()
