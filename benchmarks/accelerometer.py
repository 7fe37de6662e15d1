"""Cost of a training step of the accelerometer loss: second time derivatives of a PoseNet's translation.

A step is the L1 loss of `accelerometer_residual` at 4096 times, its gradient, and Adam. The loss does not
depend on RotsNet, but that cannot be seen through a pose matrix: with all parameters differentiated, as much
is computed for RotsNet's zero gradient as for TransNet's. Where the accelerometer stands alone, differentiate
TransNet alone.

    python benchmarks/accelerometer.py --help
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax
import tyro
from timing import in_turn, machine, milliseconds, product_gflops

from jaxpose import optim
from jaxpose.fields import PoseNetConfig, posenet
from jaxpose.imu import accelerometer_residual


@dataclass(frozen=True)
class Config:
    """What to measure and how often."""

    times: int = 4096
    repeats: int = 9
    field: PoseNetConfig = PoseNetConfig(activation="softplus")


def make_step(config: Config, trained: tuple[str, ...]):
    """The compiled step that trains the named networks, with its arguments."""
    field = posenet(config.field)
    adam = optax.adam(1e-3)
    fixed = field.init(jax.random.key(0))
    times = jnp.linspace(*config.field.span, config.times)
    measured = jax.random.normal(jax.random.key(1), (config.times, 3))
    R_ref_body = jnp.broadcast_to(jnp.eye(3), (config.times, 3, 3))

    def loss_fn(params, fixed):
        pose_fn = lambda t: field.pose(fixed | params, t)
        return jnp.mean(jnp.abs(accelerometer_residual(pose_fn, times, measured, R_ref_body)))

    def step(params, state, fixed):
        loss, gradient = jax.value_and_grad(loss_fn)(params, fixed)
        return *optim.apply(adam, params, gradient, state), loss

    params = {name: fixed[name] for name in trained}
    arguments = (params, adam.init(params), fixed)
    return jax.jit(step).lower(*arguments).compile(), arguments


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    steps = {
        "TransNet": make_step(config, ("translation",)),
        "TransNet and RotsNet": make_step(config, ("translation", "rotation")),
    }
    runs = {name: lambda step=step, args=args: step(*args) for name, (step, args) in steps.items()}
    times = in_turn(runs, config.repeats)
    print(f"{machine()}, {product_gflops():.0f} GFLOP/s in a matrix product")
    print(
        f"accelerometer loss at {config.times} times, {config.field.layers} x {config.field.width}, per step:"
    )
    for name, taken in times.items():
        gflop = steps[name][0].cost_analysis()["flops"] / 1e9
        print(f"  {name:22s}{milliseconds(taken)}   {gflop:.1f} GFLOP by XLA's count")


if __name__ == "__main__":
    main()
