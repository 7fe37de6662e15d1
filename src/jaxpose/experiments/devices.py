"""Devices that a training is spread over, in one process or in several; what does not fit is one line."""

import os
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_least
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.experiments.rendezvous import address_of, meet
from jaxpose.files import run_folder
from jaxpose.training import devices

Precision = Literal["tensorfloat32", "float32", "bfloat16"]
# What JAX calls them. The first is what it does by itself on a GPU.
PRODUCTS = {"tensorfloat32": None, "float32": "highest", "bfloat16": "BF16_BF16_F32"}
_LEAVE_S, _HEARTBEAT_S = 30, 30  # that processes may end apart, and that one may be silent
_AT_ONCE = 1024
T = TypeVar("T")


@dataclass(frozen=True)
class DeviceConfig:
    """Devices that the rays of a step are spread over."""

    count: int | None = None  # of this process; None: all that it sees
    processes: int = 1  # on one machine or several, each started with the same command
    process: int = 0  # which of them this is; process 0 writes the run folder
    coordinator: str | None = None  # HOST:PORT at which process 0 waits for the others
    wait_s: float = 60.0  # [s] for the other processes at the start
    at_once: int | None = None  # rays that a device computes together; None: 16 to 64 on a CPU, else 1024

    def chunk(self, on_cpu: int) -> int:
        """Rays that a device computes together.

        Args:
            on_cpu: That many on a CPU, whose caches hold no more.

        Returns:
            What is asked for, or what suits the device.
        """
        return self.at_once or (on_cpu if jax.default_backend() == "cpu" else _AT_ONCE)


class Job(NamedTuple):
    """The devices of a training, and this process among those that hold them."""

    mesh: Mesh
    process: int
    processes: int

    @property
    def writes(self) -> bool:
        """Whether this process writes the run folder."""
        return self.process == 0


def followed(job: Job) -> dict[str, Any]:
    """Results of a process that writes none.

    Args:
        job: Of `join`.

    Returns:
        Which process of how many it is.
    """
    return {"process": job.process, "processes": job.processes}


def follower_report(results: Mapping[str, Any]) -> str:
    """What a process that writes nothing prints.

    Args:
        results: Of `followed`.

    Returns:
        One line.
    """
    return f"process {results['process']} of {results['processes']}: process 0 has the results"


def join(config: DeviceConfig, settings: Mapping[str, Any], on_update: OnUpdate) -> Job:
    """Meet the other processes, if there are any, and take the devices that the config names.

    Several processes have to join before anything is computed; `leave` ends it.

    Args:
        config: Which devices and processes.
        settings: What all processes must have in common.
        on_update: Called before it waits.

    Returns:
        The devices.

    Raises:
        DataError: For processes that do not come or do not fit, and devices that are not there.
    """
    if config.coordinator is not None:
        on_update(Update(f"meeting {config.processes} processes at {config.coordinator}"))
        place = config.coordinator, config.processes, config.process
        meet(*place, {**settings, "devices.count": config.count}, config.wait_s)
        jax.distributed.initialize(
            *place,
            cluster_detection_method="deactivate",
            shutdown_timeout_seconds=_LEAVE_S,
            heartbeat_timeout_seconds=_HEARTBEAT_S,
        )
    local = jax.local_device_count()
    count = local if config.count is None else config.count
    if count > local:
        kind = jax.devices()[0].device_kind
        raise DataError(f"--devices.count: expected at most {local}, as there are ({kind}), got {count}")
    of_process = lambda index: [device for device in jax.devices() if device.process_index == index]
    chosen = [device for index in range(config.processes) for device in of_process(index)[:count]]
    return Job(devices.mesh(chosen), config.process, config.processes)


def leave(job: Job) -> None:
    """Part from the other processes: each goes on by itself.

    Args:
        job: Of `join`.
    """
    if job.processes > 1:
        jax.distributed.shutdown()


def from_first(job: Job, tree: T) -> T:
    """What process 0 has, in every process.

    Args:
        job: Of `join`.
        tree: A pytree of arrays, numbers and random keys, of the same shapes in every process.

    Returns:
        That of process 0.
    """
    if job.processes == 1:
        return tree
    leaves, structure = jax.tree.flatten(tree)
    sent = multihost_utils.broadcast_one_to_all([_data(leaf) for leaf in leaves])
    received = [_like(leaf, data) for leaf, data in zip(leaves, sent, strict=True)]
    return jax.tree.unflatten(structure, received)


def on_all(job: Job, tree: T) -> T:
    """A pytree of arrays on every device of the mesh.

    Args:
        job: Of `join`.
        tree: The same in every process.

    Returns:
        The same values.
    """
    everywhere = NamedSharding(job.mesh, PartitionSpec())
    return jax.jit(lambda tree: tree, out_shardings=everywhere)(tree)


def on_one(tree: T) -> T:
    """What every device holds, on this process's first alone.

    Args:
        tree: A pytree of arrays that `on_all` has placed, or that a training step returns.

    Returns:
        The same values.
    """
    return jax.tree.map(lambda leaf: _like(leaf, np.asarray(_data(leaf).addressable_data(0))), tree)


@contextmanager
def spread_over(job: Job, precision: Precision) -> Iterator[None]:
    """What is compiled within the block is spread over the devices, with products of this precision.

    Args:
        job: Of `join`.
        precision: Of products of float32 matrices in networks of scenes.

    Returns:
        Nothing, for the length of the `with` block.
    """
    with jax.set_mesh(job.mesh), jax.default_matmul_precision(PRODUCTS[precision]):
        yield


@contextmanager
def guarded(job: Job) -> Iterator[None]:
    """What devices cannot do within the block is a line of text.

    Args:
        job: Of `join`.

    Returns:
        Nothing, for the length of the `with` block.

    Raises:
        DataError: Where memory does not suffice, or another process is lost.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        line = " ".join(str(error).split())
        if "RESOURCE_EXHAUSTED" in line:
            raise DataError(_too_large(line)) from None
        if job.processes > 1:
            raise DataError(f"expected all {job.processes} processes until the end, got: {line}") from None
        raise


def check_devices(config: Any) -> None:
    """Refuse devices and processes that do not go together.

    Args:
        config: Of an experiment, with `devices` and `study`.

    Raises:
        ValueError: For numbers out of their range, a coordinator that is missing or needless, and a study in
            several processes.
    """
    least = {"count": 1, "processes": 1, "process": 0, "wait_s": 0, "at_once": 1}
    check_least(config, **{f"devices.{name}": number for name, number in least.items()})
    found = config.devices
    if found.process >= found.processes:
        raise ValueError(
            f"--devices.process: expected less than --devices.processes {found.processes}, "
            f"got {found.process}"
        )
    if (found.processes > 1) != (found.coordinator is not None):
        expected = "none" if found.coordinator else "HOST:PORT of process 0"
        raise ValueError(
            f"--devices.coordinator: expected {expected} with --devices.processes {found.processes}, "
            f"got {found.coordinator or 'none'}"
        )
    if found.coordinator is not None:
        address_of(found.coordinator)
    if config.study is not None and found.processes > 1:
        raise ValueError(f"--study: expected one process, got --devices.processes {found.processes}")


def opened(job: Job, path: Path) -> AbstractContextManager[Path]:
    """The run folder, which process 0 makes.

    Args:
        job: Of `join`.
        path: Of the folder.

    Returns:
        The same, for the length of the `with` block.
    """
    return run_folder.opened(path) if job.writes else nullcontext(path)


def check_divides(job: Job, option: str, items: int) -> None:
    """Refuse devices that cannot each have the same share.

    Args:
        job: Of `join`.
        option: That names the items.
        items: Rays or pixels of a step.

    Raises:
        DataError: Where they do not divide.
    """
    if items % job.mesh.size:
        raise DataError(
            f"--devices.count: expected devices whose number divides {option} {items}, got {job.mesh.size}"
        )


def check_memory(compiled: jax.stages.Compiled) -> None:
    """Refuse what does not fit the device, before it runs.

    Args:
        compiled: A compiled function.

    Raises:
        DataError: Where it needs more memory than a device has.
    """
    need = needed_bytes(compiled)
    device = jax.local_devices()[0]
    limit = (device.memory_stats() or {}).get("bytes_limit")
    if limit is None:  # a CPU's, which forced devices share
        limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / jax.local_device_count()
    if need > limit:
        sizes = f"{need / 2**30:.1f} GiB of {limit / 2**30:.1f} ({device.device_kind})"
        raise DataError(_too_large(f"{sizes}; fewer at once, fewer rays or more devices take less"))


def needed_bytes(compiled: jax.stages.Compiled) -> int:
    """Memory that a compiled function takes on each device.

    Args:
        compiled: A compiled function.

    Returns:
        [bytes] of arguments, results and what is between.
    """
    found: Any = compiled.memory_analysis()
    whole = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    return whole - found.alias_size_in_bytes


def _data(leaf: Any) -> Any:
    is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


def _like(leaf: Any, data: Any) -> jax.Array:
    """Data as an array of this process's first device, and as a random key where `leaf` is one."""
    array = jnp.asarray(np.asarray(data))
    return array if _data(leaf) is leaf else jax.random.wrap_key_data(array, impl=jax.random.key_impl(leaf))


def _too_large(got: str) -> str:
    return f"--devices.at-once: expected a step that fits the device's memory, got {got}"
