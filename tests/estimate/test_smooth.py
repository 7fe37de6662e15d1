"""Trajectories, sensors and covariances found from simulated poses and readings, against the simulation."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers import hand_held
from scipy.stats import chi2

import jaxpose
from jaxpose.errors import DataError
from jaxpose.estimate import smooth
from jaxpose.estimate.smoothing import compile_ahead
from jaxpose.geometry import rigid

DURATION_S, POSE_HZ = 12.0, 3.0
MOUNTING = rigid.exp(np.array([0.06, -0.03, 0.02, 0.10, -0.05, 0.08]))
SIGMAS = np.array([0.01] * 3 + [0.005] * 3)
GYRO_BIAS, ACCELEROMETER_BIAS = np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.1, -0.08])
OFFSET_S, SCALE = 0.03, 2.5
WORLD = rigid.exp(np.array([0.0, 0.0, 0.0, 0.5, -0.3, 0.9]))  # the poses' own, which is not upright
EVERYTHING = ("biases", "gravity", "offset", "extrinsics", "scale")


def trial(seed):
    """Poses in a tilted world, in a unit of 2.5 m and on another clock, readings, and the true poses."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, DURATION_S, 1 / POSE_HZ)
    truth, noisy = hand_held.cameras(t, rng, MOUNTING, SIGMAS[:3], SIGMAS[3:])
    imu = hand_held.readings(DURATION_S, 200.0, rng, GYRO_BIAS, ACCELEROMETER_BIAS)
    noisy = WORLD @ noisy
    noisy[:, :3, 3] /= SCALE
    return t - OFFSET_S, noisy, imu, WORLD @ truth


def found_in(seed):
    t, noisy, imu, _ = trial(seed)
    sigmas = SIGMAS / np.repeat([SCALE, 1.0], 3)
    return smooth(t, noisy, sigmas, imu, estimate=EVERYTHING, noise=hand_held.SHEET)


def errors(found, seed):
    """At all times, as multiples of one sigma, squared: of the pose, of a move of one second, of sensors."""
    t = np.arange(0.2, DURATION_S - 1.5, 0.37)
    true = WORLD @ hand_held.body(np.concatenate([t, t + 1]))[0] @ MOUNTING
    T = found.pose(np.concatenate([t, t + 1]) - OFFSET_S)
    away = rigid.log(rigid.inverse(T) @ true)
    P = found.covariance(np.concatenate([t, t + 1]) - OFFSET_S)
    n = len(t)
    moved, truly = (rigid.inverse(x[:n]) @ x[n:] for x in (T, true))
    away_1s = rigid.log(rigid.inverse(moved) @ truly)
    P_1s = found.relative_covariance(t - OFFSET_S, t + 1 - OFFSET_S)
    square = lambda x, P: np.einsum("ni,ni->n", x, np.linalg.solve(P, x[..., None])[..., 0])
    s = found.sensors
    mounting = rigid.log(rigid.inverse(s.T_body_cam) @ MOUNTING)
    sensors = np.concatenate([
        [(s.offset_s - OFFSET_S) / s.offset_sigma_s, np.log(s.scale / SCALE) / s.scale_sigma],
        mounting / s.T_body_cam_sigma,
        ((s.gyro_bias - GYRO_BIAS) / s.gyro_bias_sigma)[10],
        ((s.accelerometer_bias - ACCELEROMETER_BIAS) / s.accelerometer_bias_sigma)[10],
    ])  # fmt: skip
    return away, square(away, P), square(away_1s, P_1s), sensors**2


@pytest.fixture(scope="module")
def found():
    return found_in(0)


def test_the_trajectory_is_found_at_all_times(found):
    """Poses are 1.7 cm and 0.5 degrees off; between and at them the estimate is not."""
    away, _, _, _ = errors(found, 0)
    distance, angle = np.linalg.norm(away[:, :3], axis=1), np.linalg.norm(away[:, 3:], axis=1)
    assert np.sqrt(np.mean(distance**2)) < 0.010
    assert np.degrees(np.sqrt(np.mean(angle**2))) < 0.15


def test_what_is_compiled_ahead_is_not_compiled_again(compiled):
    """In another thread, by times and readings alone, for some poses less too; not where it was stopped."""
    t, noisy, imu, _ = trial(0)
    kept = np.delete(np.arange(len(t) - 4), [5, 6])  # within a time that no other test has
    heavy = {"linearise", "_moved", "spread", "camera_rows", "_joint"}
    compile_ahead(t[:-4], imu, EVERYTHING, lambda: True)
    assert not compiled() & heavy
    with ThreadPoolExecutor(1) as other:
        other.submit(compile_ahead, t[:-4], imu, EVERYTHING).result()
    assert compiled() >= heavy
    found = smooth(t[kept], noisy[kept], SIGMAS, imu, estimate=EVERYTHING, noise=hand_held.SHEET)
    found.covariances()
    assert not compiled() & heavy


def test_times_are_asked_together_or_one_by_one(found):
    """More than one call of the compiled function takes, fewer, and none."""
    t = np.linspace(*found.span, 300)
    T, P = found.pose(t), found.covariance(t)
    for k in (0, 255, 256, 299):
        np.testing.assert_allclose(found.pose(t[k]), T[k : k + 1], atol=1e-12)
        np.testing.assert_allclose(found.covariance(t[k]), P[k : k + 1], rtol=1e-9)
    assert found.pose(t[:0]).shape == (0, 4, 4) and found.covariance(t[:0]).shape == (0, 6, 6)


def test_the_sensors_are_found(found):
    s = found.sensors
    assert abs(s.offset_s - OFFSET_S) < 1e-3
    assert abs(s.scale / SCALE - 1) < 0.01
    assert np.degrees(rigid.rotation_angle(s.T_body_cam[:3, :3], MOUNTING[:3, :3])) < 0.2
    assert np.abs(s.T_body_cam[:3, 3] - MOUNTING[:3, 3]).max() < 0.02
    assert np.degrees(rigid.vector_angle(s.gravity_world, WORLD[:3, :3] @ hand_held.GRAVITY)) < 0.3
    assert np.abs(s.gyro_bias - GYRO_BIAS).max() < 2e-3
    assert np.abs(s.accelerometer_bias - ACCELEROMETER_BIAS).max() < 0.03


def test_the_readings_noise_is_found(found):
    sheet = np.sqrt(200) * np.array(hand_held.SHEET[:2])
    np.testing.assert_allclose([found.noise.gyro, found.noise.accelerometer], sheet, rtol=0.1)
    assert 0.7 < found.noise.position < 1.4 and 0.7 < found.noise.rotation < 1.4


def test_the_field_is_the_estimate(found):
    field, params = found.field()
    for t in (0.5, 3.21, 9.99):
        np.testing.assert_allclose(field.pose(params, t), found.pose(t)[0], atol=1e-5)


def test_poses_alone_are_smoothed():
    """Without an IMU the motion is as restless as the poses say, and knows less between them."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 4.0, 0.02)
    truth, noisy = hand_held.cameras(t, rng, np.eye(4), SIGMAS[:3], SIGMAS[3:])
    found = smooth(t, noisy, SIGMAS)
    off = lambda T: np.sqrt(np.mean(np.sum((T[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1)))
    assert off(found.pose(t)) < 0.8 * off(noisy)
    away = rigid.log(rigid.inverse(found.pose(t)) @ truth)
    square = np.einsum("ni,ni->n", away, np.linalg.solve(found.covariance(t), away[..., None])[..., 0])
    assert 3.5 < np.mean(square) < 9.0


def test_covariances_of_a_linear_problem_are_those_of_dense_algebra():
    """Positions alone, nothing turned: the spline is linear, and scipy's basis gives its normal equations."""
    from scipy.interpolate import BSpline

    t = np.linspace(0.0, 3.0, 40)
    T = np.tile(np.eye(4), (40, 1, 1))
    found = smooth(t, T, [0.01] * 3 + [0.02] * 3, fit_noise=False, knots_hz=4.0)
    intervals = len(found.state.control) - 3
    step = float(found.problem.interval_s)
    knots = found.clock_s + step * (np.arange(intervals + 7) - 3)
    values = BSpline.design_matrix(t, knots, 3).toarray()
    at = found.clock_s + step * (np.arange(intervals) + 0.5)
    bend = np.stack([BSpline(knots, row, 3).derivative(2)(at) for row in np.eye(intervals + 3)], axis=1)
    prior = bend.T @ bend * step
    for sigma, rest, axis in ((0.01, 1e-3, 0), (0.02, 1e-3, 3)):
        P = np.linalg.inv(values.T @ values / sigma**2 + prior / rest**2)
        expected = np.einsum("ni,ij,nj->n", values, P, values)
        np.testing.assert_allclose(found.covariance(t)[:, axis, axis], expected, rtol=1e-9)
        between = values[20] - values[5]
        relative = found.relative_covariance(t[5], t[20])[0, axis, axis]
        np.testing.assert_allclose(relative, between @ P @ between, rtol=1e-9)


@pytest.mark.slow
def test_errors_are_as_large_as_stated():
    """Over 40 runs the squares are in the 95% band of what chi-square says, and sensors in 3 sigma in 95%."""
    runs = 40
    square, moved, sensors = zip(*(errors(found_in(seed), seed)[1:] for seed in range(runs)), strict=True)
    for name, x in (("pose", np.array(square)), ("one second", np.array(moved))):
        low, high = chi2.ppf([0.025, 0.975], 6 * runs) / runs
        print(name, np.mean(x), low, high)
        assert low < np.mean(x) < high, (name, np.mean(x), low, high)
    inside = np.mean(np.array(sensors) < 9, axis=0)
    print(inside, np.mean(sensors, axis=0))
    assert (inside >= 0.95).all(), inside


BAD = {
    "sigmas: expected numbers above 0, got -1": {"sigmas": [-1.0] * 6},
    "sigmas: expected shape": {"sigmas": [1.0] * 5},
    "estimate: expected any of biases, gravity, offset, extrinsics, scale, got wind": {"estimate": ("wind",)},
    "times: expected increasing": {"times": np.zeros(36)},
    "offset_s: expected a number of seconds, got nan": {"offset_s": np.nan},
    "drift_s: expected seconds above 0, got 0": {"drift_s": 0.0},
    "drift: expected shape (36, 6, 6), got (6, 6)": {"drift": np.eye(6)},
}


@pytest.mark.parametrize("complaint", BAD)
def test_wrong_arguments_are_named(complaint):
    t, noisy, imu, _ = trial(0)
    given = {"times": t, "T_world_cam": noisy, "sigmas": SIGMAS, "imu": imu} | BAD[complaint]
    with pytest.raises(ValueError, match=complaint.split("expected")[0]) as error:
        smooth(**given)
    assert complaint in str(error.value)


def test_readings_that_cannot_be_used_are_refused():
    t, noisy, imu, _ = trial(0)
    far = imu._replace(t=imu.t + 100)
    with pytest.raises(
        DataError, match=r"IMU: expected readings between .* \(the poses\), got them between 99"
    ):
        smooth(t, noisy, SIGMAS, far)
    broken = imu._replace(omega_body=np.where(np.arange(len(imu.t))[:, None] == 7, np.nan, imu.omega_body))
    with pytest.raises(DataError, match=r"IMU: expected finite numbers, got omega_body\[7\]"):
        smooth(t, noisy, SIGMAS, broken)


def test_what_the_motion_does_not_show_is_not_invented():
    """A camera at rest: neither scale, nor offset, nor the lever are known, and their sigmas say so."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 6.0, 1 / 3)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, 3] += 0.01 * rng.normal(size=(len(t), 3))
    n = 1400
    imu = jaxpose.Imu(
        np.arange(n) * 0.005 - 0.5,
        0.007 * rng.normal(size=(n, 3)),
        -hand_held.GRAVITY + 0.07 * rng.normal(size=(n, 3)),
    )
    found = smooth(
        t, T, SIGMAS, imu, estimate=("biases", "gravity", "offset", "extrinsics"), T_body_cam=np.eye(4)
    )
    s = found.sensors
    assert s.offset_sigma_s > 0.1 and s.T_body_cam_sigma[:3].min() > 0.1
    assert set(found.unobserved) >= {"offset", "extrinsics"}


def drifting(seed):
    """Poses at 5 Hz whose error is 5 mm and 0.1 degrees of their own, and a walk of the same steps."""
    rng = np.random.default_rng([seed, 5])
    t = np.arange(0.0, DURATION_S, 0.2)
    truth, noisy = hand_held.cameras(t, rng, MOUNTING, OWN[:3], OWN[3:])
    steps = rng.normal(size=(len(t), 6)) * OWN
    shared = np.eye(4)
    for i in range(1, len(t)):
        shared = shared @ truth[i] @ rigid.exp(steps[i]) @ rigid.inverse(truth[i])  # beside the camera then
        noisy[i] = shared @ noisy[i]
    return t, truth, noisy, hand_held.readings(DURATION_S, 200.0, rng, GYRO_BIAS, ACCELEROMETER_BIAS)


OWN = np.repeat([0.005, np.radians(0.1)], 3)


@pytest.mark.slow
def test_an_error_that_poses_share_is_stated():
    """Squared errors of moves of 10 s are in the 95% band of 20 runs; as independent they are far off."""
    own, squares = np.diag(OWN**2), []
    for seed in range(20):
        t, truth, noisy, imu = drifting(seed)
        covariances = np.tile(own, (len(t), 1, 1))
        for drift in (covariances, None):
            found = smooth(
                t, noisy, covariances, imu, drift=drift, noise=hand_held.SHEET, T_body_cam=MOUNTING
            )
            moved = lambda T: rigid.inverse(T[5]) @ T[55]
            error = rigid.log(rigid.inverse(moved(found.pose(t))) @ moved(truth))
            squares.append(error @ np.linalg.solve(found.relative_covariance(t[5], t[55])[0], error))
            if drift is not None:
                assert 0.7 < found.noise.position < 1.4 and 0.7 < found.noise.rotation < 1.4
    low, high = chi2.ppf([0.025, 0.975], 6 * 20) / 20
    assert low < np.mean(squares[::2]) < high, (low, np.mean(squares[::2]), high)
    assert np.mean(squares[1::2]) > 10 * high
