import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.geometry import se3
from jaxpose.imu import ADIS16448, GRAVITY_WORLD, QUIET, Imu
from jaxpose.imu.simulation import add_noise, interpolant, simulate, simulate_from_poses

TOLERANCE = {jnp.float32: 2e-5, jnp.float64: 1e-12}
LEVER = np.array([0.3, -0.2, 0.1])  # from the camera to the IMU, camera axes
TURN = Rotation.from_rotvec([0.4, -1.0, 0.3])  # of the IMU in the camera


def spin_angle(t):
    return 0.4 * t + 0.3 * t**2


def spinning_camera(t):
    """A camera that stays in place and turns about its z axis at 0.4 + 0.6 t rad/s."""
    zero = jnp.zeros_like(t)
    return se3.exp(jnp.stack([zero, zero, zero, zero, zero, spin_angle(t)]))


def spinning_readings(t):
    """What an IMU at LEVER, TURN on `spinning_camera` reads: rigid-body kinematics in camera axes."""
    omega = np.stack([0 * t, 0 * t, 0.4 + 0.6 * t], axis=1)
    alpha = np.broadcast_to([0, 0, 0.6], omega.shape)
    acceleration = np.cross(omega, np.cross(omega, LEVER)) + np.cross(alpha, LEVER)
    up = -np.array(GRAVITY_WORLD)  # the camera's z is the world's
    return TURN.inv().apply(omega), TURN.inv().apply(acceleration + up)


def camera_to_body():
    T_cam_body = np.eye(4)
    T_cam_body[:3, :3] = TURN.as_matrix()
    T_cam_body[:3, 3] = LEVER
    return T_cam_body


def test_circle(dtype):
    """Level flight on a circle, heading along it: centripetal force and the weight."""
    radius, rate = 2.0, 0.7

    def pose(t):
        half = jnp.stack([jnp.cos(rate * t / 2), 0 * t, 0 * t, jnp.sin(rate * t / 2)])
        position = radius * jnp.stack([jnp.cos(rate * t), jnp.sin(rate * t), 0 * t])
        return se3.make(se3.quaternion_to_rotation(half), position)

    imu = jax.jit(lambda times: simulate(pose, times))(jnp.linspace(0, 3, 7, dtype=dtype))
    assert imu.omega_body.dtype == imu.acceleration_body.dtype == dtype
    np.testing.assert_allclose(imu.omega_body, np.tile([0, 0, rate], (7, 1)), atol=TOLERANCE[dtype])
    expected = np.tile([-radius * rate**2, 0, 9.80665], (7, 1))
    np.testing.assert_allclose(imu.acceleration_body, expected, atol=TOLERANCE[dtype])


def test_free_fall_reads_nothing(dtype):
    gravity = jnp.array([1.0, -2.0, 9.0], dtype)

    def pose(t):
        return se3.make(jnp.eye(3, dtype=dtype), gravity * t**2 / 2)

    times = jnp.linspace(0, 1, 5, dtype=dtype)
    imu = jax.jit(lambda times: simulate(pose, times, gravity_world=gravity))(times)
    np.testing.assert_allclose(imu.acceleration_body, np.zeros((5, 3)), atol=TOLERANCE[dtype])


def test_lever_arm(dtype):
    T_cam_body = jnp.asarray(camera_to_body(), dtype)
    times = jnp.linspace(0, 2, 9, dtype=dtype)
    pose = lambda t: se3.compose(spinning_camera(t), T_cam_body)
    imu = jax.jit(lambda times: simulate(pose, times))(times)
    omega, force = spinning_readings(np.asarray(times, np.float64))
    np.testing.assert_allclose(imu.omega_body, omega, atol=TOLERANCE[dtype])
    np.testing.assert_allclose(imu.acceleration_body, force, atol=TOLERANCE[dtype])


def stamped_spin(rate_hz):
    times = np.arange(0, 2 + 1e-9, 1 / rate_hz)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(spin_angle(times)[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    return times, poses


# Away from the ends, where a spline has no neighbours. Half a frame at 0.6 rad/s^2 is what slerp is off by.
@pytest.mark.parametrize(("rotation", "omega_error"), [("spline", 1e-6), ("slerp", 0.6 * 0.5 / 20 * 1.001)])
def test_lever_arm_from_stamped_camera_poses(rotation, omega_error):
    times, poses = stamped_spin(20)
    imu = simulate_from_poses(times, poses, 200.0, rotation=rotation, T_cam_body=camera_to_body())
    np.testing.assert_allclose(imu.t, np.arange(401) / 200, atol=1e-12)
    inner = (imu.t > 0.4) & (imu.t < 1.6)
    omega, force = spinning_readings(imu.t)
    np.testing.assert_allclose(imu.omega_body[inner], omega[inner], atol=omega_error)
    # Slerp is off by alpha h^2 / 8 in angle, which tips nothing here but turns the centripetal part.
    np.testing.assert_allclose(imu.acceleration_body[inner], force[inner], atol=2e-3)


@pytest.fixture
def stamped():
    generator = np.random.default_rng(0)
    times = np.cumsum(generator.uniform(0.1, 0.3, 12))
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(generator.normal(size=(12, 3))).as_matrix()
    poses[:, :3, 3] = generator.normal(size=(12, 3))
    return times, poses


@pytest.mark.parametrize("rotation", ["slerp", "spline"])
def test_interpolant_against_finite_differences(rotation, stamped):
    times, poses = stamped
    path = interpolant(times, poses, rotation)
    np.testing.assert_allclose(path.pose(times), poses, atol=1e-12)
    at = np.concatenate([times[:-1] + f * np.diff(times) for f in (0.1, 0.5, 0.8)])
    h = 1e-4
    before, after = path.pose(at - h), path.pose(at + h)
    np.testing.assert_allclose(path.velocity_world(at), (after - before)[:, :3, 3] / (2 * h), atol=1e-4)
    acceleration = (path.velocity_world(at + h) - path.velocity_world(at - h)) / (2 * h)
    np.testing.assert_allclose(path.acceleration_world(at), acceleration, atol=1e-4)
    turn = Rotation.from_matrix(before[:, :3, :3]).inv() * Rotation.from_matrix(after[:, :3, :3])
    np.testing.assert_allclose(path.omega_body(at), turn.as_rotvec() / (2 * h), atol=1e-3)


def test_body_rate_of_slerp_is_constant_between_stamps_and_jumps_there(stamped):
    times, poses = stamped
    step = np.diff(times)
    slerp, spline = interpolant(times, poses, "slerp"), interpolant(times, poses, "spline")
    early, late = times[:-1] + 0.01 * step, times[:-1] + 0.99 * step
    np.testing.assert_allclose(slerp.omega_body(early), slerp.omega_body(late), atol=1e-12)
    assert abs(slerp.omega_body(times[1:-1] + 1e-9) - slerp.omega_body(times[1:-1] - 1e-9)).max() > 1
    np.testing.assert_allclose(
        spline.omega_body(times[1:-1] + 1e-9), spline.omega_body(times[1:-1] - 1e-9), atol=1e-5
    )


def test_poses_without_truth_are_bridged():
    times, poses = stamped_spin(20)
    poses[7:9] = np.nan
    imu = simulate_from_poses(times, poses, 100.0, rotation="spline")
    inner = (imu.t > 0.2) & (imu.t < 1.8)
    np.testing.assert_allclose(imu.omega_body[inner, 2], 0.4 + 0.6 * imu.t[inner], atol=1e-3)


def test_unusable_poses():
    times, poses = stamped_spin(20)
    with pytest.raises(DataError, match="at least 2 finite ones, got 0"):
        interpolant(times, np.full_like(poses, np.nan))
    with pytest.raises(DataError, match=r"expected rising times, got 0\.1 after 0\.15"):
        interpolant(times[[0, 1, 3, 2, 4]], poses[:5])


def resting(t):
    zeros = np.zeros((len(t), 3))
    return Imu(t, zeros, zeros)


@pytest.mark.parametrize("rate_hz", [50, 400])
def test_white_noise_is_the_density_times_the_root_of_the_rate(rate_hz):
    noise = QUIET._replace(gyro_density=0.01, accelerometer_density=0.03)
    noisy = add_noise(resting(np.arange(20000) / rate_hz), noise, jax.random.key(0))
    assert noisy.omega_body.dtype == np.float64
    assert noisy.omega_body.std() == pytest.approx(0.01 * rate_hz**0.5, rel=0.02)
    assert noisy.acceleration_body.std() == pytest.approx(0.03 * rate_hz**0.5, rel=0.02)
    correlation = np.corrcoef(noisy.omega_body.ravel(), noisy.acceleration_body.ravel())[0, 1]
    assert abs(correlation) < 0.02
    one_apart = (noisy.omega_body[1:] * noisy.omega_body[:-1]).mean() / noisy.omega_body.var()
    assert abs(one_apart) < 0.02


@pytest.mark.parametrize("rate_hz", [20, 80])
def test_variance_of_the_bias_grows_with_time(rate_hz):
    """Whatever the rate: walk^2 * elapsed."""
    t = jnp.arange(10 * rate_hz) / rate_hz
    rest = Imu(t, jnp.zeros((len(t), 3)), jnp.zeros((len(t), 3)))
    noise = QUIET._replace(gyro_walk=0.02, accelerometer_walk=0.05)
    runs = jax.jit(jax.vmap(lambda key: add_noise(rest, noise, key)))(
        jax.random.split(jax.random.key(1), 1000)
    )
    for channel, walk in ((runs.omega_body, 0.02), (runs.acceleration_body, 0.05)):
        for elapsed in (2.5, 10):
            bias = np.asarray(channel[:, int(elapsed * rate_hz) - 1])
            assert bias.var() == pytest.approx(walk**2 * elapsed, rel=0.1)  # 3 sigma of 3000


def test_a_key_means_the_same_noise_in_both_precisions(dtype):
    t = np.arange(5) / 200
    noisy = add_noise(resting(t), ADIS16448, jax.random.key(3))
    rest = Imu(jnp.asarray(t, dtype), jnp.zeros((5, 3), dtype), jnp.zeros((5, 3), dtype))
    traced = add_noise(rest, ADIS16448, jax.random.key(3))
    assert traced.omega_body.dtype == dtype
    np.testing.assert_allclose(traced.omega_body, noisy.omega_body, rtol=1e-4)
    np.testing.assert_allclose(traced.acceleration_body, noisy.acceleration_body, rtol=1e-4)


def test_noise_needs_a_key_and_a_rate():
    with pytest.raises(ValueError, match="expected a key"):
        add_noise(resting(np.arange(5) / 200), ADIS16448, None)
    with pytest.raises(ValueError, match="at least 2 readings"):
        add_noise(resting(np.zeros(1)), ADIS16448, jax.random.key(0))
