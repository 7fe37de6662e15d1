"""The orbit made on the fly: its path, its stamps, and its images against rays marched in float64 numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.data.orbit import DIAMETER, FAR, NEAR, SECONDS, distance, orbit, orbit_poses

WIDTH = 40


@pytest.fixture(scope="module")
def photographs():
    return orbit(6, WIDTH)


def depths(photographs, view):
    """z-depth of what every pixel's centre meets, infinite for nothing: small steps along the ray."""
    camera, T = photographs.camera, photographs.T_world_cam[view]
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(WIDTH))
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
