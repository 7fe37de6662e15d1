"""Bad input to public functions of files, datasets, imu, events and evaluation: the argument, expected, got.

Annotations are not checked here (`unchecked`), as they are not where users call the library.
"""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose import datasets, evaluation, events, files, imu
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera

T = np.tile(np.eye(4), (4, 1, 1))
T[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]]
TIMES = np.arange(4.0)
FALLING = np.array([0.0, 2.0, 1.0, 3.0])
NAN = np.array([0.0, np.nan, 2.0, 3.0])
READINGS = imu.Imu(TIMES, np.zeros((4, 3)), np.zeros((4, 3)))
EVENTS = events.Events(TIMES, np.zeros(4, np.uint16), np.zeros(4, np.uint16), np.ones(4, np.int8))
IMAGE = np.zeros((32, 32, 3))
CAMERA = Camera(4.0, 4.0, 1.5, 1.0, 4, 3)
RGB, DEPTH = np.zeros((4, 3, 4, 3), np.uint8), np.ones((4, 3, 4), np.float32)
MM = (1000 * DEPTH).astype(np.uint16)
STILL = lambda t: jnp.eye(4)
J = jnp.zeros((4, 3))
R = jnp.tile(jnp.eye(3)[None], (4, 1, 1))
PHOTOGRAPHS = datasets.Photographs("p", CAMERA, TIMES, RGB, T, 1.0, 2.0, "depth", tuple("abcd"))
RECORDING = datasets.from_arrays(CAMERA, TIMES, RGB, DEPTH)
NOISE, POSE_NOISE = imu.ADIS16448, imu.eskf.PoseNoise(0.01, 0.01)

CALLS = {
    # evaluation
    "ate, (n, 3, 4)": (
        lambda: evaluation.ate(T[:, :3], T[:, :3]),
        r"estimate: expected shape \(4, 4, 4\), got \(4, 3, 4\)",
    ),
    "ate, other count": (
        lambda: evaluation.ate(T, T[:3]),
        r"expected matched poses, got \(4, 4, 4\) and \(3, 4, 4\)",
    ),
    "ate, alignment": (lambda: evaluation.ate(T, T, "se4"), "alignment: expected none, se3, sim3, got 'se4'"),
    "ate, NaN": (
        lambda: evaluation.ate(T * np.nan, T),
        "alignment se3: expected at least 3 pairs of finite poses, got 0",
    ),
    "rpe, along": (
        lambda: evaluation.rpe(T, T, 1.0, along=FALLING),
        "along: expected numbers that never decrease, got 1.0 after 2.0",
    ),
    "rpe, along of NaN": (
        lambda: evaluation.rpe(T, T, 1.0, along=NAN),
        r"along: expected finite numbers, got nan at index \(1\)",
    ),
    "rpe, along of other length": (
        lambda: evaluation.rpe(T, T, 1.0, along=TIMES[:2]),
        r"along: expected shape \(4,\), got \(2,\)",
    ),
    "rpe, delta": (lambda: evaluation.rpe(T, T, 0), "delta of at least 1 frame, got 0"),
    "align": (
        lambda: evaluation.align(evaluation.align_trajectory(T, T, "none"), T[0]),
        r"T_ref_cam: expected shape \(n, 4, 4\)",
    ),
    "umeyama": (
        lambda: evaluation.umeyama(T, T, False),
        r"estimate: expected shape \(n, 3\), got \(4, 4, 4\)",
    ),
    "path_length": (
        lambda: evaluation.path_length(T[:, :3, 3]),
        r"T_world_cam: expected shape \(n, 4, 4\), got \(4, 3\)",
    ),
    "pose_errors": (
        lambda: evaluation.pose_errors(T[:2], T[:2]),
        "expected at least 3 pairs of finite poses, got 2",
    ),
    "psnr, shape": (
        lambda: evaluation.psnr(IMAGE, IMAGE[:8]),
        r"image: expected shape \(8, 32, 3\), got \(32, 32, 3\)",
    ),
    "psnr, peak": (
        lambda: evaluation.psnr(IMAGE, IMAGE, peak=0.0),
        "peak: expected a positive number, got 0.0",
    ),
    "ssim": (
        lambda: evaluation.ssim(IMAGE, IMAGE[:8]),
        r"reference: expected shape \(32, 32, 3\), got \(8, 32, 3\)",
    ),
    "lpips": (
        lambda: evaluation.lpips(IMAGE[..., 0], IMAGE),
        r"image: expected shape \(h, w, 3\), got \(32, 32\)",
    ),
    # files
    "write_tum, shape": (
        lambda: files.write_tum("f", files.Trajectory(TIMES[:2], T)),
        r"T: expected shape \(2, 4, 4\), got \(4, 4, 4\)",
    ),
    "write_tum, falling": (
        lambda: files.write_tum("f", files.Trajectory(FALLING, T)),
        "t: expected increasing times, got 1.0 after 2.0",
    ),
    "write_tum, NaN": (
        lambda: files.write_tum("f", files.Trajectory(NAN, T)),
        "t: expected finite numbers, got nan",
    ),
    "write_euroc": (
        lambda: files.write_euroc("f", files.Trajectory(FALLING, T)),
        "t: expected increasing times",
    ),
    "write_kitti": (
        lambda: files.write_kitti("f", T[:, :3]),
        r"T_world_cam: expected shape \(4, 4, 4\), got \(4, 3, 4\)",
    ),
    "write_kitti, NaN": (lambda: files.write_kitti("f", T * np.nan), "f: expected finite poses, got NaN"),
    "read_kitti": (
        lambda: files.read_kitti("f", rate_hz=0.0),
        "rate_hz: expected a positive number, got 0.0",
    ),
    "associate": (
        lambda: files.associate(TIMES, FALLING),
        "t_b: expected increasing times, got 1.0 after 2.0 s",
    ),
    "associate, apart": (
        lambda: files.associate(TIMES, TIMES + 100),
        "expected timestamps within 0.01 s, got 0.000 to 3.000 s and",
    ),
    "write_ply, points": (
        lambda: files.write_ply("f", T, RGB[0, 0]),
        r"points: expected shape \(n, 3\), got \(4, 4, 4\)",
    ),
    "write_ply, rgb": (
        lambda: files.write_ply("f", T[:, :3, 3], T[:, :3, 3]),
        "rgb: expected uint8, got float64",
    ),
    "write_ply, faces": (
        lambda: files.write_ply("f", T[:, :3, 3], RGB[0, 0], np.array([[0, 1, 4]])),
        "faces: expected rows of 4 points, got 0 to 4",
    ),
    "write_colmap": (
        lambda: files.write_colmap("f", CAMERA, ["a"], T),
        r"T_world_cam: expected shape \(1, 4, 4\), got \(4, 4, 4\)",
    ),
    # datasets
    "from_arrays, times": (
        lambda: datasets.from_arrays(CAMERA, FALLING, RGB, DEPTH),
        "t: expected increasing times, got 1.0 after 2.0 s",
    ),
    "from_arrays, NaN": (
        lambda: datasets.from_arrays(CAMERA, NAN, RGB, DEPTH),
        "t: expected finite numbers, got nan",
    ),
    "from_arrays, mm": (
        lambda: datasets.from_arrays(CAMERA, TIMES, RGB, MM),
        "depth: expected metres, floating point, got uint16 up to 1000",
    ),
    "from_arrays, size": (
        lambda: datasets.from_arrays(CAMERA, TIMES, RGB[:, :2], DEPTH),
        r"rgb: expected shape \(4, 3, 4, 3\), got \(4, 2, 4, 3\)",
    ),
    "select": (
        lambda: datasets.select(RECORDING, np.array([0, 4])),
        "indices: expected whole numbers from 0 to 3, got 0 to 4",
    ),
    "select, mask": (
        lambda: datasets.select(RECORDING, TIMES > 1),
        "indices: expected whole numbers from 0 to 3, got bool",
    ),
    "take": (
        lambda: datasets.take(PHOTOGRAPHS, np.array([[0]])),
        r"indices: expected shape \(m,\), got \(1, 1\)",
    ),
    "thin": (lambda: datasets.thin(RECORDING, -1.0), "rate_hz: expected a positive number, got -1.0"),
    "every": (lambda: datasets.every(PHOTOGRAPHS, 0), "expected a step of at least 1, got 0"),
    "load_recording": (
        lambda: datasets.load_recording("nowhere"),
        "nowhere: expected a .*, got nothing",
    ),
    "load_events": (
        lambda: datasets.load_events("nowhere"),
        "nowhere: expected a recording of events, .*, got nothing",
    ),
    # imu
    "integrate_gyro": (
        lambda: imu.integrate_gyro(jnp.eye(3), jnp.arange(3.0), J),
        r"omega_body: expected shape \(3, 3\), got \(4, 3\)",
    ),
    "integrate_gyro, mask": (
        lambda: imu.integrate_gyro(jnp.eye(3), jnp.arange(4.0), J, jnp.ones(2, bool)),
        r"mask: expected shape \(4,\), got \(2,\)",
    ),
    "remove_gravity": (
        lambda: imu.remove_gravity(READINGS, R, jnp.zeros(2)),
        r"gravity_world: expected shape \(3,\), got \(2,\)",
    ),
    "gyro_loose_residual": (
        lambda: imu.gyro_loose_residual(STILL, jnp.arange(3.0), R),
        r"R_ref_body: expected shape \(3, 3, 3\), got \(4, 3, 3\)",
    ),
    "gyro_tight_residual": (
        lambda: imu.gyro_tight_residual(STILL, jnp.arange(3.0), J),
        r"omega_body: expected shape \(3, 3\), got \(4, 3\)",
    ),
    "accelerometer_residual": (
        lambda: imu.accelerometer_residual(STILL, jnp.arange(4.0), J[:, :2], R),
        r"acceleration_body: expected shape \(4, 3\), got \(4, 2\)",
    ),
    "imu_residuals": (
        lambda: imu.imu_residuals(STILL, jnp.arange(4.0), J[:3], J, R),
        r"omega_body: expected shape \(4, 3\), got \(3, 3\)",
    ),
    "residual_sigmas": (lambda: imu.residual_sigmas(NOISE, 0.0, 1.0), "expected rate_hz above 0 .*, got 0.0"),
    "windows, falling": (
        lambda: imu.windows(READINGS._replace(t=FALLING), TIMES),
        "imu.t: expected increasing times, got 1.0 after 2.0",
    ),
    "windows, shape": (
        lambda: imu.windows(READINGS._replace(omega_body=np.zeros((4, 2))), TIMES),
        r"imu.omega_body: expected shape \(4, 3\), got \(4, 2\)",
    ),
    "windows, one frame": (
        lambda: imu.windows(READINGS, TIMES[:1]),
        "expected at least 2 readings and 2 frames, got 4 and 1",
    ),
    "windows, apart": (
        lambda: imu.windows(READINGS, TIMES + 100),
        "expected readings between 100.000 and 103.000 s",
    ),
    "filter_imu, NaN": (
        lambda: imu.filter_imu(
            READINGS._replace(omega_body=np.full((4, 3), np.nan)), TIMES, T, NOISE, POSE_NOISE
        ),
        "IMU: expected at least 2 finite readings, got NaN or infinity in row 0",
    ),
    "filter_imu, falling": (
        lambda: imu.filter_imu(READINGS, FALLING, T, NOISE, POSE_NOISE),
        "poses: expected rising timestamps, got 1.0 after 2.0",
    ),
    "filter_imu, poses": (
        lambda: imu.filter_imu(READINGS, TIMES, T[:2], NOISE, POSE_NOISE),
        r"T_world_body: expected shape \(4, 4, 4\), got \(2, 4, 4\)",
    ),
    "filter_imu, sigma": (
        lambda: imu.filter_imu(READINGS, TIMES, T, NOISE, imu.eskf.PoseNoise(0.0, 1.0)),
        "sigmas above 0, got .*position=0.0",
    ),
    "simulate, key": (
        lambda: imu.simulate(STILL, jnp.arange(3.0), noise=NOISE),
        "expected a key and at least 2 readings",
    ),
    "simulate, shape": (
        lambda: imu.simulate(STILL, jnp.zeros((3, 1))),
        r"times: expected shape \(n,\), got \(3, 1\)",
    ),
    "simulate_from_poses": (
        lambda: imu.simulate_from_poses(FALLING, T, 10.0),
        "expected rising times, got 1.0 after 2.0",
    ),
    "simulate_from_poses, rate": (
        lambda: imu.simulate_from_poses(TIMES, T, 0.0),
        "rate_hz: expected a positive number, got 0.0",
    ),
    "simulate_from_poses, name": (
        lambda: imu.simulate_from_poses(TIMES, T, 10.0, rotation="nlerp"),
        "rotation: expected slerp or spline, got 'nlerp'",
    ),
    # events
    "index_by_pixel": (
        lambda: events.index_by_pixel(EVENTS._replace(x=np.full(4, 9, np.uint16)), 1, 4),
        "expected pixels of 4x1, got column 9, row 0",
    ),
    "index_by_pixel, type": (
        lambda: events.index_by_pixel(EVENTS._replace(polarity=np.ones(4)), 1, 4),
        "events.polarity: expected whole numbers, got float64",
    ),
    "index_by_pixel, falling": (
        lambda: events.index_by_pixel(EVENTS._replace(t=FALLING), 1, 4),
        "events.t: expected times that never decrease, got 1.0 after 2.0 s",
    ),
    "index_by_pixel, length": (
        lambda: events.index_by_pixel(EVENTS._replace(y=EVENTS.y[:2]), 1, 4),
        r"events.y: expected shape \(4,\), got \(2,\)",
    ),
    "simulate events, none": (
        lambda: events.simulate([], 0.1),
        "simulate: expected at least 1 image, got none",
    ),
    "simulate events, size": (
        lambda: events.simulate([(0.0, IMAGE[..., 0]), (1.0, IMAGE[:8, :, 0])], 0.1),
        r"expected images of shape \(32, 32\), got \(8, 32\) at 1 s",
    ),
    "simulate events, times": (
        lambda: events.simulate([(1.0, IMAGE[..., 0]), (0.0, IMAGE[..., 0])], 0.1),
        "expected timestamps that increase, got 0 s after 1 s",
    ),
    "simulate events, threshold": (lambda: events.simulate([], -1.0), "expected threshold > 0 .* got -1.0"),
    "mosaic_mask": (lambda: events.mosaic_mask("bggr", 2, 2), "mosaic: expected mono or rggb, got 'bggr'"),
    "find_displacement": (
        lambda: events.find_displacement(CAMERA, EVENTS),
        "expected at least 100 events, got 4",
    ),
}


@pytest.mark.parametrize(("call", "message"), CALLS.values(), ids=CALLS.keys())
def test_bad_input_is_named(unchecked, tmp_path, monkeypatch, call, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, DataError), match=message) as error:
        call()
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())  # nothing is written
