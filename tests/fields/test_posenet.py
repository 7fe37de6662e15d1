"""PoseNet against the paper's description: size, start, heads, time scaling, exact derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxpose import fields
from jaxpose.fields import PoseNetConfig, posenet, set_progress
from jaxpose.fields.derivatives import motion

SMALL = dict(layers=3, width=16)


def random_params(field, dtype=jnp.float32, scale=0.4):
    """Parameters of the right shapes that are nowhere zero."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(field.init, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.asarray(scale * rng.normal(size=x.shape), dtype), shapes)


def count(field):
    return sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(field.init, jax.random.key(0))))


def numpy_network(params, t, octaves):
    """A ReLU network of three layers at time t in [-1, 1], in float64."""
    angles = np.pi * t * 2.0 ** np.arange(octaves)
    hidden = np.concatenate([[t], np.sin(angles), np.cos(angles)])
    for i in range(3):
        layer = params[f"layer_{i}"]
        hidden = hidden @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        hidden = np.maximum(hidden, 0) if i < 2 else hidden
    return hidden


def vector(W):
    """Of the skew-symmetric parts of a stack of matrices."""
    return np.stack([W[:, 2, 1] - W[:, 1, 2], W[:, 0, 2] - W[:, 2, 0], W[:, 1, 0] - W[:, 0, 1]], axis=-1) / 2


def test_the_default_has_the_size_of_the_authors_network():
    assert count(posenet()) == 803_079


@pytest.mark.parametrize(
    ("layers", "width", "octaves", "expected"),
    [
        # Weights and biases of a network without its last layer, twice, and last layers of 3 and 4 rows.
        (8, 128, 5, 2 * (12 * 128 + 6 * 129 * 128 + 11 * 128) + 129 * 7),
        (4, 256, 5, 2 * (12 * 256 + 2 * 257 * 256) + 257 * 7),
        (4, 128, 5, 2 * (12 * 128 + 2 * 129 * 128) + 129 * 7),
        (8, 256, 0, 2 * (2 * 256 + 6 * 257 * 256 + 1 * 256) + 257 * 7),
    ],
)
def test_sizes_of_table_12(layers, width, octaves, expected):
    assert count(posenet(PoseNetConfig(layers=layers, width=width, octaves=octaves))) == expected


@pytest.mark.parametrize(
    "config",
    [
        PoseNetConfig(),
        PoseNetConfig(octaves=0, coupled=True),
        PoseNetConfig(octaves=2),
        PoseNetConfig(octaves=10, window=(0.1, 0.5)),
        PoseNetConfig(activation="sigmoid"),
        PoseNetConfig(activation="softplus", layers=4, width=128, head="free"),
        PoseNetConfig(activation="softplus", gain=2.0, span=(0.0, 60.0)),
    ],
    ids=lambda config: config.activation,
)
def test_starts_at_the_identity(config):
    field = posenet(config)
    params = jax.jit(field.init)(jax.random.key(0))
    times = jnp.linspace(*field.span, 7)
    off = np.asarray(jax.jit(jax.vmap(field.pose, in_axes=(None, 0)))(params, times)) - np.eye(4)
    assert 0 < np.max(np.abs(off)) < 2e-4, (
        "not quite the identity, or no gradient would reach the first layers"
    )


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("head", ["paper", "free"])
def test_pose_is_the_formula_of_the_paper(head, coupled, dtype):
    field = posenet(
        PoseNetConfig(head=head, coupled=coupled, translation_scale=3.0, span=(2.0, 6.0), **SMALL)
    )
    params = random_params(field, dtype)
    t = 5.1  # -1 + 2 * 3.1 / 4 = 0.55
    if coupled:
        out = numpy_network(params["coupled"], 0.55, 5)
    else:
        out = np.concatenate([numpy_network(params[name], 0.55, 5) for name in ("translation", "rotation")])
    assert np.max(np.abs(out)) > 1, "the example is to bend the tanh"
    if head == "paper":
        translation, quaternion = np.tanh(out[:3]), np.tanh(out[3:])
        quaternion[0] = 1 - quaternion[0]
    else:
        translation, quaternion = out[:3], out[3:] + [1, 0, 0, 0]
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    expected[:3, 3] = 3 * translation
    tolerance = 3e-5 if dtype == jnp.float32 else 1e-12
    assert_allclose(jax.jit(field.pose)(params, jnp.asarray(t, dtype)), expected, atol=tolerance)


def test_the_paper_head_bounds_and_the_free_head_does_not():
    times = jnp.linspace(-1, 1, 200)
    reach = {}
    for head in ("paper", "free"):
        field = posenet(PoseNetConfig(head=head, translation_scale=2.0, **SMALL))
        poses = np.asarray(
            jax.jit(jax.vmap(field.pose, in_axes=(None, 0)))(random_params(field, scale=1.0), times),
            np.float64,
        )
        reach[head] = np.max(np.abs(poses[:, :3, 3]))
        # The real part of the quaternion is positive, so its product with that of the identity is too.
        angles = Rotation.from_matrix(poses[:, :3, :3]).magnitude()
        assert np.max(angles) > 2
    assert reach["paper"] <= 2 < reach["free"]


def test_derivatives_are_per_second():
    """The same network over another span: the same poses at scaled times, slower by the ratio of spans."""
    unit = posenet(PoseNetConfig(activation="softplus", **SMALL))
    long = posenet(PoseNetConfig(activation="softplus", span=(10.0, 40.0), **SMALL))
    params = random_params(unit)
    fast = jax.jit(partial(motion, partial(unit.pose, params)))(jnp.asarray(0.2))
    slow = jax.jit(partial(motion, partial(long.pose, params)))(jnp.asarray(28.0))
    assert_allclose(slow.pose, fast.pose, atol=1e-5)
    assert_allclose(slow.velocity_world, fast.velocity_world / 15, rtol=1e-4, atol=1e-5)
    assert_allclose(slow.omega_body, fast.omega_body / 15, rtol=1e-4, atol=1e-5)
    assert_allclose(slow.acceleration_world, fast.acceleration_world / 225, rtol=1e-3, atol=1e-4)


def test_derivatives_of_a_fitted_field_agree_with_finite_differences_in_float64():
    """Forward mode in float32 against fourth-order differences of the same parameters in float64."""
    field = posenet(PoseNetConfig(activation="softplus", gain=2.0, span=(0.0, 4.0)))
    times = np.linspace(0, 4, 40)
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(np.sin(times), [0.3, -0.5, 0.2])).as_matrix()
    poses[:, :3, 3] = 0.5 * np.stack([np.cos(2 * times) - 1, np.sin(2 * times), 0.3 * times], axis=-1)
    params = fields.fit(field, times, poses, key=jax.random.key(0), steps=100).params

    query = jnp.linspace(0.1, 3.9, 50)
    found = jax.jit(jax.vmap(lambda t: motion(partial(field.pose, params), t)))(query)
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), params)
        step = 1e-3
        shifted = jnp.asarray(query, jnp.float64)[None] + step * jnp.arange(-2.0, 3)[:, None]
        pose = jax.jit(jax.vmap(jax.vmap(partial(field.pose, exact))))
        T = np.asarray(pose(shifted))  # (5, n, 4, 4)
    first = np.tensordot([1, -8, 0, 8, -1], T, axes=1) / (12 * step)
    second = np.tensordot([-1, 16, -30, 16, -1], T, axes=1) / (12 * step**2)
    R_transposed = np.swapaxes(T[2, :, :3, :3], -1, -2)
    omega, alpha = (vector(R_transposed @ derivative[:, :3, :3]) for derivative in (first, second))
    for value, expected in (
        (found.velocity_world, first[:, :3, 3]),
        (found.omega_body, omega),
        (found.acceleration_world, second[:, :3, 3]),
        (found.alpha_body, alpha),
    ):
        size = np.sqrt(np.mean(np.sum(expected**2, axis=-1)))
        assert size > 0.1, "there is motion to get wrong"
        assert_allclose(value, expected, atol=1e-4 * size)


def test_the_window_opens_with_progress_and_no_gradient_moves_it():
    field = posenet(PoseNetConfig(octaves=4, window=(0.0, 0.5), **SMALL))
    params = random_params(field)
    t = jnp.asarray(0.37)
    pose = jax.jit(lambda progress: field.pose(set_progress(params, progress), t))
    without = jax.jit(posenet(PoseNetConfig(octaves=4, **SMALL)).pose)
    plain = {name: params[name] for name in ("translation", "rotation")}
    assert_allclose(pose(jnp.asarray(1.0)), without(plain, t), atol=1e-6)
    no_bands = {}  # the first layer sees time alone
    for name, network in plain.items():
        first = network["layer_0"]
        no_bands[name] = network | {"layer_0": first | {"kernel": first["kernel"].at[1:].set(0)}}
    assert_allclose(pose(jnp.asarray(0.0)), without(no_bands, t), atol=1e-6)
    assert np.max(np.abs(pose(jnp.asarray(0.25)) - pose(jnp.asarray(0.0)))) > 1e-3
    half = set_progress(params, jnp.asarray(0.25))
    gradient = jax.jit(jax.grad(lambda p: jnp.sum(field.pose(p, t))))(half)
    assert gradient["progress"] == 0 and np.any(gradient["translation"]["layer_0"]["kernel"] != 0)


def test_times_pass_the_network_as_one_matrix():
    """Under vmap every layer is one plain product of all times at once, no batch of small ones."""
    field = posenet(PoseNetConfig())
    params = random_params(field)
    jaxpr = jax.make_jaxpr(jax.vmap(field.pose, in_axes=(None, 0)))(params, jnp.linspace(-1, 1, 50))
    products = [e for e in jaxpr.jaxpr.eqns if e.primitive.name == "dot_general"]
    assert len(products) == 16
    for product in products:
        assert product.params["dimension_numbers"][1] == ((), ())
        assert product.invars[0].aval.shape[0] == 50


def flops(function, *arguments):
    """What the compiled function computes, after dead code is gone."""
    return jax.jit(function).lower(*arguments).compile().cost_analysis()["flops"]


def test_losses_on_translation_do_not_pay_for_rotation():
    field = posenet(PoseNetConfig(layers=4, width=64))
    params, times = random_params(field), jnp.linspace(-1, 1, 32)

    def loss(params, stop=False):
        pose = partial(field.pose, fields.stop_rotation_gradient(params) if stop else params)
        return jnp.sum(jax.vmap(lambda t: pose(t)[:3, 3])(times) ** 2)

    both = flops(lambda params: jax.vmap(partial(field.pose, params))(times), params)
    assert flops(loss, params) < 0.6 * both, "the forward pass of one network"
    assert flops(jax.grad(partial(loss, stop=True)), params) < 0.6 * flops(jax.grad(loss), params)
    whole, stopped = jax.jit(jax.grad(loss))(params), jax.jit(jax.grad(partial(loss, stop=True)))(params)
    assert_allclose(
        stopped["translation"]["layer_0"]["kernel"], whole["translation"]["layer_0"]["kernel"], rtol=1e-5
    )
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves((stopped["rotation"], whole["rotation"])))


def test_stopping_the_rotation_leaves_other_parameters_alone():
    coupled = random_params(posenet(PoseNetConfig(coupled=True, **SMALL)))
    assert fields.stop_rotation_gradient(coupled) is coupled
    control_poses = jnp.zeros((5, 7))
    assert fields.stop_rotation_gradient(control_poses) is control_poses


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(span=(1.0, 1.0)), "first < last"),
        (dict(octaves=-1), "octaves >= 0"),
        (dict(layers=0), "layers >= 1"),
        (dict(window=(0.5, 0.1)), "start < end"),
        (dict(translation_scale=0.0), "more than 0 m"),
    ],
)
def test_settings_that_mean_nothing_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        posenet(PoseNetConfig(**change))
