"""Tracking: alignment to an analytic map, the field pinned to poses, predictions from an IMU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.box import UPPER, box_pixels, inside_of_a_box
from scipy.spatial.transform import Rotation

from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.fields import PoseNetConfig, project_onto_poses
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.imu import Imu
from jaxpose.slam import SlamConfig, run
from jaxpose.slam.config import TrackConfig
from jaxpose.slam.tracking.predict import (
    GYRO_BIAS_SIGMA,
    end_velocity,
    no_imu,
    observe_acceleration,
    observe_gyro_bias,
    predict,
    prediction_sigma,
    preintegrate,
)
from jaxpose.slam.tracking.reference_frames import make_field, reference_frame
from jaxpose.slam.tracking.register import best_start, register, starts, surface_residuals

SMALL = PoseNetConfig(layers=3, width=32, activation="softplus")


def one_wall(point):
    """Only the wall ahead."""
    return inside_of_a_box(point)._replace(distance=float(UPPER[2]) - point[2])


def test_alignment_finds_the_camera_in_a_closed_form_room():
    ground_truth = np.asarray(se3.exp(jnp.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1])))
    start = se3.compose(jnp.asarray(ground_truth), se3.exp(jnp.array([0.08, -0.06, 0.05, 0.05, -0.04, 0.06])))
    pixels, config = box_pixels(ground_truth, 300), TrackConfig()
    wide = 0.25 * jnp.eye(6)
    found = jax.jit(lambda T: register(inside_of_a_box, T, T, wide, pixels, config))(start)
    error = se3.log(se3.compose(se3.inverse(found.T_world_cam), jnp.asarray(ground_truth)))
    assert jnp.linalg.norm(error[:3]) < 2e-4 and jnp.linalg.norm(error[3:]) < 2e-4
    assert found.iterations < config.iterations
    # The information is that of a minimum: positive definite.
    assert jnp.linalg.eigvalsh(found.information)[0] > 0


def test_slopes_of_the_residuals_are_those_of_finite_differences():
    """On a map whose distance is not of slope 1, which is set right, and against moved poses."""
    T = se3.exp(jnp.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1]))
    pixels = box_pixels(np.asarray(T), 300)
    twice = lambda point: (near := inside_of_a_box(point))._replace(distance=2 * near.distance)
    with jax.enable_x64(True):
        T, pixels = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (T, pixels))
        T = se3.compose(T, se3.exp(jnp.array([0.02, 0.03, -0.01, 0.01, -0.02, 0.01])))
        at = jax.jit(lambda xi: surface_residuals(twice, se3.compose(T, se3.exp(xi)), pixels, TrackConfig()))
        (found, by), steps = at(jnp.zeros(6)), 1e-6 * jnp.eye(6)
        plain = jax.jit(lambda: surface_residuals(inside_of_a_box, T, pixels, TrackConfig())[0])()
        np.testing.assert_allclose(found.depth, plain.depth, atol=1e-9)
        change = [jax.tree.map(lambda a, b: (a - b) / 2e-6, at(h)[0], at(-h)[0]) for h in steps]
        np.testing.assert_allclose(by.depth, np.stack([c.depth for c in change], -1), rtol=1e-5, atol=1e-4)
        # The spread that colour is counted in is no part of its slope.
        spread = np.median(np.abs(found.colour).mean(-1))
        assert spread == pytest.approx(1, abs=0.02)
        fixed = lambda xi: (
            jax.vmap(twice)(
                se3.apply(se3.compose(T, se3.exp(xi)), pixels.direction_cam * pixels.depth[:, None])
            ).rgb
        )
        expected = fixed(jnp.zeros(6))
        gain = expected.sum(0) / pixels.rgb.sum(0)
        scale = np.median(found.colour / (expected - gain[None] * pixels.rgb))
        slope = scale * np.stack([(fixed(h) - fixed(-h)) / 2e-6 for h in steps], -1)
        np.testing.assert_allclose(by.colour, slope, rtol=1e-5, atol=1e-4)


def test_an_image_that_is_darker_and_bluer_is_aligned_to_the_same_pose():
    ground_truth = np.asarray(se3.exp(jnp.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1])))
    pixels, wide = box_pixels(ground_truth, 300), 0.25 * jnp.eye(6)
    start = se3.compose(jnp.asarray(ground_truth), se3.exp(jnp.array([0.02, -0.01, 0.02, 0.01, -0.01, 0.02])))
    registered = jax.jit(lambda pixels: register(one_wall, start, start, wide, pixels, TrackConfig()))
    bright = registered(pixels)
    dark = registered(pixels._replace(rgb=pixels.rgb * jnp.array([[0.5, 0.6, 0.8]])))
    assert dark.residuals.colour_error < 1.1 * bright.residuals.colour_error + 1e-3
    assert jnp.linalg.norm(se3.log(se3.compose(se3.inverse(bright.T_world_cam), dark.T_world_cam))) < 2e-3


def test_colour_finds_what_a_single_wall_does_not_say():
    ground_truth = np.eye(4)
    start = se3.exp(jnp.array([0.03, -0.02, 0.02, 0.01, 0.0, 0.02]))
    pixels = box_pixels(ground_truth, 300)
    ahead = jnp.abs(pixels.depth - UPPER[2]) < 1e-3
    pixels = jax.tree.map(lambda x: x[ahead], pixels)
    found = {
        weight: register(
            one_wall, start, start, 0.25 * jnp.eye(6), pixels, TrackConfig(colour_weight=weight)
        ).T_world_cam
        for weight in (0.0, 0.1)
    }
    assert jnp.linalg.norm(found[0.0][:2, 3]) > 0.02  # it slides
    assert jnp.linalg.norm(found[0.1][:3, 3]) < 2e-3


def test_a_sharp_prediction_holds_the_pose_against_the_image():
    ground_truth = np.eye(4)
    start = se3.exp(jnp.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
    sharp = 1e-12 * jnp.eye(6)
    registered = jax.jit(
        lambda T: register(inside_of_a_box, T, T, sharp, box_pixels(ground_truth, 300), TrackConfig())
    )
    assert jnp.abs(registered(start).T_world_cam - start).max() < 1e-4


def test_the_best_start_is_the_one_that_explains_the_image():
    ground_truth = np.asarray(se3.exp(jnp.array([0.1, 0.0, 0.1, 0.0, 0.1, 0.0])))
    tries = starts(jnp.asarray(ground_truth), 0.01 * jnp.eye(6))
    assert tries.shape == (13, 4, 4)
    order = jnp.roll(tries, 5, axis=0)
    chosen = best_start(inside_of_a_box, order, box_pixels(ground_truth, 300))
    assert jnp.array_equal(chosen, jnp.asarray(ground_truth))


@pytest.mark.parametrize("name", ["anchored", "default", "world", "intrinsic"])
def test_a_field_is_pinned_to_poses_from_frame_to_frame(name):
    framed = make_field(name, SMALL)
    # Not the anchored motion itself, in which a common factor cancels.
    direct = lambda p, where: lambda t: framed.field.pose(p, where.time(t))
    direct = direct if name == "anchored" else framed.motion
    params = framed.field.init(jax.random.key(0))
    timestamps = jnp.array([0.2, 0.0, -0.2])
    rng = np.random.default_rng(1)
    step = jax.jit(
        lambda params, poses, g: project_onto_poses(
            lambda p: jax.vmap(direct(p, g))(timestamps), params, poses, steps=8
        )
    )
    twist = np.zeros(6)
    for i in range(4):
        twist = 0.8 * twist + 0.02 * rng.normal(size=6)
        poses = se3.exp(jnp.asarray(np.asarray(timestamps)[:, None] / 0.2 * twist, jnp.float32))
        where = reference_frame(
            name,
            since_first_s=1 + 0.2 * i,
            interval_s=0.2,
            duration_s=10.0,
            T_world_ref=np.eye(4),
            T_world_first=np.eye(4),
            generator=rng,
        )
        params = step(params, poses, where)
        found = jax.vmap(framed.motion(params, where))(timestamps)
        assert jnp.abs(found - poses).max() < 1e-3


def constant_readings(omega, force, t=0.5, rate=200):
    timestamps = jnp.arange(0, t + 1e-9, 1 / rate, dtype=jnp.float32)
    n = timestamps.shape[0]
    imu = Imu(
        timestamps,
        jnp.tile(jnp.asarray(omega, jnp.float32), (n, 1)),
        jnp.tile(jnp.asarray(force, jnp.float32), (n, 1)),
    )
    return imu, jnp.ones(n, bool)


def test_prediction_from_inertial_readings_is_the_closed_form_motion():
    # Turning about gravity and pushed along the body's x by 1 m/s^2 from 0.3 m/s.
    rate, push, speed, t = 0.8, 1.0, 0.3, 0.5
    imu, mask = constant_readings([0, 0, rate], [push, 0, 9.80665], t)
    readings = preintegrate(imu, mask, jnp.eye(3), jnp.array([0.0, 0.0, -9.80665]))
    timestamps, poses = predict(t, np.zeros(6), np.array([speed, 0, 0]), readings, rotation=True, speed=True)
    assert timestamps[-1] == pytest.approx(t, abs=1e-6)
    np.testing.assert_allclose(
        poses[-1][:3, :3], Rotation.from_rotvec([0, 0, rate * t]).as_matrix(), atol=1e-5
    )
    # The integral of a vector that turns at a constant rate, twice.
    x = speed * t + push * (1 - np.cos(rate * t)) / rate**2
    y = push * (rate * t - np.sin(rate * t)) / rate**2
    np.testing.assert_allclose(poses[-1][:3, 3], [x, y, 0], atol=1e-4)
    end = end_velocity(t, poses[-1], readings, speed=True)
    world = np.array([speed + push * np.sin(rate * t) / rate, push * (1 - np.cos(rate * t)) / rate, 0])
    np.testing.assert_allclose(poses[-1][:3, :3] @ end, world, atol=2e-3)


def test_prediction_without_readings_is_the_last_motion_again():
    twist = np.array([0.1, 0.2, -0.1, 0.3, 0.0, 0.2])
    timestamps, poses = predict(0.5, twist, np.zeros(3), no_imu(), rotation=True, speed=True)
    np.testing.assert_allclose(
        poses[-1], np.asarray(se3.exp(jnp.asarray(0.5 * twist, jnp.float32))), atol=1e-6
    )
    assert len(timestamps) == len(poses)


def test_a_false_acceleration_is_found_from_the_errors_of_predictions():
    false, offset, t = np.array([0.3, -0.2, 0.0]), np.zeros(3), 0.5
    for _ in range(12):
        offset = observe_acceleration(offset, t, (false - offset) * t**2)
    np.testing.assert_allclose(offset, false, atol=1e-3)
    # Over 30 ms a position error of a millimetre says next to nothing.
    assert np.abs(observe_acceleration(np.zeros(3), 0.033, np.array([1e-3, 0, 0]))).max() < 1e-3


def test_the_bias_of_a_gyroscope_is_found_from_the_errors_of_predictions():
    true, bias, sigma, t = np.array([0.02, -0.05, 0.08]), np.zeros(3), GYRO_BIAS_SIGMA, 0.2
    rng, sigmas = np.random.default_rng(0), []
    for _ in range(50):
        # Predicted with a rate that is too large by what is left of the bias.
        error = Rotation.from_rotvec((bias - true) * t + 0.003 * rng.normal(size=3))
        bias, sigma = observe_gyro_bias(bias, sigma, t, error.as_matrix())
        sigmas.append(sigma)
    assert sigmas[0] < 0.016 and sigmas == sorted(sigmas, reverse=True)
    assert np.abs(bias - true).max() < 3 * sigma < 0.02
    # Over 30 ms a turn off by 0.1 degrees says little once the bias is known.
    late, _ = observe_gyro_bias(bias, 1e-3, 0.033, Rotation.from_rotvec([0.002, 0, 0]).as_matrix())
    assert np.abs(late - bias).max() < 1e-3


def test_a_gyroscope_makes_predictions_sharper():
    motion = np.asarray(se3.exp(jnp.array([0.1, 0.0, 0.0, 0.0, 0.3, 0.0])))
    alone = prediction_sigma(0.5, motion, rotation=False, speed=False)
    gyro = prediction_sigma(0.5, motion, rotation=True, speed=False)
    both = prediction_sigma(0.5, motion, rotation=True, speed=True)
    biased = prediction_sigma(0.5, motion, rotation=True, speed=True, gyro_bias_sigma=0.1)
    assert biased[1] == pytest.approx(both[1] + 0.05)
    assert gyro[1] < alone[1] and gyro[0] == alone[0] and both[0] < gyro[0]


def test_a_recording_that_cannot_be_tracked_is_refused_in_one_line():
    camera = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)
    empty = Frame(np.zeros((30, 40, 3), np.uint8), np.zeros((30, 40), np.float32))
    recording = Recording("made", camera, np.array([0.0, 0.2]), lambda i: empty)
    with pytest.raises(DataError, match="made: expected depth in the first frame"):
        run(recording)
    millimetres = empty._replace(depth=np.full((30, 40), 2350, np.uint16))
    with pytest.raises(DataError, match="made: frame 0: depth: expected metres, .*, got uint16 up to 2350"):
        run(recording._replace(read=lambda i: millimetres))
    with pytest.raises(DataError, match="needs inertial readings"):
        run(recording, SlamConfig(imu="tight"))
    with pytest.raises(DataError, match="at least 2 frames"):
        run(recording._replace(t=np.array([0.0])))
    with pytest.raises(ValueError, match="track.pixels: expected 1 or more"):
        SlamConfig(track=TrackConfig(pixels=0))


def test_the_covariance_of_a_pose_knows_what_goes_together_in_parts_of_an_image():
    """100 images whose depth is off by 7 mm in each pixel, and by none or 5 mm more in each of 16 parts."""
    T = se3.exp(jnp.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1]))
    pixels, wide, draws = box_pixels(np.asarray(T), 2000), 0.25 * jnp.eye(6), 100
    place = np.asarray(pixels.direction_cam[:, :2])
    column, row = np.floor(3.999 * (place - place.min(0)) / np.ptp(place, axis=0)).astype(int).T
    rng = np.random.default_rng(0)
    of_parts, of_pixels = (
        rng.normal(size=(draws, 16))[:, 4 * row + column],
        rng.normal(size=(draws, len(place))),
    )

    @jax.jit
    @jax.vmap
    def registered(depth):
        measured = pixels._replace(depth=depth)
        found = register(inside_of_a_box, T, T, wide, measured, TrackConfig())
        return se3.log(se3.compose(se3.inverse(T), found.T_world_cam)), found.by_parts

    stated = []
    for shared in (0.0, 0.005):
        depth = np.asarray(pixels.depth) + 0.007 * of_pixels + shared * of_parts
        off, covariance = map(np.asarray, registered(jnp.asarray(depth, jnp.float32)))
        P = covariance.mean(axis=0)  # as the end of a run averages those of its frames
        assert 4.5 < np.mean(np.einsum("ni,ij,nj->n", off, np.linalg.inv(P), off)) < 8  # 6 where it is right
        stated.append(np.sqrt(np.diag(P)))
    assert (stated[1] > 3 * stated[0]).all()
