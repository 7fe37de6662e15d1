"""Bring a PoseNet to a few poses almost exactly, in a handful of cheap second-order steps."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxpose.fields.types import Params
from jaxpose.geometry import se3


def project_onto_poses(
    poses_of: Callable[[Params], Float[Array, "k 4 4"]],
    params: Params,
    poses: Float[Array, "k 4 4"],
    *,
    steps: int = 6,
    damping: float = 1e-6,
) -> Params:
    """Parameters of a PoseNet at which it has the given poses, near those that it starts from.

    Only the output layers move, in which the network is linear up to its head: each Newton step is the
    shortest change of their weights that brings the poses there to first order, J^T (J J^T)^-1 r. That is
    closer than hundreds of Adam's steps on all layers, at the cost of a few.

    Args:
        poses_of: `params -> (k, 4, 4)`, the field's own poses at some times: a common factor that cancels in
            them would be free to run away.
        params: where to start.
        poses: the poses (k, 4, 4) to come to.
        steps: Newton's.
        damping: a share of the mean of J J^T's diagonal, which lets poses differ a little where they ask for
            what the features cannot tell apart.

    Returns:
        Parameters of the same tree.
    """
    leaves, tree = jax.tree_util.tree_flatten_with_path(params)
    last = _output_layers([path for path, _ in leaves])
    values = [leaf for _, leaf in leaves]

    def residual(moving):
        rest = iter(moving)
        merged = [next(rest) if moves else leaf for moves, leaf in zip(last, values, strict=True)]
        error = se3.compose(se3.inverse(poses), poses_of(jax.tree_util.tree_unflatten(tree, merged)))
        # The twist to first order, which is all that Newton needs, and far quicker to compile than the
        # logarithm.
        turn = se3.vee(error[:, :3, :3] - jnp.swapaxes(error[:, :3, :3], 1, 2)) / 2
        return jnp.concatenate([error[:, :3, 3], turn], axis=-1).ravel()

    def step(_, moving):
        r, pull_back = jax.vjp(residual, moving)
        (jacobian,) = jax.vmap(pull_back)(jnp.eye(r.size, dtype=r.dtype))
        rows = jnp.concatenate([leaf.reshape(r.size, -1) for leaf in jacobian], axis=1)
        gram = jnp.matmul(rows, rows.T, precision="highest")
        gram = gram + damping * jnp.trace(gram) / r.size * jnp.eye(r.size, dtype=r.dtype)
        weight = jnp.linalg.solve(gram, r)
        return [p - jnp.tensordot(weight, j, axes=1) for p, j in zip(moving, jacobian, strict=True)]

    moving = [leaf for moves, leaf in zip(last, values, strict=True) if moves]
    rest = iter(jax.lax.fori_loop(0, steps, step, moving))
    merged = [next(rest) if moves else leaf for moves, leaf in zip(last, values, strict=True)]
    return jax.tree_util.tree_unflatten(tree, merged)


def _output_layers(paths) -> list[bool]:
    """Which leaves belong to the last layer of their network, `layer_<number>` in their path."""
    names = [[entry.key for entry in path] for path in paths]
    networks = [tuple(name[:-2]) for name in names]
    numbers = [int(name[-2].rsplit("_", 1)[1]) if len(name) > 1 else -1 for name in names]
    highest = {
        net: max(n for other, n in zip(networks, numbers, strict=True) if other == net) for net in networks
    }
    return [number >= 0 and number == highest[net] for net, number in zip(networks, numbers, strict=True)]
