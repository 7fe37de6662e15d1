"""Tangent planes of depth images: walls in closed form, edges, noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.wall import CAMERA, rays, wall
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.geometry.camera import Camera
from jaxpose.slam.map.integrate import seen_by, tangent_planes, without_stipple
from jaxpose.slam.observation import Image, depth_sigma, locate

ACROSS = np.array([0.0, 0, -1])


def planes(depth, camera=CAMERA):
    return np.asarray(jax.jit(tangent_planes, static_argnums=1)(jnp.asarray(depth), camera))


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.3, -0.2, -1), (0.0, 0.9, -1)])
def test_a_wall_is_its_own_plane_up_to_the_border(normal):
    depth, unit = wall(normal, 1.4)
    found = planes(depth)
    inner = found[1:-1, 1:-1]
    assert_allclose(inner[..., :3], np.broadcast_to(unit, inner[..., :3].shape), atol=2e-4)
    assert_allclose(inner[..., 3], 1.4, atol=1e-3)


def test_a_wall_is_its_own_plane_through_a_lens_that_distorts():
    """EuRoC's cam0 in small: without its distortion the normals would be off by 4 degrees in the median."""
    camera = Camera(39.0, 45.7, 31.5, 23.5, 64, 48, (-0.283, 0.074, 0.0002, 0.00002))
    depth, unit = wall((0.3, -0.2, -1), 1.4, camera)
    found = planes(depth, camera)
    off = np.rad2deg(np.arccos(np.clip(found[1:-1, 1:-1, :3] @ unit, -1, 1)))
    assert np.median(off) < 0.15 and off.max() < 1.5  # the window of the slopes is 9 pixels wide
    points = depth[..., None] * rays(camera)
    assert_allclose(np.sum(found[..., :3] * points, -1) + found[..., 3], 0, atol=1e-5)


def test_no_slope_is_taken_across_an_edge():
    near, unit = wall((0.3, 0, -1), 1.0)
    far, other = wall((-0.2, 0.1, -1), 2.5)
    left = np.arange(64) < 30
    found = planes(np.where(left, near, far))[8:-8]
    for side, normal in ((found[:, 1:29], unit), (found[:, 31:63], other)):
        towards = side[..., :3] @ normal
        known = np.abs(side[..., 2] + 1) > 1e-6
        assert known.mean() > 0.95
        assert np.median(towards[known]) > np.cos(np.deg2rad(0.1))
        assert np.percentile(towards[known], 2) > np.cos(np.deg2rad(25))


def test_noise_turns_a_plane_by_a_few_degrees():
    depth, unit = wall((0.3, -0.2, -1), 1.8)
    noisy = depth + np.asarray(depth_sigma(jnp.asarray(depth))) * np.random.default_rng(0).normal(
        size=depth.shape
    )
    found = planes(noisy.astype(np.float32))
    known = np.abs(found[..., 2] + 1) > 1e-6
    assert known[1:-1, 1:-1].mean() > 0.95
    off = np.rad2deg(np.arccos(np.clip(found[known][:, :3] @ unit, -1, 1)))
    assert np.median(off) < 3


def test_where_little_is_known_the_plane_is_across_the_axis():
    depth, _ = wall((0.3, -0.2, -1), 1.4)
    alone = np.zeros_like(depth)
    alone[::5, ::5] = depth[::5, ::5]
    grazing, _ = wall((0, 1, -0.02), 0.3)
    found = planes(alone)
    assert_array_equal(found[..., :3], np.broadcast_to(ACROSS, (48, 64, 3)))
    assert_allclose(found[..., 3], alone, rtol=1e-6)
    steep = (grazing > 3) & (grazing < 50)
    assert steep.sum() > 100
    assert_array_equal(
        planes(np.where(steep, grazing, 0))[..., :3][steep], np.broadcast_to(ACROSS, (steep.sum(), 3))
    )


def test_what_pixels_say_of_points():
    """Distance to a slanted wall and worth in closed form; nothing outside and where there is no depth."""
    depth, unit = wall((0.3, -0.2, -1), 1.4)
    depth[:, 50:] = 0
    image = Image(jnp.full((48, 64, 3), 51, jnp.uint8), jnp.asarray(depth))
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1.0], [0.25, 0.3, 1.8], (50, 3)).astype(np.float32)

    @jax.jit
    def look(points):
        at = locate(CAMERA, points)
        seen = seen_by(image, CAMERA)(at)
        return at, seen.distance(points), seen.incidence_cosine(points), seen.weight, seen.rgb

    at, distance, incidence, weight, rgb = look(points)
    assert_allclose(distance, points @ unit + 1.4, atol=1e-3)
    assert_allclose(incidence, -points @ unit, atol=1e-3)
    ray = rays()[np.asarray(at.row), np.asarray(at.column)]
    cosine = -(ray @ unit) / np.linalg.norm(ray, axis=-1)
    there = depth[np.asarray(at.row), np.asarray(at.column)]
    sigma = lambda z: 0.0012 + 0.0019 * (z - 0.4) ** 2
    assert_allclose(weight, cosine * (sigma(1.0) / sigma(there)) ** 2, rtol=2e-3)
    assert_allclose(rgb, 0.2, rtol=1e-6)
    nowhere = np.float32([[5.0, 0, 1], [0, 0, -1], [0.42, 0, 1]])
    assert_array_equal(look(np.tile(nowhere, (17, 1))[:50])[3], 0)


def stippled(depth):
    """What a coarser camera's points leave of an image, a fifth of it."""
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]]
    return np.where((5 * row // 3 % 5 % 2 == 0) & (column % 5 % 2 == 0), depth, 0).astype(np.float32)


def test_between_the_points_of_a_stipple_depth_is_that_of_the_surface():
    depth, _ = wall((0.3, -0.2, -1), 1.4)
    sparse = stippled(depth)
    assert 0.15 < np.mean(sparse > 0) < 0.4
    found = np.asarray(without_stipple(jnp.asarray(sparse)))[2:-2, 2:-2]
    inner = depth[2:-2, 2:-2]
    assert np.mean(found > 0) > 0.85
    assert_allclose(found[found > 0], inner[found > 0], rtol=1e-4)


def test_nothing_is_put_between_two_surfaces_nor_into_a_dense_image():
    near, _ = wall((0, 0, -1), 1.0)
    far, _ = wall((0, 0, -1), 2.0)
    half = near.shape[1] // 2
    both = np.concatenate([near[:, :half], far[:, half:]], axis=1)
    found = np.asarray(without_stipple(jnp.asarray(stippled(both))))
    assert np.mean(found > 0) > 0.8
    on_one = np.isclose(found, near, rtol=1e-3) | np.isclose(found, far, rtol=1e-3) | (found == 0)
    assert on_one.all()
    holes = np.where(np.random.default_rng(0).random(near.shape) < 0.2, 0, near).astype(np.float32)
    assert_array_equal(without_stipple(jnp.asarray(holes)), holes)
    assert not np.any(without_stipple(jnp.zeros((8, 8))))
