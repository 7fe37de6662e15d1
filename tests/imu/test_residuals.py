import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.fields.derivatives import motion
from jaxpose.geometry import se3
from jaxpose.imu import (
    ADIS16448,
    QUIET,
    Imu,
    accelerometer_residual,
    gyro_loose_residual,
    gyro_tight_residual,
    imu_residuals,
    integrate_gyro,
    remove_gravity,
    residual_sigmas,
    windows,
)
from jaxpose.imu.simulation import add_noise, simulate

TOLERANCE = {jnp.float32: 3e-5, jnp.float64: 1e-12}


def turned(axis, angle):
    """The rotation about a unit vector, written out."""
    K = np.cross(axis, np.eye(3)).T
    constant = lambda matrix: jnp.asarray(matrix, angle.dtype)
    return constant(np.eye(3)) + jnp.sin(angle) * constant(K) + (1 - jnp.cos(angle)) * constant(K @ K)


def tumbling(t):
    """T_world_body of a body that swings and turns about changing axes, more than two full turns in 4 s."""
    position = jnp.stack([jnp.sin(1.3 * t), 0.5 * jnp.cos(2 * t), 0.2 * t**2])
    tilt = turned([0.0, 0.6, 0.8], 0.6 * jnp.sin(2 * t))
    return se3.make(jnp.matmul(turned([1.0, 0.0, 0.0], 4 * t), tilt, precision="highest"), position)


def since(pose_fn, start):
    """The motion in the body's frame at `start`: T_start_body."""
    return lambda t: se3.compose(se3.inverse(pose_fn(start)), pose_fn(t))


def rotations(pose_fn, times):
    return jax.vmap(pose_fn)(times)[:, :3, :3]


def test_residuals_of_the_field_that_made_the_readings_vanish(dtype):
    """Two intervals: readings with gravity, integrated and freed of it, against the field they came from."""

    @jax.jit
    def residuals(times):
        imu = simulate(tumbling, times)
        relative = since(tumbling, times[0])
        acceleration = remove_gravity(imu, rotations(tumbling, times))
        integrated = integrate_gyro(jnp.eye(3, dtype=dtype), times, imu.omega_body)
        return [
            imu_residuals(relative, times, imu.omega_body, acceleration, R_start_body)
            for R_start_body in (rotations(relative, times), integrated)
        ]

    for begin in (0.3, 2.9):
        exact, integrated = residuals(jnp.linspace(begin, begin + 0.2, 41, dtype=dtype))
        zero, atol = np.zeros((41, 3)), TOLERANCE[dtype]
        np.testing.assert_allclose(exact.loose, zero, atol=atol)
        np.testing.assert_allclose(exact.tight, zero, atol=atol)
        np.testing.assert_allclose(exact.accelerometer, zero, atol=10 * atol)
        # The midpoint rule at 200 Hz adds its own error.
        np.testing.assert_allclose(integrated.loose, zero, atol=1e-4)
        np.testing.assert_allclose(integrated.accelerometer, zero, atol=1e-3)


def test_gravity_is_removed_exactly(dtype):
    times = jnp.linspace(0, 2, 9, dtype=dtype)
    gravity = (1.0, 2.0, -9.0)
    imu = jax.jit(lambda times: simulate(tumbling, times, gravity_world=gravity))(times)
    ground_truth = jax.jit(jax.vmap(lambda t: motion(tumbling, t)))(times)
    R_world_body = ground_truth.pose[:, :3, :3]
    expected = np.einsum("nji,nj->ni", R_world_body, ground_truth.acceleration_world)
    acceleration = remove_gravity(imu, R_world_body, gravity)
    np.testing.assert_allclose(acceleration, expected, atol=TOLERANCE[dtype])


def test_residuals_measure_what_they_say(dtype):
    """A field that differs from the readings by a known rotation, rate and acceleration."""
    times = jnp.linspace(0, 1, 11, dtype=dtype)
    error, rate = jnp.array([0.02, -0.01, 0.03], dtype), 0.5
    acceleration = jnp.array([0.3, 0.0, -0.2], dtype)
    reading = jnp.tile(jnp.array([[1.0, 0, 0]], dtype), (11, 1))  # along the body's turning x axis

    def field(t):
        return se3.make(turned([0.0, 1.0, 0.0], rate * t), acceleration * t**2 / 2)

    @jax.jit
    def residuals(times):
        R_ref_body = rotations(field, times)
        off = jnp.matmul(R_ref_body, se3.so3_exp(-error)[None], precision="highest")
        return (
            gyro_loose_residual(field, times, off),
            gyro_tight_residual(field, times, jnp.tile(error, (11, 1))),
            accelerometer_residual(field, times, reading, R_ref_body),
        )

    loose, tight, rest = residuals(times)
    atol = TOLERANCE[dtype]
    np.testing.assert_allclose(loose, np.tile(error, (11, 1)), atol=atol)
    np.testing.assert_allclose(tight, np.tile([0, rate, 0] - np.asarray(error), (11, 1)), atol=atol)
    angle = rate * np.asarray(times)
    axis = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=1)
    np.testing.assert_allclose(rest, np.asarray(acceleration) - axis, atol=atol)


def test_the_single_residuals_are_those_of_the_shared_pass(dtype):
    times = jnp.linspace(0, 1, 11, dtype=dtype)
    omega, acceleration, turn = jax.random.normal(jax.random.key(0), (3, 11, 3), dtype)

    @jax.jit
    def both(turn):
        R_ref_body = se3.so3_exp(turn)
        single = (
            gyro_loose_residual(tumbling, times, R_ref_body),
            gyro_tight_residual(tumbling, times, omega),
            accelerometer_residual(tumbling, times, acceleration, R_ref_body),
        )
        return imu_residuals(tumbling, times, omega, acceleration, R_ref_body), single

    for shared, single in zip(*both(turn), strict=True):
        np.testing.assert_allclose(shared, single, atol=10 * TOLERANCE[dtype])


def test_tight_residual_is_twice_that_between_quaternions(dtype):
    """METHOD's form: |dq/dt - q * (0, omega) / 2|, by finite differences of scipy's quaternions."""
    times = jnp.array([0.2, 0.5, 1.1], dtype)
    omega = jnp.array([[0.1, 2.0, -1.0], [0.0, 0.0, 0.0], [5.0, 1.0, 0.0]], dtype)
    ours = np.linalg.norm(jax.jit(lambda t: gyro_tight_residual(tumbling, t, omega))(times), axis=1)
    with jax.enable_x64(True):
        turn = jax.jit(lambda t: rotations(tumbling, t))
        exact = lambda t: Rotation.from_matrix(turn(jnp.asarray(t, jnp.float64)))
        t, h = np.asarray(times, np.float64), 1e-5
        here, after, before = exact(t).as_quat(), exact(t + h).as_quat(), exact(t - h).as_quat()
    after *= np.sign((after * here).sum(1, keepdims=True))
    before *= np.sign((before * here).sum(1, keepdims=True))
    vector, real = here[:, :3], here[:, 3:]
    product = np.hstack([real * omega + np.cross(vector, omega), -(vector * omega).sum(1, keepdims=True)])
    theirs = np.linalg.norm((after - before) / (2 * h) - product / 2, axis=1)
    np.testing.assert_allclose(ours, 2 * theirs, rtol=1e-4)


def test_the_sign_of_a_quaternion_does_not_matter(dtype):
    """A field whose quaternion changes sign on the way, as it must on a path of more than a full turn."""
    times = jnp.linspace(0, 4, 33, dtype=dtype)
    omega = jnp.tile(jnp.array([[2.5, 0.0, 0.0]], dtype), (33, 1))

    @jax.jit
    def residuals(flip_at):
        def field(t):
            half = 1.25 * t
            quaternion = jnp.stack([jnp.cos(half), jnp.sin(half), 0 * t, 0 * t])
            sign = jnp.where(t < flip_at, 1, -1).astype(dtype)
            return se3.make(se3.quaternion_to_rotation(sign * quaternion), jnp.zeros(3, dtype))

        integrated = integrate_gyro(jnp.eye(3, dtype=dtype), times, omega)
        return gyro_loose_residual(field, times, integrated), gyro_tight_residual(field, times, omega)

    for flip_at in (9.0, -1.0, 1.7):
        for residual in residuals(flip_at):
            np.testing.assert_allclose(residual, np.zeros((33, 3)), atol=TOLERANCE[dtype])


def test_gradients_at_the_identity_are_finite_and_right(dtype):
    """Every field starts at rest at the identity, where the angle is exactly zero."""
    times = jnp.linspace(0, 0.2, 5, dtype=dtype)
    omega = jnp.full((5, 3), 0.1, dtype)
    target = jax.jit(se3.so3_exp)(omega * times[:, None])

    def loss(twist):
        def pose(t):
            position, turn = jnp.split(twist[0] + twist[1] * t + twist[2] * t**2, 2)
            return se3.make(se3.so3_exp(turn), position)

        rest = imu_residuals(pose, times, omega, omega, target)
        return sum(jnp.sum(x**2) for x in rest)

    gradient = jax.jit(jax.grad(loss))(jnp.zeros((3, 6), dtype))
    # Only the part linear in the twist remains at zero: loose phi - omega t, tight phi' - omega, a = 2 c - a.
    t = np.asarray(times, np.float64)
    expected = np.zeros((3, 6))
    expected[0, 3:] = -2 * 0.1 * t.sum()
    expected[1, 3:] = -2 * 0.1 * (t**2).sum() - 2 * 0.1 * 5
    expected[2, 3:] = -2 * 0.1 * (t**3).sum() - 2 * 0.1 * 2 * t.sum()
    expected[2, :3] = -2 * 2 * np.einsum("nij,nj->i", target, omega)
    np.testing.assert_allclose(gradient, expected, atol=10 * TOLERANCE[dtype])


def test_integration_at_a_constant_rate_is_exact(dtype):
    times = jnp.linspace(0, 2, 101, dtype=dtype)
    omega = np.array([0.5, -2.0, 1.0])
    start = Rotation.from_rotvec([0.3, 0.2, 3.0])
    result = jax.jit(integrate_gyro)(
        jnp.asarray(start.as_matrix(), dtype), times, jnp.tile(jnp.asarray(omega, dtype), (101, 1))
    )
    expected = (start * Rotation.from_rotvec(np.asarray(times, np.float64)[:, None] * omega)).as_matrix()
    np.testing.assert_allclose(result, expected, atol=TOLERANCE[dtype])


def test_integration_is_of_second_order():
    @jax.jit
    def error(times):
        ground_truth = jax.vmap(lambda t: motion(tumbling, t))(times)
        R_world_body = ground_truth.pose[:, :3, :3]
        return abs(integrate_gyro(R_world_body[0], times, ground_truth.omega_body) - R_world_body).max()

    with jax.enable_x64(True):
        coarse, fine = (float(error(jnp.linspace(0, 1, count + 1))) for count in (50, 100))
    assert 3.5 < coarse / fine < 4.5
    assert fine < 1e-3


def test_padding_does_not_turn(dtype):
    times = jnp.linspace(0, 1, 11, dtype=dtype)
    omega = jax.random.normal(jax.random.key(1), (11, 3), dtype)
    mask = jnp.arange(11) < 7
    start = jnp.eye(3, dtype=dtype)
    padded = jnp.where(mask[:, None], omega, jnp.nan)
    result = jax.jit(integrate_gyro)(start, jnp.where(mask, times, -5.0), padded, mask)
    expected = jax.jit(integrate_gyro)(start, times[:7], omega[:7])
    np.testing.assert_allclose(result[:7], expected, atol=TOLERANCE[dtype])
    np.testing.assert_array_equal(result[7:], np.tile(result[6], (4, 1, 1)))


def test_a_weight_of_one_is_one_sigma():
    """Noise of the data sheet on a resting body: each residual over its sigma has a deviation of one."""
    rate_hz, duration = 200.0, 0.5
    t = jnp.linspace(0, duration, 101)
    eye = jnp.tile(jnp.eye(3)[None], (101, 1, 1))
    rest = Imu(t, jnp.zeros((101, 3)), jnp.zeros((101, 3)))
    noise = ADIS16448._replace(gyro_walk=0.0, accelerometer_walk=0.0)

    def residuals(key):
        imu = add_noise(rest, noise, key)
        integrated = integrate_gyro(eye[0], t, imu.omega_body)
        loose = gyro_loose_residual(lambda t: jnp.eye(4), t, integrated)[-1]
        others = imu_residuals(lambda t: jnp.eye(4), t, imu.omega_body, imu.acceleration_body, eye)
        return loose, others.tight, others.accelerometer

    loose, tight, accelerometer = jax.jit(jax.vmap(residuals))(jax.random.split(jax.random.key(2), 400))
    sigmas = residual_sigmas(noise, rate_hz, duration)
    assert loose.std() / sigmas.loose == pytest.approx(1, rel=0.1)
    assert tight.std() / sigmas.tight == pytest.approx(1, rel=0.02)
    assert accelerometer.std() / sigmas.accelerometer == pytest.approx(1, rel=0.02)
    one_sample = noise.gyro_density / np.sqrt(rate_hz)
    assert residual_sigmas(noise, rate_hz, 0.0).loose == pytest.approx(one_sample)
    assert residual_sigmas(QUIET, rate_hz, 1.0) == (0, 0, 0)


def ramp(t):
    """Readings that are linear in time, so that interpolation is exact."""
    return Imu(t, t[:, None] * [1.0, 2.0, 3.0], t[:, None] * [-1.0, 0.0, 1.0])


def test_windows_start_and_end_at_the_frames():
    imu = ramp(np.arange(100) / 100)
    frames = np.array([0.105, 0.13, 0.2, 0.3333])
    cut, mask = windows(imu, frames)
    assert cut.t.shape == mask.shape == (3, 15)
    np.testing.assert_array_equal(mask.sum(axis=1), [4, 8, 15])
    np.testing.assert_allclose(cut.t[0, :5], [0.105, 0.11, 0.12, 0.13, 0.13])
    np.testing.assert_allclose(cut.t[2, [0, 1, -2, -1]], [0.2, 0.21, 0.33, 0.3333])
    np.testing.assert_allclose(cut.omega_body, cut.t[..., None] * [1.0, 2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(cut.acceleration_body, cut.t[..., None] * [-1.0, 0.0, 1.0], atol=1e-12)
    assert (np.diff(cut.t, axis=1) >= 0).all()


def test_windows_integrate_like_the_whole():
    imu = jax.jit(lambda times: simulate(tumbling, times))(jnp.linspace(0, 1, 201))
    frames = np.array([0.1, 0.3, 0.6, 0.9])
    cut, mask = windows(Imu(*map(np.asarray, imu)), frames)
    steps = jax.jit(jax.vmap(lambda t, omega, valid: integrate_gyro(jnp.eye(3), t, omega, valid)[-1]))(
        jnp.asarray(cut.t), jnp.asarray(cut.omega_body), jnp.asarray(mask)
    )
    at = jax.jit(lambda t: rotations(tumbling, t))(jnp.asarray(frames))
    np.testing.assert_allclose(steps, np.einsum("nji,njk->nik", at[:-1], at[1:]), atol=1e-4)


def test_windows_outside_the_readings():
    imu = ramp(1 + np.arange(100) / 100)
    _, mask = windows(imu, np.array([0.5, 1.2, 1.5, 1.995, 2.5]))  # the last reading is at 1.99
    np.testing.assert_array_equal(mask.any(axis=1), [False, True, True, False])
    with pytest.raises(
        DataError, match=r"between 5\.000 and 6\.000 s \(the frames\), got .* 1\.000 and 1\.990"
    ):
        windows(imu, np.array([5.0, 6.0]))
