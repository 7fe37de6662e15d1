"""The filter on readings and poses: closed-form motion with known noise, and the real recordings of EuRoC.

The ground truth files of EuRoC are smoothed fusions of motion capture and this very IMU, not raw
measurements. To act as measurements their poses, thinned to 20 Hz, get white noise of 1 mm and 0.1 degrees
per axis, from a fixed seed. The data sheet knows no vibration of rotors: the densities here are those of the
highest likelihood on the first half of V1_02. Its second half and V1_01 had no part in that.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxpose.datasets.rgbd import euroc
from jaxpose.errors import DataError
from jaxpose.fields.derivatives import motion
from jaxpose.geometry import se3
from jaxpose.imu import ADIS16448, Imu, eskf
from jaxpose.imu.filtering import filter_imu
from jaxpose.imu.simulation import simulate

POSE_NOISE = eskf.PoseNoise(1e-3, float(np.deg2rad(0.1)))
GYRO_BIAS, ACCELEROMETER_BIAS = np.array([-0.03, 0.02, 0.05]), np.array([0.2, -0.1, 0.15])
VIBRATING = ADIS16448._replace(gyro_density=1.00e-3, accelerometer_density=1.81e-2)


def lissajous(t):
    """T_world_body of a body that swings in space and turns about all axes."""
    position = jnp.stack([jnp.sin(1.1 * t), 0.7 * jnp.sin(1.7 * t + 0.5), 0.4 * jnp.sin(2.3 * t)])
    turn = jnp.stack([jnp.sin(1.3 * t), 0.8 * jnp.cos(0.9 * t), 0.7 * jnp.sin(1.9 * t + 1)])
    return se3.make(se3.so3_exp(turn), position)


def measured(poses, seed):
    """Poses with the white noise of `POSE_NOISE`."""
    noise = np.random.default_rng(seed).normal(size=(2, len(poses), 3)) * np.array(POSE_NOISE)[:, None, None]
    poses = np.array(poses)
    poses[:, :3, 3] += noise[0]
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(noise[1]).as_matrix()
    return poses


@pytest.fixture(scope="module")
def ground_truth():
    """Ten seconds at 200 Hz, without noise."""
    with jax.enable_x64(True):
        t = jnp.arange(2000) / 200
        return np.asarray(t), jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda t: motion(lissajous, t)))(t))


@pytest.fixture(scope="module")
def recordings(ground_truth):
    """Per seed: biased noisy readings, pose timestamps (20 Hz, between the readings') and measured poses."""
    with jax.enable_x64(True):
        read = jax.jit(lambda t, key: simulate(lissajous, t, noise=ADIS16448, key=key))
        at = np.arange(199) / 20 + 0.0017
        poses = np.asarray(jax.jit(jax.vmap(lissajous))(jnp.asarray(at)))
        made = []
        for seed in range(5):
            imu = jax.tree.map(np.asarray, read(jnp.asarray(ground_truth[0]), jax.random.key(seed)))
            biased = Imu(imu.t, imu.omega_body + GYRO_BIAS, imu.acceleration_body + ACCELEROMETER_BIAS)
            made.append((biased, at, measured(poses, seed)))
    return made


def band(count):
    """95% of the mean of `count` chi-squares of 6 degrees of freedom."""
    return chi2.ppf([0.025, 0.975], 6 * count) / count


def test_innovations_are_as_large_as_stated(recordings):
    """Of 5 runs one may leave its 95% band (two do in 2% of cases); all together may not."""
    nis = [filter_imu(*run, ADIS16448, POSE_NOISE).nis for run in recordings]
    nis = [values[np.isfinite(values)] for values in nis]
    assert all(len(values) == 198 for values in nis)  # all but the first pose
    low, high = band(198)
    assert sum(low < values.mean() < high for values in nis) >= 4
    low, high = band(5 * 198)
    assert low < np.mean(nis) < high


def test_motion_and_biases_of_a_simulated_body(recordings, ground_truth):
    _, true = ground_truth
    for run in recordings[:3]:
        imu = run[0]
        online = filter_imu(*run, ADIS16448, POSE_NOISE)
        smooth = filter_imu(*run, ADIS16448, POSE_NOISE, smooth=True)
        for found in (online, smooth):
            np.testing.assert_allclose(found.gyro_bias[-1], GYRO_BIAS, atol=2e-3)
            np.testing.assert_allclose(found.accelerometer_bias[-1], ACCELEROMETER_BIAS, atol=0.05)
            sigma = np.sqrt(found.covariance[-1].diagonal()[9:12])
            assert (abs(found.gyro_bias[-1] - GYRO_BIAS) < 4 * sigma).all()
        rms = lambda error: np.sqrt((error[20:-20] ** 2).mean())
        # Readings with the known bias and gravity gone, turned by the true rotation: only noise is left.
        R = true.pose[:, :3, :3]
        force = imu.acceleration_body - ACCELEROMETER_BIAS
        raw = np.einsum("nij,nj->ni", R, force) + np.array([0, 0, -9.80665])
        error = rms(smooth.acceleration_world - true.acceleration_world)
        assert error < 0.8 * rms(raw - true.acceleration_world)
        body = np.einsum("nji,nj->ni", R, true.acceleration_world)
        assert rms(smooth.acceleration_body - body) < 0.8 * rms(
            imu.acceleration_body - ACCELEROMETER_BIAS - body
        )
        assert rms(smooth.omega_body - true.omega_body) < 1.02 * rms(
            imu.omega_body - GYRO_BIAS - true.omega_body
        )
        for name, expected in (("velocity_world", true.velocity_world), ("T_world_body", true.pose)):
            errors = [rms(getattr(found, name) - expected) for found in (smooth, online)]
            assert errors[0] < errors[1]
        assert rms(smooth.T_world_body[:, :3, 3] - true.pose[:, :3, 3]) < 0.5e-3


def test_precisions_agree(recordings):
    single = filter_imu(*recordings[0], ADIS16448, POSE_NOISE, smooth=True)
    with jax.enable_x64(True):
        double = filter_imu(*recordings[0], ADIS16448, POSE_NOISE, smooth=True)
    assert single.T_world_body.dtype == np.float32 and double.T_world_body.dtype == np.float64
    close = lambda name, atol: np.testing.assert_allclose(
        getattr(single, name), getattr(double, name), atol=atol
    )
    close("T_world_body", 1e-4)
    close("velocity_world", 1e-3)
    close("gyro_bias", 1e-4)
    close("nis", 0.05)
    assert single.log_likelihood == pytest.approx(double.log_likelihood, rel=1e-3)


def test_same_length_is_compiled_once(recordings):
    for smooth in (False, True):
        filter_imu(*recordings[0], ADIS16448, POSE_NOISE, smooth=smooth)
    before = eskf.forward._cache_size(), eskf.backward._cache_size()
    other = POSE_NOISE._replace(position=2e-3)
    filter_imu(*recordings[1], ADIS16448._replace(gyro_density=3e-4), other, smooth=True)
    assert (eskf.forward._cache_size(), eskf.backward._cache_size()) == before


def test_poses_that_are_unknown_or_outside(recordings):
    imu, at, poses = recordings[0]
    poses = poses.copy()
    poses[:40], poses[60:80] = np.nan, np.nan
    at = np.append(at[:-1], 30.0)  # as many as in the other tests, so that nothing compiles again
    found = filter_imu(imu, at, poses, ADIS16448, POSE_NOISE)
    assert (found.poses_used, found.poses_skipped) == (138, 61)
    assert np.isnan(found.velocity_world[:400]).all() and np.isfinite(found.velocity_world[400:]).all()
    assert np.isfinite(found.nis).sum() == 137
    np.testing.assert_array_equal(found.t, imu.t)
    np.testing.assert_allclose(found.T_world_body[800, :3, 3], lissajous_at(imu.t[800]), atol=0.01)


def lissajous_at(t):
    return np.asarray(jax.jit(lissajous)(jnp.asarray(t)))[:3, 3]


def changed(imu, row, **values):
    """The readings with one row of some channels replaced."""
    channels = {name: np.array(getattr(imu, name)) for name in Imu._fields}
    for name, value in values.items():
        channels[name][row] = value
    return Imu(**channels)


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda i, t, T: (changed(i, 7, t=0.0), t, T),
            r"IMU: expected rising timestamps, got 0.0 after 0.03 s",
        ),
        (lambda i, t, T: (changed(i, 7, omega_body=np.nan), t, T), "IMU: .* got NaN or infinity in row 7"),
        (
            lambda i, t, T: (changed(i, slice(900, None), t=i.t[900:] + 1), t, T),
            r"IMU: .* at most 0.05 s apart .* got 1 s after 4.495 s",
        ),
        (lambda i, t, T: (Imu(*(x[:1] for x in i)), t, T), "at least 2 finite readings, got 1"),
        (lambda i, t, T: (i, t[::-1], T), "poses: expected rising timestamps"),
        (
            lambda i, t, T: (i, t + 100, T),
            r"at least 2 finite ones within .* \(0.000 to 9.995 s\), got 0 of 199",
        ),
        (lambda i, t, T: (i, t[:0], T[:0]), "got 0 of 0"),
    ],
)
def test_unusable_recordings(recordings, change, message):
    with pytest.raises(DataError, match=message) as error:
        filter_imu(*change(*recordings[0]), ADIS16448, POSE_NOISE)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "noise, pose_noise",
    [
        (ADIS16448._replace(gyro_walk=-1.0), POSE_NOISE),
        (ADIS16448._replace(gyro_walk=float("nan")), POSE_NOISE),
        (ADIS16448, POSE_NOISE._replace(rotation=0.0)),
    ],
)
def test_impossible_noise(recordings, noise, pose_noise):
    with pytest.raises(ValueError, match="expected noise of at least 0 and sigmas above 0"):
        filter_imu(*recordings[0], noise, pose_noise)


def real(folder, every):
    """Readings, noisy poses at 20 Hz and the ground truth; poses end with the readings."""
    imu, true = euroc.load_imu(folder).imu, euroc.load_truth(folder)
    at = true.t[::every][true.t[::every] <= imu.t[-1]]
    return (imu, at, measured(true.T_world_body[::every][: len(at)], seed=0)), true


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("name, every", [("euroc_V1_02_medium", 10), ("euroc_V1_01_easy", 1)])
def test_real_recordings(data_dir, name, every):
    """Consistent innovations over the run, and the bias of ground truth file; see the top of this file."""
    run, true = real(data_dir / name, every)
    found = filter_imu(*run, VIBRATING, POSE_NOISE, smooth=True)
    nis = found.nis[np.isfinite(found.nis)]
    low, high = band(len(nis))
    assert low < nis.mean() < high
    bias = np.stack([np.interp(found.t, true.t, axis) for axis in true.gyro_bias.T], axis=1)
    online = filter_imu(*run, VIBRATING, POSE_NOISE)
    half = slice(len(found.t) // 2, None)
    assert abs(online.gyro_bias - bias)[half].max() < 0.01
    assert abs(online.gyro_bias - bias)[-1].max() < 0.01
    sheet = filter_imu(*run, ADIS16448, POSE_NOISE)
    assert np.nanmean(sheet.nis) > 2 * high  # why the data sheet is not enough
    assert sheet.log_likelihood < online.log_likelihood
