"""Paint: a wall's picture comes back finer than the map's cells, and nothing is made up."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers.blocks import filled
from helpers.wall import rays
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates

from jaxpose.geometry.camera import Camera
from jaxpose.scenes.voxel_blocks import CELLS, BlockConfig, voxel_blocks
from jaxpose.slam.keyframes import Keyframe
from jaxpose.slam.map.texture import Texture, make_texture, textured
from jaxpose.slam.observation import Image

CAMERA = Camera(200.0, 200.0, 79.5, 59.5, 160, 120)
CONFIG = BlockConfig(voxel=0.04, truncation=0.12)
LOWER, UPPER = (-0.32, -0.32, 0.7), (0.31, 0.31, 1.2)
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


def grey_wall(points):
    """The values of a grey map with the wall's distance."""
    distance = np.clip(WALL_Z - points[..., 2], -0.12, 0.12)
    return np.concatenate([distance[..., None], np.full((*distance.shape, 3), 0.5)], axis=-1)


BLOCKS = filled(CONFIG, LOWER, UPPER, grey_wall)


def seen_at(points, texture):
    scene = textured(voxel_blocks(CONFIG), CONFIG)
    params = (BLOCKS, jax.tree.map(jnp.asarray, texture))
    return jax.vmap(lambda p: scene.query(params, p, jnp.zeros(3)))(jnp.asarray(points, jnp.float32))


def test_a_wall_is_painted_finer_than_the_cells():
    texture = make_texture(CONFIG, BLOCKS, [keyframe(0, -0.05), keyframe(1, 0.05)], CAMERA)
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
        texture = make_texture(CONFIG, BLOCKS, keyframes, CAMERA)
        assert not texture.tiles.any()
    texture = make_texture(CONFIG, BLOCKS, [keyframe(0, 0.0)], CAMERA)
    assert texture.slot.shape == BLOCKS.coords.shape[:1] and set(np.unique(texture.tiles[..., 3])) == {0, 255}
    _, rgb = seen_at([[0.0, 0.0, WALL_Z - 0.1], [0.0, 0.0, WALL_Z + 0.1]], texture)
    assert_allclose(rgb, 0.5, atol=1e-4)  # as 16 bits hold it


def test_a_keyframe_that_sees_something_else_there_paints_nothing():
    """A table in front of the wall, which the map does not hold: its colour does not land on the wall."""
    nearer = keyframe(0, 0.0)
    nearer = nearer._replace(image=nearer.image._replace(depth=nearer.image.depth - 0.2))
    assert not make_texture(CONFIG, BLOCKS, [nearer], CAMERA).tiles.any()


def test_tiles_hold_what_a_dense_array_would():
    """Against numpy, also across the sides of tiles."""
    rng = np.random.default_rng(0)
    coords = np.asarray(BLOCKS.coords)[1:]
    low = coords.min(axis=0)
    shape = 2 * CELLS * (coords.max(axis=0) - low + 1) + 1
    chosen = rng.random(shape) < 0.9
    dense = np.zeros((*shape, 4), np.uint8)
    dense[chosen] = np.column_stack([rng.integers(0, 256, (chosen.sum(), 3)), np.full(chosen.sum(), 255)])
    first = 2 * CELLS * (coords - low)
    tiles = np.stack([dense[tuple(slice(k, k + 17) for k in corner)] for corner in first])
    texture = Texture(np.arange(len(tiles) + 1, dtype=np.int32), np.concatenate([0 * tiles[:1], tiles]))
    cells = rng.uniform(0, shape - 1.001, (200, 3))
    cells[:50] = np.floor(cells[:50])
    _, rgb = seen_at((2 * CELLS * low + cells) * CONFIG.voxel / 2, texture)
    read = [map_coordinates(dense[..., k].astype(float), cells.T, order=1) for k in range(4)]
    known = read[3] > 0.3 * 255
    assert_allclose(np.asarray(rgb)[known], np.stack(read[:3], -1)[known] / read[3][known, None], atol=2e-3)
