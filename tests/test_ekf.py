"""The error-state filter: its Jacobian, its statistics on a motion in closed form, and on real readings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxpose import ekf, ekf_steps, se3
from jaxpose.data import euroc
from jaxpose.ekf import filter_imu
from jaxpose.ekf_steps import PoseNoise, State, difference, propagate, retract, transition
from jaxpose.errors import DataError
from jaxpose.imu import ADIS16448, GRAVITY_WORLD, Imu
from jaxpose.imu_simulation import simulate

POSE_NOISE = PoseNoise(1e-3, np.radians(0.1))  # of a motion-capture system
BIASES = np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.15])


def truth(t):
    """T_world_body: three sines in position, and in the rotation vector."""
    position = jnp.stack([jnp.sin(1.3 * t), 0.7 * jnp.sin(0.9 * t + 1), 0.4 * jnp.sin(2.1 * t)])
    turn = jnp.stack([0.4 * jnp.sin(1.1 * t), 0.3 * jnp.sin(1.7 * t + 2), 0.8 * jnp.sin(0.6 * t)])
    return se3.make(se3.so3_exp(turn), position)


@pytest.fixture(scope="module")
def still_air():
    """Clean readings at 200 Hz for 20 s, true accelerations [m/s^2, world], poses at 20 Hz; float64."""
    with jax.enable_x64(True):
        t = jnp.arange(4000) / 200
        imu = jax.device_get(simulate(truth, t))
        poses = np.asarray(jax.vmap(truth)(t))
    R = poses[:, :3, :3]
    acceleration = np.einsum("nij,nj->ni", R, imu.acceleration_body) + np.asarray(GRAVITY_WORLD)
    return imu, acceleration, np.asarray(t)[5::10], poses[5::10]


def recorded(still_air, seed):
    """The readings and the poses with noise; the biases are constant."""
    imu, _, t_pose, T = still_air
    rng = np.random.default_rng(seed)
    noisy = lambda clean, density, bias: clean + bias + density * np.sqrt(200) * rng.normal(size=clean.shape)
    imu = Imu(
        imu.t,
        noisy(imu.omega_body, ADIS16448.gyro_density, BIASES[0]),
        noisy(imu.acceleration_body, ADIS16448.accelerometer_density, BIASES[1]),
    )
    return imu, t_pose, measured(T, rng)


def measured(T, rng):
    """Poses as a motion-capture system would give them: white noise of POSE_NOISE."""
    T = T.copy()
    T[:, :3, 3] += POSE_NOISE.position * rng.normal(size=(len(T), 3))
    turn = Rotation.from_rotvec(POSE_NOISE.rotation * rng.normal(size=(len(T), 3))).as_matrix()
    T[:, :3, :3] = T[:, :3, :3] @ turn
    return T


def mean_nis(filtered):
    """The mean of the normalised innovations squared, and the band that holds 95% of such means."""
    nis = filtered.nis[np.isfinite(filtered.nis)]
    return nis.mean(), chi2.ppf([0.025, 0.975], 6 * len(nis)) / len(nis)


def test_the_transition_is_the_derivative_of_the_motion():
    """Against central differences of the nonlinear propagation, in float64."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        state = State(truth(jnp.asarray(0.7)), *(jnp.asarray(rng.normal(size=3)) for _ in range(3)))
        readings = (jnp.asarray(0.01), *(jnp.asarray(rng.normal(size=(2, 3))) for _ in range(2)))
        gravity = jnp.asarray(GRAVITY_WORLD)
        after, F = transition(state, *readings, gravity)
        step = 1e-6
        ahead = lambda error: difference(after, propagate(retract(state, error), *readings, gravity))
        columns = jax.jit(jax.vmap(lambda e: (ahead(step * e) - ahead(-step * e)) / (2 * step)))(jnp.eye(15))
        np.testing.assert_allclose(F, columns.T, atol=1e-8)


def test_retract_undoes_difference():
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        a, b = (
            State(truth(jnp.asarray(s)), *(jnp.asarray(rng.normal(size=3)) for _ in range(3)))
            for s in (0.2, 1.9)
        )
        for found, expected in zip(retract(a, difference(a, b)), b, strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-12)


def test_consistent_and_unbiased_on_a_known_motion(still_air):
    """Innovations are as large as the filter says, biases are found, noise is taken away."""
    _, acceleration, _, poses = still_air
    means, inside = [], 0
    for seed in range(5):
        imu, t_pose, T = recorded(still_air, seed)
        # The biases do not walk here, but a filter must allow for it.
        filtered = filter_imu(imu, t_pose, T, ADIS16448, POSE_NOISE, smooth=True)
        mean, band = mean_nis(filtered)
        means.append(mean)
        inside += band[0] < mean < band[1]
        assert np.abs(filtered.gyro_bias[-1] - BIASES[0]).max() < 2e-3
        assert np.abs(filtered.accelerometer_bias[-1] - BIASES[1]).max() < 0.05
        late = slice(400, -400)
        left = np.std(filtered.acceleration_world[late] - acceleration[late])
        assert left < 0.9 * ADIS16448.accelerometer_density * np.sqrt(200)
        position = filtered.T_world_body[5::10, :3, 3]
        assert np.std(position - poses[:, :3, 3]) < 0.7 * POSE_NOISE.position
    assert inside >= 4
    assert abs(np.mean(means) - 6) < 0.25  # walks that do not happen make it a little too careful


def test_wrong_noise_shows_in_the_innovations(still_air):
    imu, t_pose, T = recorded(still_air, 0)
    bold = filter_imu(imu, t_pose, T, ADIS16448, PoseNoise(2e-4, np.radians(0.02)))
    mean, band = mean_nis(bold)
    assert mean > 2 * band[1]


def test_both_precisions_agree(still_air):
    imu, t_pose, T = recorded(still_air, 0)
    single = filter_imu(imu, t_pose, T, ADIS16448, POSE_NOISE)
    with jax.enable_x64(True):
        double = filter_imu(imu, t_pose, T, ADIS16448, POSE_NOISE)
    assert single.nis.dtype == np.float32 and double.nis.dtype == np.float64
    late = slice(100, None)
    np.testing.assert_allclose(single.T_world_body[late], double.T_world_body[late], atol=2e-4)
    np.testing.assert_allclose(single.gyro_bias[-1], double.gyro_bias[-1], atol=2e-4)


def test_the_same_length_is_compiled_once(still_air):
    imu, t_pose, T = recorded(still_air, 0)
    filter_imu(imu, t_pose, T, ADIS16448, POSE_NOISE)
    before = ekf_steps.forward._cache_size()
    filter_imu(*recorded(still_air, 1), ADIS16448._replace(gyro_density=1e-3), PoseNoise(2e-3, 1e-3))
    assert ekf_steps.forward._cache_size() == before


def test_rows_before_the_first_pose_are_empty(still_air):
    imu, t_pose, T = recorded(still_air, 0)
    T = T.copy()
    T[:10] = np.nan
    filtered = filter_imu(imu, t_pose, T, ADIS16448, POSE_NOISE)
    first = np.flatnonzero(np.isfinite(filtered.velocity_world[:, 0]))[0]
    assert filtered.t[first] == pytest.approx(t_pose[10]) and filtered.poses_skipped == 10
    assert np.isfinite(filtered.T_world_body[first:]).all()


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda imu, t, T: (imu._replace(t=imu.t[::-1]), t, T), "IMU: expected rising stamps"),
        (lambda imu, t, T: (imu, np.append(t[:-1], t[0]), T), "poses: expected rising stamps"),
        (lambda imu, t, T: (imu._replace(omega_body=imu.omega_body * np.nan), t, T), "IMU: .* NaN"),
        (lambda imu, t, T: (imu, t + 100, T), "poses: expected at least 2 finite ones within the readings"),
        (lambda imu, t, T: (imu, t, T * np.nan), "poses: expected at least 2 finite ones"),
    ],
)
def test_unusable_data_are_one_line(still_air, broken, message):
    with pytest.raises(DataError, match=message) as error:
        filter_imu(*broken(*recorded(still_air, 0)), ADIS16448, POSE_NOISE)
    assert "\n" not in str(error.value)


def test_sigmas_must_be_positive(still_air):
    with pytest.raises(ValueError, match="sigmas above 0"):
        filter_imu(*recorded(still_air, 0), ADIS16448, PoseNoise(0.0, 1e-3))
    with pytest.raises(ValueError, match="sigmas above 0"):
        filter_imu(*recorded(still_air, 0), ADIS16448, POSE_NOISE, prior=ekf.Prior(velocity=-1.0))


@pytest.mark.data
@pytest.mark.parametrize(("sequence", "every"), [("euroc_V1_02_medium", 10), ("euroc_V1_01_easy", 1)])
def test_real_readings(data_dir, sequence, every):
    """EuRoC: biases as in the truth file, innovations within their band.

    The truth is itself smoothed from motion capture and this IMU, so its own errors are small and not white;
    white noise of POSE_NOISE is added to make measurements of it, at 20 Hz. In flight the rotors shake the
    sensor: the densities are those that the likelihood of the first half of V1_02 asked for, six and nine
    times the data sheet's.
    """
    log, real = euroc.load_imu(data_dir / sequence), euroc.load_truth(data_dir / sequence)
    noise = log.noise._replace(gyro_density=1.00e-3, accelerometer_density=1.81e-2)
    T = measured(real.T_world_body[::every], np.random.default_rng(0))
    filtered = filter_imu(log.imu, real.t[::every], T, noise, POSE_NOISE)
    mean, band = mean_nis(filtered)
    assert band[0] < mean < band[1]
    half = len(filtered.t) // 2
    covered = filtered.t[half:] < real.t[-1]
    bias = np.stack([np.interp(filtered.t[half:], real.t, column) for column in real.gyro_bias.T], -1)
    assert np.abs(filtered.gyro_bias[half:] - bias)[covered].max() < 0.01
