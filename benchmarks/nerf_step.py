"""Cost of one joint training step of BARF's network, pose table against PoseNet (the paper's table 15, left).

A step draws rays from 100 images of 400 x 400, samples each 128 times, takes the gradient with respect to
scene and poses, and one step of Adam on both. FLOPs are the compiler's own count of the step before it
optimises; a product of n numbers counts 2 n.

    python benchmarks/nerf_step.py --help
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from timing import in_turn, machine, milliseconds, product_gflops

from jaxpose import fields, scenes
from jaxpose._memory import peak_rss_bytes
from jaxpose.geometry.camera import Camera
from jaxpose.training import photometric
from jaxpose.training.photometric import Depths, TrainConfig, Views
from jaxpose.training.steps import Decay, Trainer, adam

SIZE, IMAGES = 400, 100
CAMERA = Camera(555.6, 555.6, 199.5, 199.5, SIZE, SIZE)
DEPTHS = Depths(2.0, 6.0)


@dataclass(frozen=True)
class Config:
    """What to measure."""

    rays: tuple[int, ...] = (1024, 4096)
    samples: int = 128
    chunk: int = 32  # rays computed at a time
    repeats: int = 5


def trainer(pose: str, config: TrainConfig) -> Trainer:
    t = np.arange(float(IMAGES))
    if pose == "table":
        field, rates = fields.per_frame_poses(t), Decay(1e-3, 1e-5)
    else:
        field = fields.posenet(fields.PoseNetConfig(span=(0.0, t[-1])))
        rates = {"translation": Decay(1e-3, 1e-5), "rotation": Decay(2e-4, 1e-6)}
    start = jnp.eye(4).at[2, 3].set(-4.0)
    field = fields.right_correction(field, fields.constant(start))
    optimizer = adam({"scene": Decay(5e-4, 1e-4), "pose": rates}, config.steps)
    return photometric.trainer(scenes.nerf(), field, CAMERA, DEPTHS, optimizer, config)


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    print(machine(), f"{product_gflops():.0f} GFLOP/s in a 2048 x 2048 product", sep=", ")
    images = np.random.default_rng(0).integers(0, 256, (IMAGES, SIZE, SIZE, 3), np.uint8)
    views = Views(jnp.arange(float(IMAGES)), jnp.asarray(images))
    for rays in config.rays:
        settings = TrainConfig(rays=rays, samples=config.samples, chunk=config.chunk)
        runs, gflop, sizes = {}, {}, {}
        for pose in ("table", "posenet"):
            compiled = trainer(pose, settings)
            state = compiled.start(jax.random.key(0))
            runs[pose] = lambda compiled=compiled, state=state: compiled.advance(state, views, 1)[1]
            # In one chunk, as the count takes a loop's body once.
            whole = trainer(pose, TrainConfig(rays=rays, samples=config.samples, chunk=rays))
            gflop[pose] = whole.advance.lower(state, views, 1).cost_analysis()["flops"] / 1e9
            sizes[pose] = (
                sum(x.size for x in jax.tree.leaves((state.scene, state.pose))) - 1
            )  # the window's place
        times = in_turn(runs, config.repeats)
        print(f"\n{rays} rays x {config.samples} samples, {config.chunk} rays at a time")
        for pose, taken in times.items():
            rate = gflop[pose] / np.median(taken)
            print(
                f"  {pose:8} {milliseconds(taken)}, {gflop[pose]:7.1f} GFLOP, {rate:4.0f} GFLOP/s, "
                f"{sizes[pose]:,} parameters"
            )
        added = 100 * (np.median(times["posenet"] / times["table"]) - 1)
        most = peak_rss_bytes() / 2**30
        print(f"  PoseNet adds {added:.1f}% of time; {most:.2f} GiB of memory at most so far")


if __name__ == "__main__":
    main()
