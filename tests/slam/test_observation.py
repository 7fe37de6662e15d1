"""Pixels, sample depths and the sensor's noise, by hand."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera, project
from jaxpose.slam.observation import (
    Image,
    Pixels,
    SampleConfig,
    back_project,
    depth_sigma,
    read_pixels,
    render_pixels,
    sample_depths,
    sample_pixels,
)

CAMERA = Camera(50.0, 55.0, 31.0, 23.0, 64, 48)
FAR = jnp.float32(6.0)


def image():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 4, (48, 64)).astype(np.float32)
    return Image(jnp.asarray(rng.integers(0, 256, (48, 64, 3)), jnp.uint8), jnp.asarray(depth))


def test_pixels_are_read_where_they_are():
    picture, row, column = image(), np.array([0, 47, 5]), np.array([0, 63, 40])
    pixels = jax.jit(read_pixels, static_argnums=1)(picture, CAMERA, jnp.asarray(row), jnp.asarray(column))
    assert_array_equal(pixels.depth, np.asarray(picture.depth)[row, column])
    assert_allclose(pixels.rgb, np.asarray(picture.rgb)[row, column] / 255, rtol=1e-6)
    x, y = (column - 31) / 50, (row - 23) / 55
    assert_allclose(pixels.direction_cam, np.stack([x, y, np.ones(3)], axis=1), rtol=1e-6)


def test_drawn_pixels_keep_off_the_edge_and_follow_from_the_key():
    # A picture that says which pixel was read.
    depth = jnp.arange(48 * 64, dtype=jnp.float32).reshape(48, 64)
    picture = image()._replace(depth=depth)
    draw = jax.jit(partial(sample_pixels, camera=CAMERA, count=5000, edge=4))
    pixels = draw(jax.random.key(0), picture)
    row, column = np.divmod(np.asarray(pixels.depth).astype(int), 64)
    assert (row.min(), row.max(), column.min(), column.max()) == (4, 43, 4, 59)
    x, y = (column - 31) / 50, (row - 23) / 55
    assert_allclose(pixels.direction_cam[:, :2], np.stack([x, y], axis=1), rtol=1e-5, atol=1e-6)
    assert_array_equal(draw(jax.random.key(0), picture).depth, pixels.depth)
    assert np.any(draw(jax.random.key(1), picture).depth != pixels.depth)


@pytest.mark.parametrize("depth", [0.0, 0.05, 0.3, 2.0, 9.0])
@pytest.mark.parametrize(
    "config", [SampleConfig(), SampleConfig(front=8, surface=14, behind=0), SampleConfig(front=0, surface=6)]
)
def test_sample_depths_increase_and_cover(depth, config, dtype):
    samples = np.asarray(sample_depths(jnp.asarray(depth, dtype), jnp.asarray(6, dtype), config))
    assert samples.dtype == dtype
    assert len(samples) == config.front + config.surface + config.behind
    # A surface nearer than its band leaves the samples before it no room: they coincide.
    assert np.all(np.diff(samples) >= 0 if 0 < depth < config.band else np.diff(samples) > 0)
    assert samples[0] > 0
    if depth == 0:
        assert_allclose(samples, np.linspace(0.02, 6, len(samples)), rtol=1e-5)
        return
    near, end = max(depth - config.band, 0.02), depth + config.band
    band = samples[config.front : config.front + config.surface]
    assert_allclose([band[0], band[-1]], [near, end], rtol=1e-5)
    assert_allclose(np.diff(band), (end - near) / (config.surface - 1), rtol=1e-3)
    if config.front and near > 0.02:
        assert_allclose(samples[0], 0.02, rtol=1e-5)


def test_sigma_of_depth_is_the_published_one(dtype):
    """Nguyen et al. 2012: 0.0012 + 0.0019 (z - 0.4)^2 m."""
    found = depth_sigma(jnp.asarray([0.4, 1.0, 2.4, 4.4], dtype))
    assert found.dtype == dtype
    assert_allclose(found, [0.0012, 0.001884, 0.0088, 0.0316], rtol=1e-5)


def test_back_projected_points_are_seen_where_they_were():
    T_world_cam = se3.exp(jnp.array([0.3, -0.2, 0.5, 0.2, 0.4, -0.1]))
    row, column = jnp.arange(3, 40, 5), jnp.arange(10, 50, 5)
    pixels = read_pixels(image(), CAMERA, row, column)
    points = back_project(pixels, T_world_cam)
    points_cam = se3.apply(se3.inverse(T_world_cam)[None], points)
    assert_allclose(points_cam[:, 2], pixels.depth, rtol=1e-5)
    assert_allclose(project(CAMERA, points_cam), np.stack([column, row], axis=1), atol=1e-3)
    without = pixels._replace(depth=jnp.zeros_like(pixels.depth))
    assert_allclose(back_project(without, T_world_cam), np.tile(T_world_cam[:3, 3], (8, 1)), atol=1e-6)


def test_a_pixel_shows_a_wall_at_its_z_depth():
    """Rendered from a turned camera: depth is along the optical axis, not along the ray."""
    T_world_cam = se3.exp(jnp.array([0.1, -0.2, 0.1, 0.1, 0.2, 0.3]))
    wall = lambda point, direction: (2.5 - point[2], point / 4)
    column, row = (x.ravel() for x in jnp.meshgrid(jnp.arange(4, 60, 11), jnp.arange(4, 44, 9)))
    pixels = read_pixels(image(), CAMERA, row, column)
    T, directions = np.asarray(T_world_cam, np.float64), np.asarray(pixels.direction_cam, np.float64)
    ground_truth = (2.5 - T[2, 3]) / (directions @ T[2, :3])
    pixels = Pixels(pixels.direction_cam, jnp.asarray(ground_truth + 0.03, jnp.float32), pixels.rgb)
    config = SampleConfig(surface=24)
    seen = jax.jit(partial(render_pixels, wall, config=config))(T_world_cam, pixels, FAR)
    assert_allclose(seen.depth, ground_truth, atol=2e-3)
    assert_allclose(seen.opacity, 1, atol=2e-3)
    points = T[:3, 3] + ground_truth[:, None] * directions @ T[:3, :3].T
    assert_allclose(seen.rgb, points / 4, atol=2e-3)
