"""The orbit made on the fly.

Its path, its timestamps, and its images against rays marched in float64 numpy.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.datasets.synthetic.orbit import DIAMETER, FAR, NEAR, SECONDS, distance, orbit, orbit_poses

WIDTH = 40


@pytest.fixture(scope="module")
def photographs():
    return orbit(6, WIDTH)


def depths(photographs, view, offset=(0, 0)):
    """z-depth of what is met at an offset from every pixel's centre, infinite for nothing: by small steps."""
    camera, T = photographs.camera, photographs.T_world_cam[view]
    x, y = np.meshgrid(np.arange(WIDTH) + offset[0], np.arange(WIDTH) + offset[1])
    direction = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    at = np.arange(1.5, 7.5, 0.01)
    points = T[:3, 3] + at[:, None] * (direction @ T[:3, :3].T)[:, :, None]
    inside = np.asarray(jax.jit(jax.vmap(distance))(jnp.asarray(points.reshape(-1, 3), jnp.float32))) < 0
    inside = inside.reshape(WIDTH, WIDTH, len(at))
    return np.where(inside.any(-1), at[inside.argmax(-1)], np.inf)


def test_the_path_is_a_circle_that_rises_and_falls():
    t = np.linspace(0, SECONDS, 50)
    T = orbit_poses(t)
    assert_allclose(np.hypot(T[:, 0, 3], T[:, 1, 3]), DIAMETER / 2)
    assert np.ptp(T[:, 2, 3]) > 1
    assert_allclose(T[0], T[-1], atol=1e-12)
    assert_allclose(T[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    assert_allclose(np.linalg.det(T[:, :3, :3]), 1)
    to_centre = -T[:, :3, 3] / np.linalg.norm(T[:, :3, 3], axis=1, keepdims=True)
    assert_allclose(T[:, :3, 2], to_centre, atol=1e-12)
    assert (T[:, 2, 1] < 0).all(), "the image's y axis points down"


def test_stamps_are_exact(photographs):
    train, held_out = photographs
    assert_allclose(train.t, np.arange(6) * SECONDS / 6)
    assert len(held_out.t) == 5
    assert_allclose(held_out.t, (np.arange(5) + 0.5) * SECONDS / 6)
    assert_allclose(held_out.T_world_cam, orbit_poses(held_out.t))
    assert len(orbit(40, 8)[1].t) == 10


@pytest.mark.parametrize("view", [0, 2])
def test_images_show_the_object_where_rays_meet_it(photographs, view):
    train = photographs[0]
    depth = depths(train, view)
    white = (train.rgb[view] == 255).all(-1)
    hit = np.isfinite(depth)
    # Away from the silhouette: the pixel and all its neighbours meet the object, or none does.
    shifts = [np.roll(hit, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    assert not white[np.all(shifts, axis=0)].any()
    assert white[~np.any(shifts, axis=0)].all()
    # At it: a pixel is not white where one of its four rays meets something; half a pixel would be 5% off.
    met = [np.isfinite(depths(train, view, (i, j))).ravel() for i in (-0.25, 0.25) for j in (-0.25, 0.25)]
    assert (np.any(met, axis=0) == white.ravel()).mean() < 0.01
    assert 0.2 < hit.mean() < 0.6, "it fills the view"
    assert NEAR < depth[hit].min() and depth[hit].max() < FAR
    border = np.ones_like(hit)
    border[1:-1, 1:-1] = False
    assert hit[border].mean() < 0.2, "hardly anything of it is cut off"


def test_texture_is_fine_and_of_the_seed(photographs):
    rgb = photographs[0].rgb
    again, other = orbit(6, WIDTH)[0].rgb, orbit(6, WIDTH, seed=1)[0].rgb
    assert_array_equal(again, rgb)
    white = (rgb == 255).all(-1)
    assert_array_equal((other == 255).all(-1), white)
    assert np.abs(other.astype(int) - rgb)[~white].mean() > 10
    steps = np.abs(np.diff(rgb.astype(int), axis=2))[~white[:, :, 1:] & ~white[:, :, :-1]]
    assert steps.mean() > 8, "neighbouring pixels differ"


def test_distance_is_a_lower_bound():
    points = np.random.default_rng(0).uniform(-1.6, 1.6, (4000, 3))
    found = np.asarray(jax.vmap(distance)(jnp.asarray(points, jnp.float32)), np.float64)
    apart = np.linalg.norm(points[1:] - points[:-1], axis=1)
    assert (np.abs(np.diff(found)) <= apart * 1.001).all()
    slopes = np.asarray(jax.vmap(jax.grad(distance))(jnp.asarray(points, jnp.float32)))
    assert np.isfinite(slopes).all() and (np.linalg.norm(slopes, axis=1) < 1.01).all()
    edges = jnp.asarray([[0, 0, 0], [0.95, 0.7, -0.63], [-0.22, 0, -0.055]]) * 1.1
    assert np.isfinite(np.asarray(jax.vmap(jax.grad(distance))(edges))).all()


@pytest.mark.parametrize(("views", "width"), [(1, 40), (6, 4)])
def test_too_little_to_see(views, width):
    with pytest.raises(ValueError, match="at least 2 views of 8 pixels"):
        orbit(views, width)


def test_the_object_lies_between_near_and_far_from_every_pose():
    axis = np.linspace(-2, 2, 81)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    solid = points[np.asarray(jax.jit(jax.vmap(distance))(jnp.asarray(points, jnp.float32))) < 0]
    T = orbit_poses(np.linspace(0, SECONDS, 60))
    depth = np.einsum("npj,nj->np", solid - T[:, None, :3, 3], T[:, :3, 2])
    assert NEAR < depth.min() and depth.max() < FAR
    assert FAR - NEAR < 1.5 * np.ptp(depth), "samples are not wasted"


def test_neighbouring_views_agree_on_the_colour_of_a_point():
    """Points that two poses see, by marching; wrong pixels or poses would mix up the texture."""
    train = orbit(24, WIDTH)[0]
    camera, first, second = train.camera, train.T_world_cam[3], train.T_world_cam[4]
    y, x = np.nonzero(np.isfinite(near := depths(train, 3)))
    direction = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], axis=-1)
    point = near[y, x, None] * direction @ first[:3, :3].T + first[:3, 3]
    seen = (point - second[:3, 3]) @ second[:3, :3]
    u, v = (seen[:, :2] / seen[:, 2:] * camera.fx + camera.cx).round().astype(int).T
    inside = (np.minimum(u, v) >= 0) & (np.maximum(u, v) < WIDTH)
    x, y, u, v, z = (values[inside] for values in (x, y, u, v, seen[:, 2]))
    both = np.abs(depths(train, 4)[v, u] - z) < 0.1
    a, b = train.rgb[3][y, x][both].ravel(), train.rgb[4][v, u][both].ravel()
    assert both.mean() > 0.6
    assert np.corrcoef(a, b)[0, 1] > 0.8


def test_the_slope_is_finite_where_parts_have_edges():
    """Ring, balls, post and box, each where its formula has a corner or takes the root of zero."""
    points = [(0.45, 0, 0.15), (0.03, 0, 0.15), (-0.2, 0.05, 0.1), (-0.75, -0.45, -0.43), (0.62, 0.38, 0.9)]
    points += [(0.62, 0.38, -0.8), (0, 0, -0.75), (0.95, 0.7, -0.63), (0.95, 0, -0.75), (1.2, 0.7, -0.63)]
    slope = jax.jit(jax.vmap(jax.value_and_grad(distance)))(1.1 * jnp.asarray(points))
    assert np.isfinite(slope[0]).all() and np.isfinite(slope[1]).all()
