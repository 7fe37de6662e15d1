"""Joint training of a scene and a pose field, and sums over many items in the memory of a few."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxpose import optim
from jaxpose.fields import set_progress
from jaxpose.training import devices

Params: TypeAlias = Any
Batch: TypeAlias = Any
Init: TypeAlias = Callable[[PRNGKeyArray], Params]


@runtime_checkable
class JointLoss(Protocol):
    """The loss of one step: `loss(scene_params, pose_params, data, key)`, a scalar."""

    def __call__(
        self, scene_params: Params, pose_params: Params, data: Batch, key: PRNGKeyArray, /
    ) -> Float[Array, ""]: ...


class State(NamedTuple):
    """State of a training between two steps. A checkpoint stores exactly this."""

    scene: Params
    pose: Params
    opt_state: Any
    key: PRNGKeyArray
    step: Int[Array, ""]  # how many are done


class Trainer(NamedTuple):
    """Compiled functions of one training.

    `start(key)` is the state before the first step; `advance(state, data, count)` takes `count` (static)
    steps on the data and returns the new state and the loss of each step. Within
    `with jax.set_mesh(training.mesh()):` both use all devices: parameters are on each, rays are spread.
    """

    start: Callable[[PRNGKeyArray], State]
    advance: jax.stages.Wrapped


class Decay(NamedTuple):
    """A learning rate over a training: exponential from `first` to `last`, 0 before the share `start` of it.

    >>> rate = Decay(1e-2, 1e-4, start=0.25).schedule(100)
    >>> print(*(f"{rate(step):.6f}" for step in (0, 24, 25, 50, 100)))
    0.000000 0.000000 0.003162 0.001000 0.000100
    """

    first: float
    last: float
    start: float = 0.0

    def schedule(self, steps: int) -> optax.Schedule:
        """The rate as an optax schedule, for a training of so many steps.

        Raises:
            ValueError: For rates that are not positive, and a start outside [0, 1].
        """
        if min(self.first, self.last) <= 0 or not 0 <= self.start <= 1:
            raise ValueError(f"Decay: expected first, last > 0 and start in [0, 1], got {tuple(self)}")
        waits = math.ceil(self.start * steps - 1e-6)
        decay = optax.exponential_decay(self.first, steps, self.last / self.first)
        if waits == 0:
            return decay
        return optax.join_schedules([optax.constant_schedule(0.0), lambda step: decay(step + waits)], [waits])


def adam(rates: Any, steps: int) -> optax.GradientTransformation:
    """Adam with a rate for each part of the parameters, as BARF and Ma et al. 2024 train.

    Args:
        rates: A prefix of `{"scene": scene_params, "pose": pose_params}` whose leaves are `Decay`s, optax
            schedules, or numbers; 0 keeps a part as it is.
        steps: The length of the training.

    Returns:
        An optimizer for `joint`, and any other pytree that `rates` is a prefix of.

    >>> optimizer = adam({"scene": Decay(1e-3, 1e-4), "pose": 0.0}, 100)
    >>> params = {"scene": jnp.ones(()), "pose": jnp.ones(())}
    >>> optim.apply(optimizer, params, params, optimizer.init(params))[0]
    {'pose': Array(1., dtype=float32), 'scene': Array(0.999, dtype=float32)}
    """
    is_decay = lambda rate: isinstance(rate, Decay)
    rates = jax.tree.map(
        lambda rate: rate.schedule(steps) if is_decay(rate) else rate, rates, is_leaf=is_decay
    )
    return optax.chain(optax.scale_by_adam(), optim.scale_by_rates(rates))


def joint(
    loss: JointLoss, init_scene: Init, init_pose: Init, optimizer: optax.GradientTransformation, steps: int
) -> Trainer:
    """Optimise a loss jointly over the parameters of a scene and of poses (Ma et al. 2024, eq. 3).

    Coarse-to-fine windows of scene and field (`progress` among their parameters) follow the steps.

    Args:
        loss: `loss(scene_params, pose_params, data, key)`, a scalar; `key` is another in every step.
        init_scene: `init_scene(key)`, the scene's parameters at the start.
        init_pose: Likewise the pose field's.
        optimizer: Any optax transformation of `{"scene": scene_params, "pose": pose_params}`. Parts get
            optimizers of their own by `optax.partition`; `adam` gives them rates of their own.
        steps: The length of the training, to which the windows refer.

    Returns:
        The compiled steps; scene and poses of their state are `state.scene` and `state.pose`.

    Raises:
        ValueError: For `steps` below 1.

    >>> loss = lambda scene, pose, data, key: jnp.sum((scene + pose - data) ** 2)
    >>> zero = lambda key: jnp.zeros(())
    >>> parts = {"scene": optax.sgd(0.1), "pose": optax.set_to_zero()}
    >>> trainer = joint(loss, zero, zero, optax.partition(parts, {"scene": "scene", "pose": "pose"}), 50)
    >>> state, losses = trainer.advance(trainer.start(jax.random.key(0)), jnp.float32(3), 50)
    >>> print(f"{state.scene:.3f} {state.pose:.3f} {losses[0]:.3f} {losses[-1]:.3f}")
    3.000 0.000 9.000 0.000
    """
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")

    def start(key):
        scene_key, pose_key, key = jax.random.split(key, 3)
        params = {"scene": init_scene(scene_key), "pose": init_pose(pose_key)}
        opt_state = optimizer.init(params)
        state = State(**params, opt_state=opt_state, key=key, step=jnp.zeros((), jnp.int32))
        return devices.replicated(state)

    def step(state, _, data):
        key, loss_key = jax.random.split(state.key)
        progress = state.step.astype(jnp.zeros(()).dtype) / steps
        params = {"scene": _at(state.scene, progress), "pose": _at(state.pose, progress)}
        of_params = lambda params: loss(params["scene"], params["pose"], data, loss_key)
        value, gradient = jax.value_and_grad(of_params)(params)
        params, opt_state = optim.apply(optimizer, params, gradient, state.opt_state)
        state = State(**params, opt_state=opt_state, key=key, step=state.step + 1)
        return devices.replicated(state), value

    def advance(state, data, count):
        return jax.lax.scan(partial(step, data=data), state, length=count)

    return Trainer(jax.jit(start), jax.jit(advance, static_argnums=2))


def microbatched_sum(
    loss: Callable[[Params, Any], Float[Array, ""]], chunk: int
) -> Callable[[Params, Batch], Float[Array, ""]]:
    """The sum of a loss over many items, computed `chunk` items at a time: for reverse mode only.

    Gradients reach `params` and `batch`, so that rays, say, may depend on poses that are trained too. They
    are computed with the value, one chunk after the other, and the backward pass only scales them: what is
    stored is never more than one chunk's intermediate values. Whole numbers and random keys in `batch` get no
    gradient, nor does anything else that `loss` refers to: it must come in by the two arguments.

    Args:
        loss: `loss(params, item)`, a scalar, of one item.
        chunk: How many items are computed at a time, vmapped.

    Returns:
        `total(params, batch)`; `batch` is a pytree whose arrays share their leading axis, that of items.

    Raises:
        ValueError: For `chunk` below 1.

    >>> total = microbatched_sum(lambda params, item: params * item**2, chunk=2)
    >>> value, gradient = jax.value_and_grad(total)(jnp.float32(3), jnp.arange(5.0))
    >>> print(value, gradient)
    90.0 30.0
    """
    if chunk < 1:
        raise ValueError(f"chunk: expected at least 1 item, got {chunk}")

    def summed(params, items):
        return jnp.sum(jax.vmap(loss, in_axes=(None, 0))(params, items))

    @jax.custom_vjp
    def total(params, batch):
        return _over_microbatches(lambda items: (summed(params, items), ()), batch, chunk)[0]

    def forward(params, batch):
        leaves, structure = jax.tree.flatten(batch)
        real = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]

        def of_chunk(leaves):
            def value(params, moved):
                merged = iter(moved)
                both = [next(merged) if is_real else leaf for leaf, is_real in zip(leaves, real, strict=True)]
                return summed(params, jax.tree.unflatten(structure, both))

            moved = [leaf for leaf, is_real in zip(leaves, real, strict=True) if is_real]
            result, (of_params, of_moved) = jax.value_and_grad(value, argnums=(0, 1))(params, moved)
            return (result, of_params), of_moved

        (result, of_params), of_moved = _over_microbatches(of_chunk, leaves, chunk)
        moved = iter(of_moved)
        of_batch = jax.tree.unflatten(structure, [next(moved) if is_real else None for is_real in real])
        return result, (of_params, of_batch)

    def backward(gradients, cotangent):
        return jax.tree.map(lambda gradient: gradient * cotangent.astype(gradient.dtype), gradients)

    total.defvjp(forward, backward)
    return total


def _over_microbatches(
    function: Callable[[Batch], tuple[Any, Any]], batch: Batch, chunk: int
) -> tuple[Any, Any]:
    """Sum of the first results of `function` over chunks of `batch`, and its second results joined.

    Each device adds up its own part of the batch; only the sums of the devices are added across them.
    """
    count, parts = len(jax.tree.leaves(batch)[0]), devices.shards()
    if parts == 1:
        return _in_turn(function, batch, chunk)
    if count % parts:
        raise ValueError(f"devices: expected a number that divides {count} rays or pixels, got {parts}")
    batch = devices.spread(jax.tree.map(lambda x: x.reshape(parts, count // parts, *x.shape[1:]), batch))
    sums, joined = jax.vmap(lambda part: _in_turn(function, part, chunk))(batch)
    joined = jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), joined)
    return jax.tree.map(lambda x: jnp.sum(x, axis=0), sums), joined


def _in_turn(function: Callable[[Batch], tuple[Any, Any]], batch: Batch, chunk: int) -> tuple[Any, Any]:
    """The same on one device, one chunk after the other."""
    count = len(jax.tree.leaves(batch)[0])
    whole = count - count % chunk
    sums = []
    joined = []
    if whole:
        chunks = jax.tree.map(lambda x: x[:whole].reshape(-1, chunk, *x.shape[1:]), batch)
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), chunks)
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function, shapes)[0])

        def step(total, items):
            result, rest = function(items)
            return jax.tree.map(jnp.add, total, result), rest

        total, rest = jax.lax.scan(step, zero, chunks)
        sums.append(total)
        joined.append(jax.tree.map(lambda x: x.reshape(whole, *x.shape[2:]), rest))
    if whole < count:
        total, rest = function(jax.tree.map(lambda x: x[whole:], batch))
        sums.append(total)
        joined.append(rest)
    return jax.tree.map(lambda *x: sum(x[1:], x[0]), *sums), jax.tree.map(
        lambda *x: jnp.concatenate(x), *joined
    )


def _at(params: Params, progress: Float[Array, ""]) -> Params:
    """Parameters whose coarse-to-fine window, if they have one, is where the training is."""
    has_window = isinstance(params, dict) and "progress" in params
    return set_progress(params, progress) if has_window else params
