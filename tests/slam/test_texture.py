"""Paint: a wall's picture comes back finer than the map's cells, and nothing is made up."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers.wall import rays
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates

from jaxpose.geometry.camera import Camera
from jaxpose.scenes import GridConfig, grid, node_positions
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.map.texture import _tiled, make_texture, textured
from jaxpose.slam.observation import Image

CAMERA = Camera(200.0, 200.0, 79.5, 59.5, 160, 120)
GRID = GridConfig((-0.32, -0.24, 0.8), (0.32, 0.24, 1.2), voxel=0.04, levels=1, truncation=0.12)
WALL_Z = 1.03  # between nodes, of the map and of the paint
PERIOD = 0.12  # [m] of the picture's waves: three cells of the map


def picture(x, y):
    """Colour of the wall, in [0, 1]."""
    wave = 0.5 + 0.4 * np.sin(2 * np.pi * x / PERIOD)
    return np.stack([wave, 0.5 + 0.4 * np.cos(2 * np.pi * y / PERIOD), np.full_like(x, 0.2)], axis=-1)


def keyframe(index, x):
    """A camera at (x, 0, 0) that looks at the wall."""
    T = np.eye(4)
    T[0, 3] = x
    across, down, _ = np.moveaxis(WALL_Z * rays(CAMERA), -1, 0)
    rgb = np.round(255 * picture(x + across, down)).astype(np.uint8)
    return Keyframe(index, Image(jnp.asarray(rgb), jnp.full((120, 160), WALL_Z, jnp.float32)), T)


def wall_values():
    """The values of a grey map with the wall's distance."""
    distance = np.clip(WALL_Z - node_positions(GRID)[..., 2], -0.12, 0.12)
    return np.concatenate([distance[..., None], np.full((*distance.shape, 3), 0.5)], axis=-1).astype(
        np.float32
    )


def seen_at(points, texture):
    scene, params = (
        textured(grid(GRID), GRID),
        (jnp.asarray(wall_values()), jax.tree.map(jnp.asarray, texture)),
    )
    return jax.vmap(lambda p: scene.query(params, p, jnp.zeros(3)))(jnp.asarray(points, jnp.float32))


def test_a_wall_is_painted_finer_than_the_cells():
    texture = make_texture(GRID, wall_values()[..., 0], [keyframe(0, -0.05), keyframe(1, 0.05)], CAMERA)
    rng = np.random.default_rng(0)
    xy = rng.uniform([-0.25, -0.2], [0.25, 0.2], (300, 2))
    distance, rgb = seen_at(np.column_stack([xy, np.full(300, WALL_Z)]), texture)
    assert_allclose(distance, 0, atol=1e-6)
    ground_truth = picture(*xy.T)
    off = np.sqrt(np.mean((np.asarray(rgb) - ground_truth) ** 2, axis=0))
    # Linear between nodes 2 cm apart, a wave of 12 cm and height 0.4 is off by 0.03; 4 cm apart by 0.1.
    assert off[:2].max() < 0.04 and off[2] < 0.003


def test_what_no_keyframe_saw_keeps_the_colour_of_the_map():
    away = np.diag([1.0, -1, -1, 1])
    for keyframes in ([], [keyframe(0, 0.0)._replace(T_world_cam=away)]):
        texture = make_texture(GRID, wall_values()[..., 0], keyframes, CAMERA)
        assert texture.tiles.shape[0] == 1 and not texture.tiles.any() and not texture.slot.any()
    texture = make_texture(GRID, wall_values()[..., 0], [keyframe(0, 0.0)], CAMERA)
    assert texture.slot.shape == (2, 2, 2) and set(np.unique(texture.tiles[..., 3])) == {0, 255}
    _, rgb = seen_at([[0.0, 0.0, WALL_Z - 0.1], [0.0, 0.0, WALL_Z + 0.1]], texture)
    assert_allclose(rgb, 0.5, atol=1e-6)


def test_a_keyframe_that_sees_something_else_there_paints_nothing():
    """A table in front of the wall, which the map does not hold: its colour does not land on the wall."""
    nearer = keyframe(0, 0.0)
    nearer = nearer._replace(image=nearer.image._replace(depth=nearer.image.depth - 0.2))
    assert not make_texture(GRID, wall_values()[..., 0], [nearer], CAMERA).tiles.any()


def test_tiles_hold_what_a_dense_array_would():
    """Against numpy, also across the sides of tiles."""
    rng = np.random.default_rng(0)
    dense = np.zeros((33, 25, 21, 4), np.uint8)
    chosen = rng.random((33, 25, 21)) < 0.9
    dense[chosen] = np.column_stack([rng.integers(0, 256, (chosen.sum(), 3)), np.full(chosen.sum(), 255)])
    texture = _tiled(np.argwhere(chosen), dense[chosen], np.array([32, 24, 20]))
    cells = rng.uniform(0, [32, 24, 20], (200, 3))
    cells[:50] = np.round(cells[:50])
    _, rgb = seen_at(np.array(GRID.lower) + cells * GRID.voxel / 2, texture)
    read = [map_coordinates(dense[..., k].astype(float), cells.T, order=1) for k in range(4)]
    known = read[3] > 0.3 * 255
    assert_allclose(np.asarray(rgb)[known], np.stack(read[:3], -1)[known] / read[3][known, None], atol=2e-3)
