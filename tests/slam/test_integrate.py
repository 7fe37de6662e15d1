"""Mapping a wall: integration against closed form and numpy, the gradient's map against it."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.blocks import decoded, node_positions, over_box
from helpers.wall import CAMERA, wall
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.scenes import GridConfig, grid, merge
from jaxpose.scenes import node_positions as grid_positions
from jaxpose.scenes.voxel_blocks import BlockConfig, empty_blocks
from jaxpose.slam.config import MapConfig, SampleConfig
from jaxpose.slam.map.integrate import grown_map, make_integrate, sample_map
from jaxpose.slam.map.photometric import MapState, make_descend
from jaxpose.slam.observation import Image

BAND = 0.15
CONFIG = BlockConfig(voxel=0.05, truncation=BAND)
BLOCKS = over_box(CONFIG, (-0.4, -0.4, 1.2), (0.4, 0.4, 2.4))
NODES = node_positions(CONFIG, BLOCKS)
WALL_Z = 1.83  # between nodes
STEP, WIDE_STEP, COLOUR_STEP = BAND / 32767, 0.4 / 32767, 2 / 32767  # of what 16 bits hold
SHIFTS = np.array([[0.0, 0, 0], [0.2, -0.1, 0.15], [-0.25, 0.1, -0.1], [0.1, 0.2, 0.3]])


def wall_image(shift, *, error=0.0, grey=100):
    """A wall across the optical axis, seen by a camera moved but not turned."""
    depth = np.full((48, 64), WALL_Z - shift[2] + error, np.float32)
    return Image(jnp.full((48, 64, 3), grey, jnp.uint8), jnp.asarray(depth))


def pose(shift):
    T = np.eye(4, dtype=np.float32)
    T[:3, 3] = shift
    return jnp.asarray(T)


def seen_by_all(shifts, margin=1, nodes=NODES):
    """Nodes that project well within every image, at float64."""
    inside = True
    for shift in shifts:
        x, y, z = np.moveaxis(nodes - shift, -1, 0)
        u, v = 60 * x / z + 31.5, 60 * y / z + 23.5
        inside &= (u > margin) & (u < 63 - margin) & (v > margin) & (v < 47 - margin)
    return inside


def pixel_of(points):
    """Pixels (u, v) of points in the axes of a camera, from the middle of the image, not rounded."""
    return 60 * points[..., :2] / points[..., 2:]


def within_a_pixel(points):
    """Whether points are clearly nearer to one pixel than to the next."""
    place = pixel_of(points) + 0.5  # the middle is between two pixels
    return (np.abs(place - np.round(place)) < 0.49).all(axis=-1)


def cosine(points):
    """Of incidence on the wall of the nearest pixel's ray, for points in the axes of a camera."""
    x, y = np.moveaxis(np.round(pixel_of(points) + 0.5) - 0.5, -1, 0)
    return 1 / np.sqrt((x / 60) ** 2 + (y / 60) ** 2 + 1)


def integrate(images, shifts):
    """The map after the images, and what its nodes hold: distance, colour, wide distance, three weights."""
    update, state = make_integrate(CONFIG, CAMERA), MapState(jax.tree.map(jnp.copy, BLOCKS), ())
    for image, shift in zip(images, shifts, strict=True):
        state = update(state, image, pose(shift))
    return state, decoded(CONFIG, np.asarray(state.params.values)[1:])


def test_a_wall_seen_from_several_places_is_exact():
    state, values = integrate([wall_image(s) for s in SHIFTS], SHIFTS)
    distance = WALL_Z - NODES[..., 2]
    valid = seen_by_all(SHIFTS) & (distance > -BAND + 1e-4)
    assert valid.sum() > 1000
    assert_allclose(values[valid, 0], np.minimum(distance, BAND)[valid], atol=2 * STEP)
    surface = valid & (np.abs(distance) < BAND - 1e-4)
    assert_allclose(values[surface, 1:4], 100 / 255, atol=2 * COLOUR_STEP)
    # What lies behind it was not seen.
    assert_allclose(values[distance < -BAND - 1e-4, 0], BAND, rtol=1e-6)
    assert_array_equal(values[distance < -BAND - 1e-4, 5:7], 0)


def slanted_image(normal, offset):
    """The wall normal . x + offset = 0 from a camera at the origin."""
    return Image(jnp.full((48, 64, 3), 100, jnp.uint8), jnp.asarray(wall(normal, offset)[0]))


def test_a_slanted_wall_has_its_true_distance():
    """Not that along the optical axis: views from different sides agree."""
    normal = np.array([0.6, 0.0, -0.8])
    state, values = integrate([slanted_image(normal, 1.44)], SHIFTS[:1])
    distance = NODES @ normal + 1.44
    valid = seen_by_all(SHIFTS[:1], margin=3) & (distance > -BAND / 2)
    assert valid.sum() > 1000
    assert_allclose(values[valid, 0], np.minimum(distance, BAND)[valid], atol=1e-3)
    assert np.abs(distance[valid]).min() < 0.01


def test_a_surface_at_a_grazing_angle_has_two_sides():
    """A floor 0.3 below the camera: the nodes of the cells that hold it are measured above and below."""
    normal, height = np.array([0.0, -1.0, 0.0]), 0.3
    state, values = integrate([slanted_image(normal, height)], SHIFTS[:1])
    distance = NODES @ normal + height
    below = seen_by_all(SHIFTS[:1], margin=3) & (distance < 0) & (distance > -CONFIG.voxel)
    assert below.sum() > 50
    assert_allclose(values[below, 0], distance[below], atol=2e-3)


def test_nodes_between_blocks_are_the_same_in_both():
    """Each is computed for itself; what a point reads must not depend on the side it is on."""
    _, values = integrate([wall_image(s) for s in SHIFTS], SHIFTS)
    place = np.round(NODES.reshape(-1, 3) / CONFIG.voxel).astype(int)
    _, which, count = np.unique(place, axis=0, return_inverse=True, return_counts=True)
    assert count.max() == 8
    flat = values.reshape(-1, values.shape[-1])
    for channel in flat.T:
        low, high = np.full(len(count), np.inf), np.full(len(count), -np.inf)
        np.minimum.at(low, which.ravel(), channel)
        np.maximum.at(high, which.ravel(), channel)
        assert_array_equal(low, high)


def test_two_observations_are_weighted_as_numpy_does():
    """Inverse variances of the published sigma at the measured depths, times the cosine of incidence."""
    shifts, errors, greys = SHIFTS[[0, 3]], (0.03, -0.02), (50, 200)
    images = [wall_image(s, error=e, grey=g) for s, e, g in zip(shifts, errors, greys, strict=True)]
    _, values = integrate(images, shifts)
    depths = [WALL_Z - s[2] + e for s, e in zip(shifts, errors, strict=True)]
    weights = [(0.0012 + 0.0019 * (d - 0.4) ** 2) ** -2 for d in depths]
    distance = WALL_Z - NODES[..., 2]
    near = seen_by_all(shifts) & (np.abs(distance) < 0.1)
    near &= np.all([within_a_pixel(NODES - s) for s in shifts], axis=0)
    assert near.sum() > 200
    weights = np.stack([w * cosine(NODES[near] - s) for w, s in zip(weights, shifts, strict=True)], axis=-1)
    mean = lambda x: np.average(np.broadcast_to(x, weights.shape), axis=-1, weights=weights)
    assert_allclose(values[near, 0], distance[near] + mean(errors), atol=4 * STEP)
    assert_allclose(values[near, 1], mean(greys) / 255, atol=4 * COLOUR_STEP)


def test_the_wide_distance_reaches_farther_and_knows_where_it_was_measured():
    """Closed form: a wall's distance, 8 voxels to both sides and no farther."""
    state, values = integrate([wall_image(s) for s in SHIFTS], SHIFTS)
    look = jax.jit(jax.vmap(partial(sample_map, CONFIG, state.params, ())))
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(-0.1, 0.1, (2, 400)), rng.uniform(1.25, 2.35, 400)], axis=1)
    near, distance = look(jnp.asarray(points, jnp.float32)), WALL_Z - points[:, 2]
    within, beyond = np.abs(distance) < 0.34, np.abs(distance) > 0.41
    assert (
        within.sum() > 200 and (beyond & (distance < 0)).sum() > 20 and (beyond & (distance > 0)).sum() > 20
    )
    assert_array_equal(near.valid[within], 1)
    assert_array_equal(near.valid[beyond], 0)
    assert_allclose(near.distance[within], distance[within], atol=2 * WIDE_STEP)
    assert_allclose(near.rgb[np.abs(distance) < 0.1], 100 / 255, atol=2 * COLOUR_STEP)


def test_rounding_does_not_add_up_over_many_frames():
    """The mean of 150 noisy depths and greys is the one that float64 has, though 16 bits hold each before."""
    rng, update, state = np.random.default_rng(0), make_integrate(CONFIG, CAMERA), MapState(BLOCKS, ())
    state = jax.tree.map(jnp.copy, state)
    errors, greys = rng.normal(0, 0.01, 150), rng.integers(60, 200, 150)
    for error, grey in zip(errors.tolist(), greys.tolist(), strict=True):
        state = update(state, wall_image(SHIFTS[0], error=error, grey=grey), pose(SHIFTS[0]))
    values = decoded(CONFIG, np.asarray(state.params.values)[1:])
    distance = WALL_Z - NODES[..., 2]
    near = seen_by_all(SHIFTS[:1]) & (np.abs(distance) < 0.1) & within_a_pixel(NODES)
    assert near.sum() > 200
    weights = (0.0012 + 0.0019 * (WALL_Z + errors - 0.4) ** 2) ** -2
    assert_allclose(values[near, 0] - distance[near], np.average(errors, weights=weights), atol=1e-4)
    assert_allclose(values[near, 1], np.average(greys, weights=weights) / 255, atol=1e-3)


def test_pixels_without_depth_change_nothing():
    blind = wall_image(SHIFTS[0])._replace(depth=jnp.zeros((48, 64)))
    state, _ = integrate([blind], SHIFTS[:1])
    jax.tree.map(assert_array_equal, state.params, BLOCKS)


def test_half_an_image_maps_half_the_wall():
    image = wall_image(SHIFTS[0])
    image = image._replace(depth=image.depth.at[:, :32].set(0))
    _, values = integrate([image], SHIFTS[:1])
    assert not np.any(values[NODES[..., 0] < -0.02, 5:])
    assert np.any(values[NODES[..., 0] > 0.02, 5:])


def test_nothing_is_compiled_anew_while_the_map_grows():
    update, state = make_integrate(CONFIG, CAMERA), MapState(empty_blocks(CONFIG, capacity=512, side=4), ())
    counts = []
    for shift in SHIFTS:
        points = np.array([[0.0, 0, WALL_Z]]) + 3 * shift
        state = update(grown_map(CONFIG, state, points), wall_image(shift), pose(shift))
        counts.append(int(state.params.count))
    assert counts[0] == 28 < counts[-1]  # 27 around the point, and the empty one
    assert update._cache_size() == 1


@pytest.mark.slow
def test_the_gradient_finds_the_same_wall_and_compiles_once():
    config = GridConfig((-0.4, -0.4, 1.2), (0.4, 0.4, 2.4), voxel=0.05, levels=2, truncation=BAND)
    scene = grid(config)
    traces = chex.assert_max_traces(scene.query, n=2)  # for the shapes of a loss, and in its loop
    scene = scene._replace(query=traces)
    settings = MapConfig(
        method="gradient", pixels=500, window=4, sample=SampleConfig(front=6, surface=12, behind=0, band=BAND)
    )
    init, update = make_descend(scene, CAMERA, settings)
    state = init(scene.init(jax.random.key(0)))
    images = jax.tree.map(lambda *x: jnp.stack(x), *[wall_image(s) for s in SHIFTS])
    poses = jnp.stack([pose(s) for s in SHIFTS])
    losses = []
    for i, (rate, iterations) in enumerate(((1e-2, 60), (2e-3, 60), (5e-4, 40))):
        key = jax.random.fold_in(jax.random.key(1), i)
        state, loss = update(
            state, images, poses, jnp.float32(3), jnp.float32(rate), jnp.int32(iterations), key
        )
        losses.append(float(loss))
    assert losses[-1] < losses[0]
    nodes = grid_positions(config).astype(np.float64)
    distance = WALL_Z - nodes[..., 2]
    near = seen_by_all(SHIFTS, margin=8, nodes=nodes) & (np.abs(distance) < 0.05)
    assert near.sum() > 100
    found = np.asarray(merge(state.params)[0])[near]
    assert np.median(np.abs(found[:, 0] - distance[near])) < 2e-3
    assert np.abs(found[:, 0] - distance[near]).max() < 1e-2
    assert_allclose(np.median(found[:, 1]), 100 / 255, atol=0.03)
