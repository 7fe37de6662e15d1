"""The renderer against closed-form fog, hand numbers, loops in numpy and finite differences."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from jaxpose import render
from jaxpose.geometry import se3
from jaxpose.render import (
    Ray,
    composite,
    density_weights,
    occupancy_weights,
    render_ray,
    sdf_weights,
    surface_weights,
)

RTOL = {jnp.float32: 2e-5, jnp.float64: 1e-11}
WIDTH = 0.02  # [m] of rendered surfaces
WALL_Z, TILT = 2.0, np.array([0.3, -0.2, -1.0])  # a wall through (0, 0, WALL_Z), seen at an angle
NORMAL = TILT / np.linalg.norm(TILT)  # towards the camera


def wall(point, direction):
    """Signed distance to the wall, and a colour that varies along it."""
    del direction
    normal = jnp.asarray(NORMAL, point.dtype)
    distance = jnp.sum(normal * (point - jnp.asarray([0, 0, WALL_Z], point.dtype)))
    return distance, 0.5 + 0.1 * point


def wall_depth(T_world_cam, direction_cam):
    """z-depth of the wall along a ray, in closed form."""
    direction = T_world_cam[:3, :3] @ direction_cam
    return NORMAL @ (np.array([0, 0, WALL_Z]) - T_world_cam[:3, 3]) / (NORMAL @ direction)


def camera_pose(dtype):
    return se3.exp(jnp.asarray([0.1, -0.2, 0.3, 0.05, -0.1, 0.2], dtype))


def rendered_depth(T_world_cam, direction_cam, depths):
    direction = jnp.einsum("ij,j->i", T_world_cam[:3, :3], direction_cam, precision="highest")
    ray = Ray(T_world_cam[:3, 3], direction)
    return render_ray(wall, ray, depths, weights=surface_weights(WIDTH)).depth


def product_weights(ends):
    """Probability of ending at each sample and nowhere before, in plain Python."""
    weights, passed = [], 1.0
    for end in ends:
        weights.append(end * passed)
        passed *= 1 - end
    return np.array(weights)


def test_fog_between_two_depths_is_beers_law(dtype):
    density, start, end = 1.7, 1.0, 2.5
    depths = jnp.linspace(0.5, 3.0, 2001, dtype=dtype)
    fog = jnp.where((depths >= start) & (depths < end), density, 0).astype(dtype)
    weights = jax.jit(density_weights)(fog, depths)
    assert weights.dtype == dtype
    opacity = 1 - np.exp(-density * (end - start))
    # The rectangle rule is exact for constant density; the edges of the fog lie on samples within a rounding.
    assert_allclose(jnp.sum(weights), opacity, rtol=2e-3)
    # Expected depth where the ray ends: exponential distribution, cut off at the end of the fog.
    mean = start + 1 / density - (end - start) * (1 - opacity) / opacity
    assert_allclose(jnp.sum(weights * depths) / opacity, mean, rtol=2e-3)


def test_density_weights_are_the_product_formula(dtype):
    rng = np.random.default_rng(0)
    depths = np.cumsum(rng.uniform(0.01, 0.2, 40))
    density = rng.uniform(0, 20, 40)
    ends = 1 - np.exp(-density * np.diff(depths, append=depths[-1] + 1e10))
    weights = density_weights(jnp.asarray(density, dtype), jnp.asarray(depths, dtype))
    assert_allclose(weights, product_weights(ends), rtol=1e-3 if dtype == jnp.float32 else 1e-9, atol=1e-7)


def test_occupancy_weights_are_the_product_formula(dtype):
    occupancy = np.concatenate([np.random.default_rng(1).uniform(0, 0.6, 30), [0, 1, 0.5, 1]])
    weights = jax.jit(occupancy_weights)(jnp.asarray(occupancy, dtype), jnp.arange(34, dtype=dtype))
    assert_allclose(weights, product_weights(occupancy), rtol=RTOL[dtype], atol=1e-9)


@jax.jit
def all_weights(geometry, depths):
    return (
        density_weights(jnp.abs(geometry), depths),
        occupancy_weights(jax.nn.sigmoid(geometry), depths),
        sdf_weights(geometry, depths, width=WIDTH),
    )


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-5, 100, width=32), min_size=24, max_size=24))
def test_weights_are_probabilities(values):
    for weights in all_weights(jnp.asarray(values, jnp.float32), jnp.linspace(0.1, 3, 24)):
        assert np.all(np.asarray(weights) >= 0)
        assert float(jnp.sum(weights)) <= 1 + 1e-5


@pytest.mark.parametrize("weights", [density_weights, occupancy_weights])
def test_an_empty_ray_ends_nowhere(weights, dtype):
    zero = jnp.zeros(8, dtype)
    assert not np.any(weights(zero, jnp.arange(8, dtype=dtype)))
    assert composite(zero, jnp.arange(8, dtype=dtype), jnp.ones((8, 3), dtype)).opacity == 0


def test_a_signed_distance_is_rendered_without_bias(dtype):
    # The wall anywhere between the samples, whose distance is half of the surface's width.
    offsets = np.linspace(0, 0.01, 21)
    render = jax.jit(rendered_depth)
    errors = []
    for offset in offsets:
        depths = jnp.asarray(np.arange(1.5, 2.5, WIDTH / 2) + offset, dtype)
        T = camera_pose(dtype)
        direction = jnp.asarray([0.2, 0.1, 1.0], dtype)
        ground_truth = wall_depth(np.asarray(T, np.float64), np.asarray(direction, np.float64))
        errors.append(float(render(T, direction, depths)) - ground_truth)
    assert np.abs(np.mean(errors)) < 2e-4
    assert np.abs(errors).max() < 5e-4


def test_a_second_surface_is_hidden_by_the_first():
    depths = jnp.linspace(0.5, 3.5, 301)
    distance = jnp.minimum(jnp.abs(depths - 1.5) - 0.1, jnp.abs(depths - 2.5) - 0.1)
    weights = sdf_weights(distance, depths, width=WIDTH)
    assert float(jnp.sum(jnp.where(depths < 1.6, weights, 0))) > 0.98
    assert float(jnp.sum(jnp.where(depths > 1.6, weights, 0))) < 0.02


def test_a_start_inside_a_surface_is_finite(dtype):
    depths = jnp.linspace(0.1, 2, 32, dtype=dtype)

    def total(offset):
        seen = composite(
            sdf_weights(-5 - depths + offset, depths, width=WIDTH), depths, jnp.ones((32, 3), dtype)
        )
        return seen.depth + seen.variance + seen.opacity

    value, gradient = jax.jit(jax.value_and_grad(total))(jnp.zeros((), dtype))
    assert np.isfinite(value) and np.isfinite(gradient)


def test_composite_by_hand(dtype):
    weights = jnp.asarray([0.2, 0.0, 0.6], dtype)
    rgb = jnp.asarray([[1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype)
    seen = composite(weights, jnp.asarray([1, 2, 3], dtype), rgb)
    # Shares 1/4 and 3/4: mean 2.5, variance (1.5^2 + 3 * 0.5^2) / 4.
    for found, expected in zip(seen, ([0.25, 0, 0.75], 2.5, 0.75, 0.8), strict=True):
        assert found.dtype == dtype
        assert_allclose(found, expected, rtol=2e-6, atol=1e-7)


def test_vmap_over_rays_is_a_loop(dtype):
    rng = np.random.default_rng(2)
    origin = jnp.asarray(0.1 * rng.normal(size=(6, 3)), dtype)
    direction = jnp.asarray(np.concatenate([0.2 * rng.normal(size=(6, 2)), np.ones((6, 1))], axis=1), dtype)
    depths = jnp.asarray(np.sort(rng.uniform(0.5, 3, (6, 50)), axis=1), dtype)
    one = jax.jit(partial(render_ray, wall, weights=surface_weights(0.1)))
    batched = jax.jit(jax.vmap(one))(Ray(origin, direction), depths)
    looped = [one(Ray(o, d), z) for o, d, z in zip(origin, direction, depths, strict=True)]
    for i, single in enumerate(looped):
        chex.assert_trees_all_close(jax.tree.map(lambda x: x[i], batched), single, rtol=1e-4, atol=1e-5)  # noqa: B023


def test_the_gradient_is_that_of_finite_differences():
    with jax.enable_x64(True):
        rng = np.random.default_rng(3)
        depths = jnp.asarray(np.linspace(1.5, 2.6, 120))
        direction = jnp.asarray([0.1, -0.2, 1.0])

        def seen(x):
            """Everything rendered, as a function of a pose and of shifts of some samples."""
            T = se3.compose(camera_pose(jnp.float64), se3.exp(x[:6]))
            ray = Ray(T[:3, 3], T[:3, :3] @ direction)
            shifted = depths + jnp.repeat(x[6:], 20)
            result = render_ray(wall, ray, shifted, weights=surface_weights(WIDTH))
            return jnp.concatenate([result.rgb, jnp.stack([result.depth, result.variance, result.opacity])])

        at = jnp.asarray(1e-3 * rng.normal(size=12))
        jacobian = jax.jit(jax.jacrev(seen))(at)
        step = 1e-6 * jnp.eye(12)
        ahead, behind = (jax.jit(jax.vmap(seen))(at[None] + sign * step) for sign in (1, -1))
        differences = (ahead - behind).T / 2e-6
        assert_allclose(jacobian, differences, rtol=1e-5, atol=1e-6)


def test_depth_of_a_wall_moves_with_the_camera_as_geometry_says(dtype):
    """Rendered depth differentiated by the pose's tangent, against the derivative of the closed form."""
    T, direction = camera_pose(dtype), jnp.asarray([0.2, 0.1, 1.0], dtype)
    depths = jnp.linspace(1.2, 2.4, 400, dtype=dtype)
    moved = lambda xi: rendered_depth(se3.compose(T, se3.exp(xi)), direction, depths)
    jacobian = jax.jit(jax.jacrev(moved))(jnp.zeros(6, dtype))
    T, direction = np.asarray(T, np.float64), np.asarray(direction, np.float64)
    depth = wall_depth(T, direction)
    normal = T[:3, :3].T @ NORMAL  # in camera axes
    # n . (offset - R (v + d (D + w x D))) = 0: by v, dd = -n.v / n.D; by w, dd = -d n.(w x D) / n.D.
    translation = -normal / (normal @ direction)
    rotation = -depth * np.cross(direction, normal) / (normal @ direction)
    assert_allclose(jacobian, np.concatenate([translation, rotation]), rtol=5e-3, atol=5e-3)


@pytest.mark.parametrize("spacing", ["depth", "disparity"])
def test_depths_are_one_in_each_part(spacing):
    def parts(depth):
        depth = np.asarray(depth, np.float64)
        return (depth - 2) / 6 if spacing == "depth" else (1 / 2 - 1 / depth) / (1 / 2 - 1 / 8)

    middles = render.sample_depths(None, 2.0, 8.0, 16, spacing=spacing)
    assert_allclose(parts(middles), (np.arange(16) + 0.5) / 16, atol=1e-6)
    keys = jax.random.split(jax.random.key(0), 200)
    drawn = parts(jax.vmap(lambda key: render.sample_depths(key, 2.0, 8.0, 16, spacing=spacing))(keys))
    within = drawn * 16 - np.arange(16)
    assert within.min() > -1e-4 and within.max() < 1 + 1e-4
    assert_allclose(within.mean(), 0.5, atol=0.02)
    assert_allclose(within.std(), np.sqrt(1 / 12), atol=0.01)
    assert_allclose(np.corrcoef(within, rowvar=False), np.eye(16), atol=0.4)  # each part has its own draw


def test_depths_may_run_to_infinity():
    depth = np.asarray(render.sample_depths(None, 1.0, jnp.inf, 4096, spacing="disparity"))
    assert_allclose(depth, 1 / (1 - (np.arange(4096) + 0.5) / 4096), rtol=1e-5)


def test_weights_along_a_slanted_ray_are_those_of_its_true_lengths():
    density, depth = jnp.asarray([0.2, 1.0, 0.5, 2.0]), jnp.asarray([1.0, 1.5, 2.5, 3.0])
    slanted = render.density_weights(density, depth, length=1.3)
    assert_allclose(slanted, render.density_weights(density, 1.3 * depth), rtol=1e-6)
    assert_allclose(
        render.density_weights(density, depth, length=1.0), render.density_weights(density, depth)
    )


@pytest.mark.parametrize(("far", "spacing"), [(8.0, "depth"), (8.0, "disparity"), (1e8, "disparity")])
def test_depths_increase_and_are_the_keys_own(far, spacing):
    keys = jax.random.split(jax.random.key(1), 50)
    drawn = np.asarray(jax.vmap(lambda key: render.sample_depths(key, 2.0, far, 128, spacing=spacing))(keys))
    assert np.isfinite(drawn).all() and (np.diff(drawn, axis=1) > 0).all()
    assert (drawn >= 2).all() and (drawn <= far).all()
    assert len(np.unique(drawn, axis=0)) == 50


def test_a_ray_of_any_length_sees_the_same_fog(dtype):
    """The direction twice as long and depths half as large: the same points, the same colours."""
    origin, direction = jnp.asarray([0.1, -0.2, 0], dtype), jnp.asarray([0.6, 0, 0.8], dtype)
    depths = jnp.linspace(0.5, 3, 40, dtype=dtype)
    fog = lambda point, direction: (0.3 + jnp.sum(point**2), 0.5 + 0.1 * point)
    short = render_ray(fog, Ray(origin, direction), depths, weights=density_weights)
    weights = partial(density_weights, length=jnp.asarray(2, dtype))
    long = render_ray(fog, Ray(origin, 2 * direction), depths / 2, weights=weights)
    halved = short._replace(depth=short.depth / 2, variance=short.variance / 4)
    chex.assert_trees_all_close(long, halved, rtol=RTOL[dtype])


WEIGHTS = {
    "density": lambda distance, depth: density_weights(jax.nn.softplus(-50 * distance), depth),
    "occupancy": lambda distance, depth: occupancy_weights(jax.nn.sigmoid(-distance / 0.02), depth),
    "surface": surface_weights(0.05),
    "thin surface": surface_weights(1e-3),
}


def corner(point):
    """Signed distance to three walls, as one would write it."""
    return jnp.min(jnp.asarray([0.6, 0.4, 2.0], point.dtype) - point)


def occupied(distance):
    return jax.nn.sigmoid(-distance / WIDTH)


def opaque(distance):
    """Occupancies of exactly 0 and 1 on both sides of a slope."""
    return jnp.where(distance > 0.1, 0, jnp.where(distance < -0.1, 1, 0.5 - 5 * distance))


@pytest.mark.optimised
@pytest.mark.parametrize(
    ("weights", "geometry"),
    [
        (surface_weights(WIDTH), lambda distance: distance),
        (occupancy_weights, occupied),
        (occupancy_weights, opaque),
        (density_weights, lambda distance: 80 * occupied(distance)),
    ],
    ids=["sdf", "occupancy", "opaque", "density"],
)
def test_compiled_gradients_of_rays_that_end_and_that_do_not(weights, geometry):
    """By the pose: float32 and float64, and float64 and finite differences, each ray by itself."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 10), np.linspace(-0.5, 0.5, 8))
    ahead = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    # At the walls, along and away from them, and at them from inside of one.
    directions = np.concatenate([ahead, ahead * [1, 1, -1], ahead])
    starts = np.repeat([[0, 0, 0], [0, 0, 0], [0, 0.5, 0]], len(ahead), axis=0) + [0.03, 0.02, 0.01]

    def seen(xi, start, direction):
        scene = lambda point, direction: (geometry(corner(point)), 0.5 + 0.3 * jnp.sin(4 * point))
        T = se3.exp(xi)
        ray = Ray(start + T[:3, 3], jnp.einsum("ij,j->i", T[:3, :3], direction, precision="highest"))
        depths = jnp.linspace(0.503, 3.51, 41, dtype=xi.dtype)
        result = render_ray(scene, ray, depths, weights=weights)
        return jnp.sum(result.rgb) + result.depth + result.variance + result.opacity

    def gradients(dtype):
        xi, *rays = (jnp.asarray(a, dtype) for a in (np.zeros(6), starts, directions))
        return np.asarray(jax.jit(jax.vmap(jax.grad(seen), in_axes=(None, 0, 0)))(xi, *rays))

    single = gradients(jnp.float32)
    with jax.enable_x64(True):
        double = gradients(jnp.float64)
        image = jax.vmap(jax.vmap(seen, in_axes=(None, 0, 0)), in_axes=(0, None, None))
        steps = 1e-7 * np.concatenate([np.eye(6), -np.eye(6)])
        found = jax.jit(image)(*map(jnp.asarray, (steps, starts, directions)))
    forth, back = np.split(np.asarray(found), 2)
    size = np.abs(double).max(axis=1, keepdims=True)
    assert np.all(np.abs(double - (forth - back).T / 2e-7) < 1e-5 * size + 1e-7)
    assert np.all(np.abs(single - double) < 2e-4 * size + 1e-7)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: render.sample_depths(None, 1.0, 2.0, 0), "samples: expected at least 1, got 0"),
        (lambda: render.sample_depths(None, 1.0, 2.0, 4, spacing="log"), "spacing: expected"),
        (lambda: density_weights(jnp.ones(3), jnp.ones(4)), r"density, depth: .*got \(3,\) and \(4,\)"),
        (lambda: occupancy_weights(jnp.ones((2, 3)), jnp.ones((2, 3))), "occupancy, depth: .*vmap"),
        (lambda: sdf_weights(jnp.ones(3), jnp.ones(3), width=0.0), "width: expected more than 0 m, got 0.0"),
        (lambda: surface_weights(-1.0), "width: expected more than 0 m, got -1.0"),
        (lambda: composite(jnp.ones(3), jnp.ones(3), jnp.ones((4, 3))), r"rgb: expected shape \(3, 3\)"),
        (
            lambda: render_ray(
                wall, Ray(jnp.ones((5, 3)), jnp.ones((5, 3))), jnp.ones(3), weights=density_weights
            ),
            r"ray: expected one, .*got \(5, 3\) and \(5, 3\)",
        ),
        (
            lambda: render_ray(
                wall, Ray(jnp.ones(3), jnp.ones(3)), jnp.ones((5, 3)), weights=density_weights
            ),
            r"depth: expected shape \(samples,\), got \(5, 3\)",
        ),
    ],
)
def test_input_that_means_nothing_is_named(call, message, unchecked):
    with pytest.raises(ValueError, match=message):
        call()
