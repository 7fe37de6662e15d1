"""One contract over all fields: what a time may be, what is outside of the span, and what equality means."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose import fields
from jaxpose.fields import PoseField, PoseNetConfig, numpy_evaluator
from jaxpose.fields.derivatives import motion, velocity
from jaxpose.fields.types import since
from jaxpose.geometry import se3

SPAN = (0.5, 4.0)
STAMPS = np.array([0.5, 0.9, 2.0, 2.1, 4.0])
TWIST = np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6])
SMOOTH = PoseNetConfig(span=SPAN, octaves=2, layers=2, width=8, activation="softplus", translation_scale=2.0)


def stamped():
    with jax.enable_x64(True):
        poses = np.asarray(jax.jit(se3.exp)(jnp.asarray(np.outer(np.sin(STAMPS), TWIST))))
    return fields.piecewise_geodesic(STAMPS, poses)


def posenet():
    return fields.posenet(SMOOTH)


def held(pose):
    """A composition of pose functions, `pose(p) -> t -> T`, as a field that asks PoseNet."""
    net = posenet()
    return PoseField(net.init, lambda params, t: pose(partial(net.pose, params))(t))


T_FIXED = np.array([[0, -1, 0, 1.0], [1, 0, 0, -2], [0, 0, 1, 3], [0, 0, 0, 1]])
FIELDS = {
    "posenet": posenet,
    "posenet, window": lambda: fields.posenet(
        PoseNetConfig(
            span=SPAN,
            layers=2,
            width=8,
            octaves=4,
            coupled=True,
            window=(0.0, 1.0),
            head="free",
            activation="softplus",
        )
    ),
    "bspline": lambda: fields.bspline(SPAN, 6),
    "per_frame_poses": lambda: fields.per_frame_poses(STAMPS),
    "piecewise_geodesic": stamped,
    "left_correction": lambda: fields.left_correction(posenet(), stamped()),
    "right_correction": lambda: fields.right_correction(fields.bspline(SPAN, 3), stamped()),
    "intrinsic": lambda: fields.intrinsic(posenet(), fields.bspline(SPAN, 3)),
    # A factor of a wider span stands still with the narrower one.
    "product": lambda: fields.product(fields.bspline((0.0, 9.0), 3), fields.constant(T_FIXED), posenet()),
    "shifted": lambda: fields.shifted(fields.bspline((0.0, 3.5), 3), 0.5),
    "in_frame": lambda: held(lambda pose: fields.in_frame(pose, jnp.asarray(T_FIXED, jnp.float32))),
    "anchored": lambda: held(lambda pose: fields.anchored(pose, 1, jnp.asarray(T_FIXED, jnp.float32))),
    "body_to_camera": lambda: held(
        lambda pose: fields.body_to_camera(pose, jnp.asarray(T_FIXED, jnp.float32))
    ),
}
SAVED = [name for name in FIELDS if name not in ("in_frame", "anchored", "body_to_camera")]
EVERY = pytest.mark.parametrize("name", FIELDS)


def parameters(field, dtype=jnp.float32):
    """Parameters that are nowhere zero."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(field.init, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.asarray(0.3 * rng.normal(size=x.shape), dtype), shapes)


@EVERY
def test_a_time_is_any_one_number(name):
    """In the type of the parameters: what comes in by any way is the same pose."""
    field = FIELDS[name]()
    params = parameters(field)
    pose = jax.jit(field.pose)
    found = [pose(params, t) for t in (2, 2.0)]
    found.append(jax.jit(lambda params: field.pose(params, np.float64(2)))(params))  # not traced
    mapped = jax.jit(jax.vmap(field.pose, (None, 0)))(params, jnp.array([2.0, 3.0]))
    for T in found:
        assert T.shape == (4, 4) and T.dtype == jnp.float32
        assert_allclose(T, mapped[0], atol=2e-6)
    assert np.abs(mapped[1] - mapped[0]).max() > 1e-3, "a trajectory at rest would prove little"


@pytest.mark.parametrize("t", [2, 2.0, np.float64(2), np.float32(2), np.int64(2), np.array(2.0), np.array(2)])
def test_a_number_is_taken_exactly_whatever_it_is(t):
    """Of Python's and numpy's, untraced, the time since an origin is that of float64."""
    for dtype in (jnp.float32, jnp.bfloat16):
        found = since(1.75, t, SPAN, dtype)
        assert found.dtype == dtype and found == 0.25
    assert since(1.7e9, 1.7e9 + 2.125, (1.7e9, 1.7e9 + 5), jnp.float32) == 2.125


@EVERY
def test_more_than_one_time_is_refused(name):
    field = FIELDS[name]()
    params = parameters(field)
    for t in (jnp.zeros(1), np.zeros(3), [1.0, 2.0], jnp.zeros((2, 2))):
        message = r"t: expected one time \[s\], a number or an array of shape \(\), got shape \(.*jax.vmap"
        with pytest.raises(ValueError, match=message):
            field.pose(params, t)
        with pytest.raises(ValueError, match=r"t: expected one time \[s\]"):
            velocity(partial(field.pose, params), t)
    with pytest.raises(ValueError, match="real number"):
        field.pose(params, jnp.asarray(1j))


@EVERY
def test_outside_of_the_span_it_stands_still(name):
    """The end's pose, first and second derivatives zero; at the ends those from inside."""
    field = FIELDS[name]()
    params = parameters(field)
    at = jax.jit(lambda params, times: jax.vmap(lambda t: motion(partial(field.pose, params), t))(times))
    gaps = np.array([0.0, 1e-3, 1.0, 1e4])
    found = at(params, jnp.asarray(np.concatenate([SPAN[0] - gaps, SPAN[1] + gaps]), jnp.float32))
    assert all(np.all(np.isfinite(part)) for part in found)
    found = jax.tree.map(np.asarray, found)
    for side in (jax.tree.map(lambda x: x[:4], found), jax.tree.map(lambda x: x[4:], found)):
        assert_array_equal(side.pose, np.broadcast_to(side.pose[0], (4, 4, 4)))
        for derivative in side[1:]:
            assert_array_equal(derivative[1:], 0)
        if name != "per_frame_poses":
            assert np.linalg.norm(side.velocity_world[0]) + np.linalg.norm(side.omega_body[0]) > 1e-3


@EVERY
def test_derivatives_are_those_of_differences(name):
    """Central differences in float64, at a time that is no knot and no timestamp."""
    with jax.enable_x64(True):
        field = FIELDS[name]()
        framed = name in ("in_frame", "anchored", "body_to_camera")
        params = parameters(field, jnp.float32 if framed else jnp.float64)
        dtype = jax.tree.leaves(params)[0].dtype if jax.tree.leaves(params) else jnp.float64
        h, tolerance = (1e-2, 5e-3) if framed else (1e-5, 1e-8)
        pose = jax.jit(jax.vmap(partial(field.pose, params)))
        before, T, after = pose(jnp.asarray([1.37 - h, 1.37, 1.37 + h], dtype))
        _, linear, _ = jax.jit(lambda t: velocity(partial(field.pose, params), t))(jnp.asarray(1.37, dtype))
        assert T.dtype == dtype
        assert_allclose(linear, (after - before)[:3, 3] / (2 * h), atol=tolerance)


@pytest.mark.parametrize("name", SAVED)
def test_equal_configurations_are_one_field(name):
    """They are traced once, as a static argument and as functions, and are one key of a dict."""
    first, second, third = (FIELDS[name]() for _ in range(3))
    assert first == second == third and len({first, second, third}) == 1
    assert first != FIELDS["bspline" if name != "bspline" else "posenet"]()
    params, traces = parameters(first), []

    @partial(jax.jit, static_argnums=0)
    def by_field(field, params, t):
        traces.append(field)
        return field.pose(params, t)

    @partial(jax.jit, static_argnums=0)
    def by_function(pose, params, t):
        traces.append(pose)
        return pose(params, t)

    for field in (first, second, third):
        jax.eval_shape(lambda params, field=field: by_field(field, params, 1.2), params)
        jax.eval_shape(lambda params, field=field: by_function(field.pose, params, 1.2), params)
    assert len(traces) == 2


def test_a_field_of_equal_configuration_is_not_compiled_again():
    fields.bspline(SPAN, 6)
    compiled = [jax.jit(FIELDS["bspline"]().pose) for _ in range(3)]
    params = parameters(FIELDS["bspline"]())
    poses = [pose(params, 1.2) for pose in compiled]
    assert [pose._cache_size() for pose in compiled] == [1, 1, 1], "one cache, that of equal functions"
    compiled[0](params.astype(jnp.float32), jnp.float32(1.2))
    chex.assert_trees_all_equal(*poses)


@pytest.mark.parametrize("name", SAVED)
def test_a_field_saves_itself(name, tmp_path):
    """What is loaded gives its poses, within the span and outside, as the evaluator in numpy alone does."""
    with jax.enable_x64(True):
        field = FIELDS[name]()
        params = parameters(field, jnp.float64)
        times = np.concatenate([np.linspace(-3, 9, 50), np.linspace(*SPAN, 20)])
        fields.save(tmp_path / "field.npz", field, params)
        loaded, read = fields.load(tmp_path / "field.npz")
        expected = jax.jit(jax.vmap(field.pose, (None, 0)))(params, jnp.asarray(times))
        found = jax.jit(jax.vmap(loaded.pose, (None, 0)))(read, jnp.asarray(times))
        assert_allclose(found, expected, atol=1e-9)
        assert_allclose(numpy_evaluator.load(tmp_path / "field.npz")(times), expected, atol=1e-9)
        assert loaded.span == field.span == pytest.approx(SPAN)


@pytest.mark.parametrize("name", SAVED)
def test_shifted_in_time_it_is_the_same_motion(name):
    """To seconds since 1970, asked with a Python number; float32 arrays are refused there."""
    field, seconds = FIELDS[name](), 1_700_000_000.0
    params, late = parameters(field), fields.shifted(field, seconds)
    assert late.span == (SPAN[0] + seconds, SPAN[1] + seconds)
    ask = jax.jit(lambda params: (late.pose(params, seconds + 1.25), field.pose(params, 1.25)))
    found, expected = ask(params)
    assert_allclose(found, expected, atol=2e-6)
    with pytest.raises(ValueError, match="within 1700000000.5 to 1700000004.0 s apart, got float32"):
        jax.vmap(late.pose, (None, 0))(params, jnp.zeros(2))
    assert fields.shifted(late, -seconds).span == SPAN


def test_functions_alone_are_a_field_that_is_not_saved(tmp_path):
    own = PoseField(lambda key: {}, lambda params, t: jnp.eye(4))
    assert own == own and own != PoseField(lambda key: {}, lambda params, t: jnp.eye(4))
    for refused in (own, fields.product(own, own)):
        with pytest.raises(ValueError, match="a description, got one of functions alone"):
            fields.save(tmp_path / "field.npz", refused, refused.init(jax.random.key(0)))
    with pytest.raises(ValueError, match="a description, got one of functions alone"):
        fields.shifted(own, 1.0)
