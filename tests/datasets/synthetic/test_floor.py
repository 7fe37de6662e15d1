"""The floor's tour: it comes back, looks ahead and goes through nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose.datasets.synthetic import RoomConfig, floor, hand_held
from jaxpose.datasets.synthetic.room_renderer import room

SPEED = 1.4


@pytest.fixture(scope="module")
def toured():
    """Times over a lap and a half, and the body's poses of a walk."""
    t = np.linspace(0, 1.5 * floor.TOUR_S / SPEED, 1201)
    with jax.enable_x64(True):
        walk = hand_held.draw(np.random.default_rng(0), SPEED)
        T = jax.jit(jax.vmap(lambda t: floor.tour(walk, t)))(jnp.asarray(t))
        return t, np.asarray(T)


def away_from(piece, points):
    """Distance [m] of points to a solid, negative within."""
    c, s = np.cos(piece.yaw), np.sin(piece.yaw)
    local = (points - piece.centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    if piece.kind == "sphere":
        return np.linalg.norm(local, axis=-1) - piece.half[0]
    beyond = np.abs(local) - piece.half
    if piece.kind == "cylinder":
        around = np.linalg.norm(local[:, :2], axis=-1) - piece.half[0]
        beyond = np.stack([around, beyond[:, 2]], axis=-1)
    return np.where((beyond < 0).all(-1), beyond.max(-1), np.linalg.norm(np.maximum(beyond, 0), axis=-1))


def test_the_tour_goes_through_nothing(toured):
    shell, *pieces = floor.furnish(np.random.default_rng(3))
    assert shell.kind == "room" and (away_from(shell, toured[1][:, :3, 3]) < -0.5).all()
    clear = [away_from(piece, toured[1][:, :3, 3]).min() for piece in pieces]
    assert min(clear) > 0.25 and len(pieces) > 100


def test_every_door_is_gone_through(toured):
    """Walls with doors are across the tour's way: it passes within a metre of each side."""
    walls = [p for p in floor.furnish(np.random.default_rng(0)) if p.kind == "box" and p.half[2] == 1.3]
    assert len(walls) == 2 + 3 * 2  # the core, the corridor's outer side, and two for each door
    for wall in walls[2:]:
        assert 0.25 < away_from(wall, toured[1][:, :3, 3]).min() < 1


def test_the_tour_comes_back_and_looks_ahead(toured):
    t, T = toured
    lap = t[-1] / 1.5
    again = np.interp(t[t <= t[-1] - lap] + lap, t, T[:, 0, 3]), T[t <= t[-1] - lap, 0, 3]
    assert np.abs(again[0] - again[1]).max() < 0.3  # but for the sway of the hand
    step = np.diff(T[:, :2, 3], axis=0)
    length = np.linalg.norm(step, axis=1)
    assert length[t[1:] <= lap].sum() == pytest.approx(36, abs=1.5)  # metres around
    ahead = np.einsum("ni,ni->n", step / length[:, None], T[:-1, :2, 0])
    assert np.median(ahead) > 0.9 and ahead.min() > 0.5


@pytest.mark.slow
def test_the_floor_is_seen_as_its_poses_say():
    """Depth from one pose, seen from another a step on, is the depth there."""
    recording = room(
        RoomConfig(
            scene="floor", duration_s=1.0, rate_hz=2.0, width=80, height=60, depth_noise=0.0, holes=False
        )
    )
    assert recording.T_world_cam is not None
    camera = recording.camera
    v, u = np.mgrid[:60, :80]
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    first, second = recording.read(0).depth, recording.read(1).depth
    T = np.linalg.inv(recording.T_world_cam[1]) @ recording.T_world_cam[0]
    x, y, z = np.moveaxis((ray * first[..., None]) @ T[:3, :3].T + T[:3, 3], -1, 0)
    column, row = (
        np.rint(k).astype(int) for k in (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy)
    )
    inside = (z > 0.1) & (column >= 0) & (column < 80) & (row >= 0) & (row < 60) & (first > 0)
    off = np.abs(second[row[inside], column[inside]] - z[inside])
    assert inside.mean() > 0.5 and np.median(off) < 0.03
