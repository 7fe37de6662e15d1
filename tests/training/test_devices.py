"""Rays spread over devices: the numbers are those of one device, and what does not divide is refused."""

import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractMesh, AxisType
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose import training
from jaxpose.training import microbatched_sum
from jaxpose.training.devices import shards

STEPS = 200
# Losses of a small training on images of a known pattern; what the compiled step sends is counted.
# Rates fall: with high ones that stay, sums in another order on one device part by 3% as well.
SCRIPT = """
import sys
import jax
process, processes, port, out, *resumed = sys.argv[1:]
if int(processes) > 1:
    jax.distributed.initialize(f"localhost:{port}", int(processes), int(process))
import jax.numpy as jnp
import numpy as np
from jaxpose import fields, scenes, training
from jaxpose.files import checkpoint
from jaxpose.geometry.camera import Camera
from jaxpose.training import photometric

t = np.arange(4.0)
column, row = np.meshgrid(np.arange(16), np.arange(16))
images = [np.stack([9 * (column + k), 9 * (row + 2 * k), 5 * (column + row)], -1) for k in range(4)]
views = training.Views(jnp.asarray(t, jnp.float32), jnp.asarray(np.stack(images), jnp.uint8))
scene = scenes.nerf(scenes.NerfConfig(layers=2, width=16, skip=None, colour_width=8, octaves=4))
field = fields.posenet(fields.PoseNetConfig(span=(0.0, 3.0), layers=2, width=16))
start = fields.constant(jnp.eye(4).at[2, 3].set(-4.0))
field = fields.right_correction(field, start)
decay = training.Decay
of_poses = {"translation": decay(1e-3, 1e-5), "rotation": decay(2e-4, 1e-6)}
rates = {"scene": decay(5e-4, 1e-4), "pose": of_poses}
config = training.TrainConfig(steps=STEPS, rays=48, samples=8, chunk=10)
trainer = photometric.trainer(
    scene, field, Camera(16.0, 16.0, 7.5, 7.5, 16, 16), training.Depths(2.0, 6.0),
    training.adam(rates, STEPS), config,
)
with jax.set_mesh(training.mesh()):
    state = trainer.start(jax.random.key(0))
    step = trainer.advance.lower(state, views, STEPS // 2).compile()
    losses = []
    if resumed:
        state = checkpoint.load(resumed[0], state)
    else:
        state, first = step(state, views)
        checkpoint.save(out + ".checkpoint.npz", state)
        losses.append(np.asarray(first))
    losses.append(np.asarray(step(state, views)[1]))
sent = {name: step.as_text().count(f" {name}(") for name in ("all-reduce", "all-gather", "all-to-all")}
np.savez(out, losses=np.concatenate(losses), devices=jax.device_count(), **sent)
""".replace("STEPS", str(STEPS))


def trained(out, devices, processes=1, resumed=()):
    """What the script leaves, run on so many devices in so many processes, anew or from a checkpoint."""
    with socket.create_server(("", 0)) as free:
        port = free.getsockname()[1]
    of_process = devices // processes
    environment = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={of_process}"}
    command = [sys.executable, "-c", SCRIPT]
    started = [
        subprocess.Popen(
            [*command, str(k), str(processes), str(port), out / f"{devices}-{processes}-{k}.npz", *resumed],
            env=environment,
        )
        for k in range(processes)
    ]
    assert [process.wait() for process in started] == [0] * processes
    with np.load(out / f"{devices}-{processes}-{processes - 1}.npz") as file:
        return dict(file)


@pytest.mark.slow
def test_two_devices_and_two_processes_have_the_losses_of_one_device(tmp_path):
    one = trained(tmp_path, 1)
    two_devices, two_processes = trained(tmp_path, 2), trained(tmp_path, 2, processes=2)
    assert one["losses"].shape == (STEPS,) and one["losses"][-1] < 0.5 * one["losses"][0]
    for found in (two_devices, two_processes):
        assert found["devices"] == 2
        assert_allclose(found["losses"], one["losses"], rtol=1e-4)
        # One sum of all gradients a step, outside the loop over chunks; rays stay where they are.
        assert (found["all-reduce"], found["all-gather"], found["all-to-all"]) == (1, 0, 0)
    assert one["all-reduce"] == 0
    on_one = trained(tmp_path, 1, resumed=[tmp_path / "2-1-0.npz.checkpoint.npz"])
    assert_allclose(on_one["losses"], one["losses"][STEPS // 2 :], rtol=1e-4)


def test_without_a_mesh_and_with_a_mesh_of_one_device_the_sum_is_the_same():
    total = jax.jit(jax.value_and_grad(microbatched_sum(lambda params, x: jnp.sin(params * x), 3)))
    x = jnp.arange(7.0)
    plain = total(jnp.float32(2), x)
    with jax.set_mesh(training.mesh()):
        assert shards() == 1
        assert_array_equal(jnp.stack(total(jnp.float32(2), x)), jnp.stack(plain))
    assert_allclose(plain[0], np.sin(2 * np.arange(7)).sum(), rtol=1e-6)


def test_devices_that_do_not_divide_the_rays_are_refused():
    total = microbatched_sum(lambda params, x: params * x, 2)
    with jax.sharding.use_abstract_mesh(AbstractMesh((3,), ("rays",), axis_types=(AxisType.Auto,))):
        assert shards() == 3
        with pytest.raises(
            ValueError, match="devices: expected a number that divides 8 rays or pixels, got 3"
        ):
            jax.eval_shape(total, jnp.float32(1), jnp.ones(8))
