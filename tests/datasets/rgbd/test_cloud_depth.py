"""Depth images from a point cloud against the closed form of the surfaces it was sampled from."""

import numpy as np
import pytest

from jaxpose.datasets.rgbd.cloud_depth import depth_from_cloud
from jaxpose.geometry.camera import Camera

LENS = (-0.283, 0.074, 0.0002, 0.00002)  # of EuRoC
CAMERA = Camera(115.0, 114.0, 92.0, 62.0, 188, 120, LENS)
WALL, BOARD = 4.0, 2.0  # [m] along the first camera's axis; the board is 0.8 m wide and 0.6 m high


def rays():
    """Directions of all pixels at z = 1, the lens undone by plain fixed-point iteration."""
    u, v = np.meshgrid(np.arange(188.0), np.arange(120.0))
    xd, yd = (u - 92) / 115, (v - 62) / 114
    x, y = xd, yd
    k1, k2, p1, p2 = LENS
    for _ in range(200):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        x = (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial
        y = (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def expected(T_world_cam):
    """Depth of the nearer of board and wall along every pixel's ray."""
    direction = rays() @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    wall = (WALL - origin[2]) / direction[..., 2]
    board = (BOARD - origin[2]) / direction[..., 2]
    hit = origin + board[..., None] * direction
    on_board = (np.abs(hit[..., 0]) < 0.4) & (np.abs(hit[..., 1]) < 0.3)
    return np.where(on_board, board, wall), on_board


@pytest.fixture(scope="module")
def points():
    """A scan of both, its points on the wall 3 to 4 cm apart: sparser than the pixels."""
    generator = np.random.default_rng(0)
    wall = np.column_stack([generator.uniform(-8, 8, (200_000, 2)), np.full(200_000, WALL)])
    board = np.column_stack(
        [generator.uniform(-0.4, 0.4, 5000), generator.uniform(-0.3, 0.3, 5000), np.full(5000, BOARD)]
    )
    behind = generator.uniform(-1, 1, (20_000, 3)) - [0, 0, 3]
    return generator.permutation(np.concatenate([wall, board, behind]))


def turned(angle, centre):
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = centre
    return T


@pytest.mark.parametrize("T", [np.eye(4), turned(0.4, [-0.7, 0.1, 0.3])])
def test_surfaces_are_where_they_are(points, T):
    depth = depth_from_cloud(CAMERA, points)(T)
    ground_truth, on_board = expected(T)
    assert depth.shape == (120, 188) and depth.dtype == np.float32
    error = np.abs(depth - ground_truth) / ground_truth
    assert (depth > 0).all()
    assert np.median(error) < 0.005 and np.mean(error > 0.03) < 0.06  # silhouettes move by a few pixels
    core = on_board & np.roll(on_board, 4, 0) & np.roll(on_board, -4, 0)
    core &= np.roll(on_board, 4, 1) & np.roll(on_board, -4, 1)
    assert core.sum() > 200
    assert error[core].max() < 0.03  # the wall does not show through the board


def test_without_the_board_the_wall_is_seen(points):
    wall = points[points[:, 2] == WALL]
    np.testing.assert_allclose(depth_from_cloud(CAMERA, wall)(np.eye(4)), WALL, rtol=1e-6)


def test_wide_gaps_stay_empty():
    """Half a wall: it is continued by 20 pixels, and no further; nothing is seen the other way."""
    x, y = np.meshgrid(np.arange(-6, 0, 0.02), np.arange(-4, 4, 0.02))
    half = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, WALL)])
    look = depth_from_cloud(CAMERA._replace(distortion=()), half)
    depth = look(np.eye(4))
    np.testing.assert_allclose(depth[:, :111], WALL, rtol=1e-6)
    assert not depth[:, 113:].any()
    assert not look(turned(np.pi, [0, 0, 0])).any()


def test_points_far_outside_are_not_folded_back():
    """A lens whose polynomial turns around: at this angle it would put the points back into the image."""
    camera = CAMERA._replace(fx=200.0, fy=200.0, distortion=(-0.3, 0.0, 0.0, 0.0))
    x, y = np.meshgrid(np.linspace(6.5, 7.2, 50), np.linspace(-1, 1, 50))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, WALL)])  # x / z = 1.7
    r = 1.7
    assert 0 < 200 * r * (1 - 0.3 * r * r) + 92 < 188
    assert not depth_from_cloud(camera, points)(np.eye(4)).any()
