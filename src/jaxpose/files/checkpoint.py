"""Checkpoints: a pytree of arrays in one file, written whole or not at all."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpose.errors import DataError
from jaxpose.files.atomic import atomic
from jaxpose.files.untrusted import read_npz


def save(path: Path | str, tree: Any) -> None:
    """Write the arrays and random keys of a pytree (npz, by their place in it).

    Args:
        path: The file, written whole or not at all.
        tree: A pytree of arrays, numbers and random keys.
    """
    arrays = {jax.tree_util.keystr(at): np.asarray(_data(leaf)) for at, leaf in _leaves(tree)}
    with atomic(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def load(path: Path | str, like: Any) -> Any:
    """Read what `save` wrote, bit by bit as it was.

    Args:
        path: The file.
        like: A tree of the same structure, shapes and types.

    Returns:
        A tree like it.

    Raises:
        DataError: Naming the file if it is damaged or holds other arrays.
    """
    return restore(path, read_npz(path, "a checkpoint"), like)


def restore(path: Path | str, arrays: dict[str, np.ndarray], like: Any) -> Any:
    """A tree from the arrays of a checkpoint.

    Args:
        path: The file they are of, for errors.
        arrays: By their place in the tree.
        like: A tree of the same structure, shapes and types.

    Returns:
        A tree like it.

    Raises:
        DataError: Naming the file if there are other arrays.
    """
    arrays, leaves = dict(arrays), []
    for at, leaf in _leaves(like):
        name, data = jax.tree_util.keystr(at), _data(leaf)
        found = arrays.pop(name, None)
        if found is None or (found.shape, found.dtype) != (data.shape, data.dtype):
            got = "nothing" if found is None else f"{found.dtype} of shape {found.shape}"
            raise DataError(f"{path}: expected {name}, {data.dtype} of shape {data.shape}, got {got}")
        leaves.append(_like(leaf, found))
    if arrays:
        raise DataError(f"{path}: expected nothing more, got {', '.join(sorted(arrays)[:3])}")
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _leaves(tree: Any) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_flatten_with_path(tree)[0]


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _like(leaf: Any, found: np.ndarray) -> Any:
    if _is_key(leaf):
        return jax.random.wrap_key_data(jnp.asarray(found), impl=jax.random.key_impl(leaf))
    return jnp.asarray(found) if isinstance(leaf, jax.Array) else found
