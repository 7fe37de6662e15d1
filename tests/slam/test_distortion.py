"""SLAM with a camera that distorts, EuRoC's cam0 in small: what depth says, overlap, and a run.

The room is `helpers.box`, in closed form; rays are `helpers.distortion`'s. At 3 m the lens moves the image's
corner by more than a metre.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.box import LOWER, UPPER
from helpers.distortion import EUROC_CAM0, pixel_of, ray_of
from scipy.spatial.transform import Rotation

from jaxpose.datasets.types import Frame, Recording
from jaxpose.geometry.camera import Camera
from jaxpose.slam import SlamConfig, run
from jaxpose.slam.keyframes import overlap
from jaxpose.slam.map.backend import seen_points

CAMERA = Camera(48.8, 48.6, 39.0, 30.5, 80, 60, EUROC_CAM0)
COUNT = 6
T_WORLD_CAM = np.tile(np.eye(4), (COUNT, 1, 1))
T_WORLD_CAM[:, :3, 3] = np.linspace([-0.2, 0.0, -0.3], [0.15, 0.1, 0.1], COUNT)
T_WORLD_CAM[:, :3, :3] = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.05, 0.3, -0.05], COUNT)).as_matrix()
RAYS = ray_of(CAMERA, *np.meshgrid(np.arange(80), np.arange(60)))


def seen(i):
    """Depth and world points of all pixels of a frame."""
    direction, origin = RAYS @ T_WORLD_CAM[i, :3, :3].T, T_WORLD_CAM[i, :3, 3]
    depth = np.min(np.where(direction > 0, UPPER - origin, LOWER - origin) / direction, axis=-1)
    return depth, origin + depth[..., None] * direction


def read(i):
    depth, points = seen(i)
    return Frame((255 * (0.5 + 0.4 * np.sin(3 * points))).astype(np.uint8), depth.astype(np.float32))


RECORDING = Recording("box", CAMERA, np.arange(COUNT) / 5, read, T_WORLD_CAM)


@pytest.mark.parametrize("i", [0, COUNT - 1])
def test_points_that_a_frame_sees_are_on_the_walls(i):
    points = seen_points(read(i), CAMERA, T_WORLD_CAM[i], step=4)
    np.testing.assert_allclose(points, seen(i)[1][2::4, 2::4].reshape(-1, 3), atol=1e-5)


def test_overlap_is_the_share_of_points_that_the_lens_puts_into_the_image():
    points, margin = np.random.default_rng(1).uniform(LOWER, UPPER, (400, 3)), 5
    expected = np.zeros(COUNT)
    for k, T in enumerate(T_WORLD_CAM):
        for x, y, z in (points - T[:3, 3]) @ T[:3, :3]:
            if z > 0 and np.hypot(x, y) < 4 * z:
                u, v = pixel_of(CAMERA, x, y, z)
                expected[k] += (margin <= u < 80 - margin and margin <= v < 60 - margin) / 400
    np.testing.assert_allclose(overlap(points, T_WORLD_CAM, CAMERA, margin=margin), expected, atol=1e-12)


@pytest.mark.slow
def test_a_run_tracks_and_its_map_is_where_the_walls_are():
    states = []
    result = run(RECORDING, SlamConfig(voxel=0.1), on_frame=lambda progress: states.append(progress.state))
    assert not result.frames.lost.any()
    assert np.linalg.norm(result.T_world_cam[:, :3, 3] - T_WORLD_CAM[:, :3, 3], axis=1).max() < 0.01
    points = np.concatenate([seen(i)[1][2:-2:5, 2:-2:5].reshape(-1, 3) for i in (0, COUNT - 1)])
    query = lambda point: result.scene.query(result.scene_params, point, jnp.zeros(3))[0]
    distance = np.abs(np.asarray(jax.jit(jax.vmap(query))(jnp.asarray(points, jnp.float32))))
    assert np.median(distance) < 0.005 and np.percentile(distance, 95) < 0.03
    rays = [seen(i)[1][8::16, 8::16] - T_WORLD_CAM[i, :3, 3] for i in range(COUNT)]
    farthest = max(np.percentile(np.linalg.norm(ray, axis=-1), 99) for ray in rays)
    assert states[-1].max_depth == pytest.approx(1.2 * farthest, rel=0.01)
