"""Layers for very many points, one point at a time: the caller vmaps, and memory is laid out for speed.

What vmap makes of `x @ kernel` keeps the features of a point side by side, and the gradient of the kernel is
then a product of two tall matrices that a processor must first turn around. Here every feature is a row and
every point a column, however many vmaps there are and in both directions of differentiation: on two cores a
NeRF trains 1.2 to 1.5 times as fast. At one point nothing is to be seen of it: `dense` is
`x @ kernel + bias`, and that is what is computed on a JAX that takes no rules of our own.
"""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

Precision = Literal["default", "high", "highest"]


def dense(
    layer: Mapping[str, Float[Array, "..."]], x: Float[Array, " i"], *, precision: Precision | None = None
) -> Float[Array, " o"]:
    """A linear layer `{"kernel": (i, o), "bias": (o,)}` at one point; None: by JAX's setting."""
    return product(layer["kernel"], x, precision=precision) + spread(layer["bias"], x)


def product(
    kernel: Float[Array, "i o"], x: Float[Array, " i"], *, precision: Precision | None = None
) -> Float[Array, " o"]:
    """`x @ kernel` at one point."""
    if _product is None:
        return jnp.matmul(x, kernel, precision=precision)
    return _product.bind(kernel, x, precision=precision)


def spread(values: Shaped[Array, " o"], x: Float[Array, " i"]) -> Shaped[Array, " o"]:
    """`values`, the same for all points that `x` stands for, as rows beside those of `x`."""
    if _spread is None:
        return values
    return _spread.bind(values, x)


def frequency_encoding(
    x: Float[Array, " d"], octaves: int, *, weights: Float[Array, " octaves"] | None = None
) -> Float[Array, " encoded"]:
    """What `nn.frequency_encoding` is, in its order, for one point; no gradient reaches the `weights`."""
    rates = jnp.asarray(_waves_of(x.shape[0], octaves)[0], x.dtype)
    of_octaves = jnp.ones(octaves, x.dtype) if weights is None else weights
    of_rows = jnp.append(jnp.ones(x.shape[0], x.dtype), jnp.tile(of_octaves, 2 * x.shape[0]))
    # A power of two times a number is exact, and zeros add nothing.
    return _waves(x.shape[0], octaves, product(rates, x, precision="highest"), of_rows)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _waves(inputs, octaves, turns, weights):
    """Rows of the encoding from their turns; the first ones are the input itself."""
    _, phases, _ = _waves_of(inputs, octaves)
    # Less whole turns, so that the phase of a high band is exact. Cosines are sines a quarter turn on.
    sines = jnp.sin(
        2 * math.pi * (turns - jnp.round(turns)) + spread(jnp.asarray(phases, turns.dtype), turns)
    )
    is_input = spread(jnp.arange(len(phases)) < inputs, turns)
    return jnp.where(is_input, turns, sines) * spread(weights, turns)


@_waves.defjvp
def _waves_jvp(inputs, octaves, primals, tangents):
    # The derivative of a wave is its partner in the same octave, which has the same weight and is there
    # already: no sine is computed twice.
    encoded = _waves(inputs, octaves, *primals)
    _, phases, partners = _waves_of(inputs, octaves)
    of_input = jnp.asarray(np.arange(len(phases)) < inputs, encoded.dtype)
    slope = product(jnp.asarray(partners, encoded.dtype), encoded, precision="highest")
    return encoded, (slope + spread(of_input, encoded)) * tangents[0]


def _waves_of(inputs: int, octaves: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turns of every row per unit of each input, phase of every row [rad], and the matrix of derivatives.

    The last takes waves to their derivatives by turns: sines to cosines, cosines to sines, times +-2 pi.
    """
    rows = inputs * (1 + 2 * octaves)
    rates, phases, partners = np.zeros((inputs, rows)), np.zeros(rows), np.zeros((rows, rows))
    rates[:, :inputs] = np.eye(inputs)
    for coordinate in range(inputs):
        sines = inputs + 2 * octaves * coordinate + np.arange(octaves)
        cosines = sines + octaves
        rates[coordinate, sines] = rates[coordinate, cosines] = 2.0 ** np.arange(octaves) / 2
        phases[cosines] = math.pi / 2
        partners[cosines, sines] = 2 * math.pi
        partners[sines, cosines] = -2 * math.pi
    return rates, phases, partners


# --- the two primitives ---------------------------------------------------------------------------------
# x is (i, ...) with an axis for every vmap. JAX's own rules would put those axes in front of the features in
# one direction of differentiation, and XLA would copy between the two arrangements at every layer.


def _multiply(kernel, x, *, precision):
    return jax.lax.dot_general(kernel.T, x, (((1,), (0,)), ((), ())), precision=precision)


def _broadcast(values, x):
    # Axes that `values` has beside its first are the first ones of the points of x.
    return jax.lax.broadcast_in_dim(values, (values.shape[0], *x.shape[1:]), tuple(range(values.ndim)))


def _rows(x):
    return x.reshape(x.shape[0], -1)


def _to_kernel(cotangent, kernel, x, *, precision):
    # As matrices: with several axes to sum over, XLA would first copy both.
    over_points = (((1,), (1,)), ((), ()))
    return jax.lax.dot_general(_rows(x), _rows(cotangent), over_points, precision=precision)


def _to_x(cotangent, kernel, x, *, precision):
    return _product.bind(kernel.T, cotangent, precision=precision)


def _to_values(zero, cotangent, values, x):
    if type(cotangent) is zero:
        return cotangent, None
    # As a product: XLA would turn the matrix around for a sum.
    matrix = cotangent.reshape(math.prod(values.aval.shape), -1)
    ones = jnp.ones((matrix.shape[1],), matrix.dtype)
    return jnp.matmul(matrix, ones, precision="highest").reshape(values.aval.shape), None


def _product_of_many(args, axes, *, precision):
    (kernel, x), (kernel_axis, x_axis) = args, axes
    if kernel_axis is not None:
        return jax.vmap(partial(_multiply, precision=precision), axes)(kernel, x), 0
    return _product.bind(kernel, jnp.moveaxis(x, x_axis, 1), precision=precision), 1


def _spread_of_many(args, axes):
    (values, x), (values_axis, x_axis) = args, axes
    many = next(arg.shape[axis] for arg, axis in zip(args, axes, strict=True) if axis is not None)
    if values_axis is not None or values.ndim > 1:
        values = _axis_second(values, values_axis, many)
    return _spread.bind(values, _axis_second(x, x_axis, many)), 1


def _axis_second(x, axis, size):
    if axis is not None:
        return jnp.moveaxis(x, axis, 1)
    return jnp.broadcast_to(jnp.expand_dims(x, 1), (x.shape[0], size, *x.shape[1:]))


def _primitives() -> Any:
    """Product and spread with their rules, or none where this JAX has no place for them.

    JAX keeps these places outside of what it promises not to change. Its public ones do not serve:
    `custom_vmap` has no backward differentiation, `linear_call` no vmap.
    """
    try:
        from jax.core import ShapedArray
        from jax.extend.core import Primitive
        from jax.interpreters import ad, batching, mlir

        product, spread = Primitive("columns_product"), Primitive("columns_spread")
        for primitive, function, many in (
            (product, _multiply, _product_of_many),
            (spread, _broadcast, _spread_of_many),
        ):
            primitive.def_impl(function)
            mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=False))
            batching.primitive_batchers[primitive] = many
        product.def_abstract_eval(
            lambda kernel, x, **_: ShapedArray((kernel.shape[1], *x.shape[1:]), x.dtype)
        )
        spread.def_abstract_eval(lambda values, x: ShapedArray((values.shape[0], *x.shape[1:]), values.dtype))
        ad.defbilinear(product, _to_kernel, _to_x)
        ad.defjvp(spread, lambda tangent, values, x: spread.bind(tangent, x), None)
        ad.primitive_transposes[spread] = partial(_to_values, ad.Zero)
    except (ImportError, AttributeError):
        return None, None
    return product, spread


_product, _spread = _primitives()
