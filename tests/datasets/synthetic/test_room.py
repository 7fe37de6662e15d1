"""The synthetic room against independent geometry (signed distances, planes) and kinematics."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation

from jaxpose.datasets.synthetic import RoomConfig, hand_held, room
from jaxpose.datasets.synthetic.atlas import Atlas, gather, unfold
from jaxpose.datasets.synthetic.furniture import Piece, furnish
from jaxpose.datasets.synthetic.room_renderer import render
from jaxpose.datasets.synthetic.shapes import FACES, cast, locate, within_cone
from jaxpose.datasets.types import thin
from jaxpose.geometry.camera import Camera
from jaxpose.imu import ADIS16448, QUIET

EXACT = RoomConfig(depth_noise=0.0, holes=False, imu_noise=QUIET)


@pytest.fixture(scope="module")
def exact():
    return room(EXACT)


@pytest.fixture(scope="module")
def default():
    return room()


@pytest.fixture(scope="module")
def scene():
    return gather(furnish(np.random.default_rng(0)))


def outside(piece: Piece, point: np.ndarray) -> np.ndarray:
    """Signed distance of points (n, 3) to a solid, positive where a camera may be; written apart from src."""
    local = Rotation.from_euler("z", piece.yaw).inv().apply(point - piece.centre)
    if piece.kind == "room":
        return np.min(piece.half - np.abs(local), axis=-1)
    if piece.kind == "sphere":
        return np.linalg.norm(local, axis=-1) - piece.half[0]
    beyond = np.abs(local) - piece.half
    if piece.kind == "cylinder":
        radial = np.hypot(local[:, 0], local[:, 1]) - piece.half[0]
        beyond = np.stack([radial, beyond[:, 2]], axis=-1)
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def clearance(pieces, point: np.ndarray) -> np.ndarray:
    return np.min([outside(piece, point) for piece in pieces], axis=0)


def walked(seed: int, t: np.ndarray, speed: float = 1.0) -> np.ndarray:
    """T_world_body of a walk, float64."""
    walk = hand_held.draw(np.random.default_rng(seed), speed)
    with jax.enable_x64(True):
        return np.asarray(jax.jit(jax.vmap(partial(hand_held.pose, walk)))(jnp.asarray(t)))


def test_the_recording_is_what_was_asked_for(exact):
    assert exact.t[0] == 0 and exact.t[-1] == 12 and len(exact.t) == 61
    np.testing.assert_allclose(np.diff(exact.t), 0.2)
    assert exact.imu.t[0] == 0 and exact.imu.t[-1] == pytest.approx(12)
    np.testing.assert_allclose(np.diff(exact.imu.t), 1 / 200)
    frame = exact.read(0)
    assert frame.rgb.shape == (240, 320, 3) and frame.rgb.dtype == np.uint8
    assert frame.depth.shape == (240, 320) and frame.depth.dtype == np.float32
    assert exact.T_world_cam.dtype == exact.imu.omega_body.dtype == np.float64
    rotation = exact.T_world_cam[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), np.tile(np.eye(3), (61, 1, 1)), atol=1e-12)
    slow = thin(exact, 1.0)
    assert len(slow.t) == 13 and slow.read(2) is exact.read(10)


def test_rays_end_on_the_first_surface(scene):
    pieces, shapes = scene
    rng = np.random.default_rng(1)
    origin = rng.uniform((-2.4, -1.9, 0.1), (2.4, 1.9, 2.5), (400, 3))
    origin = origin[clearance(pieces, origin) > 0.02]
    direction = rng.normal(size=origin.shape)
    # aim half of them at furniture, thin legs and far spheres included
    targets = np.array([p.centre for p in pieces])[rng.integers(1, len(pieces), len(origin))]
    direction[::2] = (targets - origin + rng.normal(0, 0.02, origin.shape))[::2]
    to_rays = lambda x: tuple(jnp.asarray(x.T, jnp.float32))
    distance, number = map(np.asarray, cast(shapes, to_rays(origin), to_rays(direction)))
    reached = origin + distance[:, None] * direction
    assert len(np.unique(number)) > 60
    np.testing.assert_allclose(clearance(pieces, reached), 0, atol=2e-5)
    np.testing.assert_allclose(
        [outside(pieces[n], p[None])[0] for n, p in zip(number, reached, strict=True)], 0, atol=2e-5
    )
    along = np.linspace(0, 1, 60)[:, None, None] * (reached - origin) + origin
    assert clearance(pieces, along.reshape(-1, 3)).min() > -2e-5


def test_a_ray_from_inside_a_solid_ends_at_once(scene):
    pieces, shapes = scene
    centres = np.array([p.centre for p in pieces if p.kind != "room"], np.float32)
    distance, _ = cast(shapes, tuple(jnp.asarray(centres.T)), tuple(jnp.ones_like(centres.T)))
    np.testing.assert_array_equal(distance, 0)


def test_charts_and_surfaces_map_to_each_other(scene):
    pieces, shapes = scene
    rng = np.random.default_rng(2)
    kinds = [p.kind for p in pieces]
    for kind, faces in (("room", range(6)), ("box", range(6)), ("cylinder", (0, 4, 5)), ("sphere", (0,))):
        number = kinds.index(kind) + (2 if kind == "box" else 0)
        for face in faces:
            u, v = rng.uniform(0.02, 0.98, (2, 50)) if kind != "cylinder" else rng.uniform(0.3, 0.7, (2, 50))
            point, normal = unfold(pieces[number], face, u, v)
            np.testing.assert_allclose(outside(pieces[number], point), 0, atol=1e-9)
            np.testing.assert_allclose(outside(pieces[number], point + 1e-4 * normal), 1e-4, atol=1e-9)
            start, ahead = (tuple(jnp.asarray(x.T, jnp.float32)) for x in (point + 0.01 * normal, -normal))
            solid = jnp.full(50, number, jnp.int32)
            hit = locate(shapes, start, ahead, jnp.full(50, 0.01, jnp.float32), solid)
            np.testing.assert_array_equal(hit.face, FACES * number + face)
            np.testing.assert_allclose(hit.chart, (u, v), atol=2e-4)
            np.testing.assert_allclose(hit.cosine, 1, atol=1e-3)


def test_nothing_in_view_is_culled(scene):
    pieces, shapes = scene
    cast_all = jax.jit(cast)
    for T in walked(0, np.arange(5.0)).astype(np.float32):
        direction = T[:3, :3] @ np.random.default_rng(3).uniform((1, -0.6, -0.4), (1, 0.6, 0.4), (2000, 3)).T
        rays = tuple(jnp.asarray(T[:3, 3:])), tuple(jnp.asarray(direction))
        cosine = jnp.asarray(1 / np.sqrt(1 + 0.6**2 + 0.4**2), jnp.float32)
        seen = within_cone(shapes, jnp.asarray(T[:3, 3]), jnp.asarray(T[:3, 0]), cosine)
        assert 5 < int(seen.sum()) < 0.7 * len(seen)
        np.testing.assert_allclose(
            cast_all(shapes, *rays, seen=seen)[0], cast_all(shapes, *rays)[0], rtol=1e-6
        )


def test_depth_of_a_wall_is_its_distance(scene):
    _, shapes = scene
    grey = Atlas(
        jnp.full(1, 0x808080, jnp.uint32),
        jnp.zeros((FACES * len(scene[0]), 4), jnp.int32),
        *(jnp.ones((FACES * len(scene[0]), 4), jnp.int32),) * 2,
    )
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    upwards = np.diag([1.0, 1, 1, 1])
    upwards[:3, 3] = 0.1, -0.2, 1.4
    rgb, depth, cosine = render(camera, shapes, grey, jnp.asarray(upwards, jnp.float32))
    np.testing.assert_allclose(
        depth, 1.2, atol=1e-6
    )  # the ceiling, all over the image: depth is along the axis
    u, v = np.meshgrid(np.arange(64) - 31.5, np.arange(48) - 23.5)
    np.testing.assert_allclose(cosine, 60 / np.sqrt(u**2 + v**2 + 60**2), atol=1e-6)
    assert np.all(np.asarray(rgb) == 128)


def test_depth_of_two_frames_is_one_geometry(exact):
    camera, hidden, agreeing = exact.camera, [], []
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    for i, j in ((0, 2), (10, 13), (30, 33), (47, 50)):
        depth, other = exact.read(i).depth.astype(float), exact.read(j).depth
        point = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
        T = np.linalg.inv(exact.T_world_cam[j]) @ exact.T_world_cam[i]
        x, y, z = np.moveaxis((point * depth[..., None]) @ T[:3, :3].T + T[:3, 3], -1, 0)
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (column > 1) & (column < 317) & (row > 1) & (row < 237)
        column, row, z = column[inside], row[inside], z[inside]
        c, r = column.astype(int), row.astype(int)
        # on a plane 1 / z is linear in the pixel: interpolation is exact, and its second difference is zero
        patch = np.array([[1.0 / other[r + m, c + n] for n in range(-1, 3)] for m in range(-1, 3)])
        bent = sum(np.abs(np.diff(patch, 2, axis=k)).max((0, 1)) for k in (0, 1))
        a, b = column - c, row - r
        top, bottom = (patch[m, 1] * (1 - a) + patch[m, 2] * a for m in (1, 2))
        error = (1 / (top * (1 - b) + bottom * b) - z)[bent < 1e-4]
        hidden.append(np.mean(error < -0.02))
        visible = np.abs(error) < 0.02
        agreeing.append(visible.mean())
        assert np.abs(error[visible]).max() < 1e-3 and np.median(np.abs(error)) < 1e-5
        assert np.mean(error > 0.02) < 1e-3  # nothing shows through
    assert min(agreeing) > 0.9
    assert max(hidden) > 0.01  # things do get in front of others


def test_depth_has_range_and_edges(exact):
    depth = np.stack([exact.read(i).depth for i in range(0, 61, 6)])
    assert depth.min() > 0.4 and np.ptp(depth) > 3
    edges = np.abs(np.diff(depth, axis=2)) > 0.1
    assert np.all(edges.mean((1, 2)) > 0.002)


def test_every_part_of_a_picture_has_texture(exact):
    for i in range(0, 61, 6):
        grey = exact.read(i).rgb.astype(float).mean(-1)
        blocks = grey.reshape(6, 40, 8, 40).swapaxes(1, 2)
        assert np.all(blocks.std((2, 3)) > 2) and np.median(blocks.std((2, 3))) > 10
        down, across = np.gradient(grey)
        assert np.mean(np.hypot(down, across) > 4) > 0.25
        assert 70 < grey.mean() < 180 and np.mean(grey > 250) < 0.05


def body_poses(recording):
    return recording.T_world_cam @ np.linalg.inv(recording.T_body_cam)


def test_the_gyroscope_integrates_to_the_truth(exact):
    rotation, ground_truth = integrated(exact.imu.omega_body, body_poses(exact)), body_poses(exact)[:, :3, :3]
    error = Rotation.from_matrix(ground_truth).inv() * rotation[::40]
    assert np.degrees(error.magnitude()).max() < 0.01
    assert np.degrees((rotation[0].inv() * rotation).magnitude()).max() > 90


def integrated(rate, poses) -> Rotation:
    """Rotations at 200 Hz from the first pose on, by the midpoint rule."""
    steps = Rotation.from_rotvec((rate[1:] + rate[:-1]) / 2 / 200)
    rotation = [Rotation.from_matrix(poses[0, :3, :3])]
    for step in steps:
        rotation.append(rotation[-1] * step)
    return Rotation.concatenate(rotation)


def test_the_accelerometer_integrates_to_the_truth(exact):
    poses = body_poses(exact)
    rotation = integrated(exact.imu.omega_body, poses)
    acceleration = rotation.apply(exact.imu.acceleration_body) + exact.gravity_world
    assert np.abs(acceleration).max() > 1
    weight = 1 - np.abs(np.linspace(-1, 1, 401))
    for second in range(1, 12):
        # p(t + 1) - 2 p(t) + p(t - 1) is the integral of (1 - |s|) a(t + s): no velocity needed
        k = 200 * second
        moved = simpson(weight[:, None] * acceleration[k - 200 : k + 201], dx=1 / 200, axis=0)
        p = poses[5 * second - 5 : 5 * second + 6 : 5, :3, 3]
        np.testing.assert_allclose(moved, p[2] - 2 * p[1] + p[0], atol=1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_the_walk_is_human_and_touches_nothing(seed):
    pieces = furnish(np.random.default_rng(seed))
    t = np.arange(0, 60, 0.02)
    T = walked(seed, t)
    assert clearance(pieces, T[:, :3, 3]).min() > 0.46  # so 0.4 m at the camera, 6 cm away
    speed = np.linalg.norm(np.gradient(T[:, :3, 3], 0.02, axis=0), axis=-1)
    turns = Rotation.from_matrix(T[:-1, :3, :3]).inv() * Rotation.from_matrix(T[1:, :3, :3])
    rate = np.degrees(turns.magnitude()) / 0.02
    assert 0.3 < np.median(speed) < 0.8 and speed.max() < 1.2
    assert 20 < np.median(rate) < 50 and rate.max() < 75
    yaw = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    assert np.ptp(yaw[t < 12.5]) > 2 * np.pi * 0.9


def test_speed_scales_the_walk():
    t = np.linspace(0, 3, 7)
    np.testing.assert_allclose(walked(0, t, 2.0), walked(0, 2 * t), atol=1e-12)


def test_depth_noise_has_the_stated_size(exact, default):
    true, read = (
        np.concatenate([recording.read(i).depth.ravel() for i in range(0, 61, 10)]).astype(float)
        for recording in (exact, default)
    )
    np.testing.assert_allclose(1000 * read, np.round(1000 * read), atol=1e-3)
    for near, far in ((1.0, 1.5), (2.0, 2.5), (3.0, 3.5)):
        z, error = ((true, read - true)[k][(read > 0) & (true > near) & (true < far)] for k in (0, 1))
        spread = np.sqrt(np.mean((0.0012 + 0.0019 * (z - 0.4) ** 2) ** 2) + 0.001**2 / 12)
        assert error.std() == pytest.approx(spread, rel=0.03) and abs(error.mean()) < 0.03 * spread


def test_imu_noise_has_the_stated_density(exact, default):
    for channel, density in (
        ("omega_body", ADIS16448.gyro_density),
        ("acceleration_body", ADIS16448.accelerometer_density),
    ):
        error = getattr(default.imu, channel) - getattr(exact.imu, channel)
        white = np.diff(error, axis=0).std() / np.sqrt(2)  # differences leave the biases out
        assert white == pytest.approx(density * np.sqrt(200), rel=0.05)


def test_holes_are_few(default):
    share = [np.mean(default.read(i).depth == 0) for i in range(0, 61, 10)]
    assert 0.002 < np.mean(share) < 0.1


def test_the_same_seed_makes_the_same_room(default):
    again = room()
    for i in (60, 3):
        np.testing.assert_array_equal(again.read(i).rgb, default.read(i).rgb)
        np.testing.assert_array_equal(again.read(i).depth, default.read(i).depth)
    np.testing.assert_array_equal(again.imu.omega_body, default.imu.omega_body)
    np.testing.assert_array_equal(again.T_world_cam, default.T_world_cam)


def test_another_seed_makes_another_room(default):
    other = room(RoomConfig(seed=1))
    assert np.abs(other.T_world_cam - default.T_world_cam)[:, :3].max((1, 2)).min() > 0.01
    white = [np.diff(recording.imu.omega_body, 2, axis=0)[:, 0] for recording in (default, other)]
    assert abs(np.corrcoef(white)[0, 1]) < 0.1


def test_every_paint_depends_on_its_generator():
    x = np.arange(1, 60) * 0.005
    for piece in furnish(np.random.default_rng(0)):
        for painter in piece.painters:
            first, again, other = (painter(np.random.default_rng(seed), x, x[:40]) for seed in (0, 0, 1))
            assert first.shape == (40, 59, 3) and np.isfinite(first).all() and first.min() >= 0
            np.testing.assert_array_equal(first, again)
            assert np.mean(first != other) > 0.5


@pytest.mark.parametrize(
    "setting",
    [
        {"duration_s": 0.0},
        {"rate_hz": -5.0},
        {"imu_rate_hz": float("nan")},
        {"width": 0},
        {"speed": float("inf")},
        {"depth_noise": -0.1},
        {"sensor": "sonar"},
        {"scene": "attic"},
        {"seed": -1},
        {"duration_s": 0.1},
    ],
)
def test_bad_settings_are_refused(setting, unchecked):
    with pytest.raises(ValueError, match="RoomConfig"):
        RoomConfig(**setting)
