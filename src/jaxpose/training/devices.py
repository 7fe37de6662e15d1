"""Data parallelism: parameters are on every device, and each device has its share of a step's rays.

What runs within `with jax.set_mesh(mesh()):` is spread over the devices of the mesh, those of other processes
among them; elsewhere everything is on one device. The compiler adds the communication: one sum of gradients
a step.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import jax
from jax.sharding import AxisType, Mesh, PartitionSpec

AXIS = "rays"
T = TypeVar("T")


def mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Devices in a row, for `jax.set_mesh`.

    Args:
        devices: Of JAX; None: all, in a job of several processes those of every process.

    Returns:
        A mesh of one axis, along which rays are spread.

    >>> with jax.set_mesh(mesh()):
    ...     print(shards() == len(jax.devices()))
    True
    """
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def shards() -> int:
    """Over how many devices rays are spread.

    Returns:
        The size of the mesh that is set; 1 where none is.
    """
    return jax.sharding.get_abstract_mesh().shape.get(AXIS, 1)


def spread(tree: T) -> T:
    """Values whose leading axis is that of devices, each part of them on its own device.

    Args:
        tree: A pytree of arrays (`shards()`, ...), within `jax.jit`.

    Returns:
        The same values.
    """
    return _constrained(tree, PartitionSpec(AXIS))


def replicated(tree: T) -> T:
    """Values that every device holds.

    Args:
        tree: A pytree of arrays, within `jax.jit`.

    Returns:
        The same values.
    """
    return _constrained(tree, PartitionSpec())


def _constrained(tree: T, spec: PartitionSpec) -> T:
    return tree if shards() == 1 else jax.lax.with_sharding_constraint(tree, spec)
