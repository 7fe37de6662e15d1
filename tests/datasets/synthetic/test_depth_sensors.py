"""Depth cameras against the closed forms of their laws, on planes, steps and corners."""

import numpy as np
import pytest

from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.synthetic.depth_sensors import RANGES, Sensor, corner_bias, measured_depth
from jaxpose.geometry.camera import Camera

CAMERA = Camera(585.0, 585.0, 319.5, 239.5, 640, 480)
MILLIMETRE = 0.001
SENSORS = tuple(RANGES)
X = np.broadcast_to((np.arange(640) - 319.5) / 585, (480, 640))  # of the rays, per metre of depth
# grey that changes by 8 from pixel to pixel, so that everything is textured and reflects alike
CHECKERED = np.repeat((124 + 8 * (np.indices((480, 640)).sum(0) // 2 % 2))[..., None], 3, 2).astype(np.uint8)


def plane(depth: float) -> np.ndarray:
    return np.full((480, 640), depth, np.float32)


def step(near: float = 1.0, far: float = 2.0) -> np.ndarray:
    """A near upright strip before a far wall: columns 200 to 399."""
    depth = plane(far)
    depth[:, 200:400] = near
    return depth


def upright(slope: float, at: float = 2.0) -> np.ndarray:
    """Depth of the walls z = at - slope |x|: a concave corner ahead where `slope` is positive."""
    return (at / (1 + slope * np.abs(X))).astype(np.float32)


def measure(sensor: Sensor, depth: np.ndarray, rgb=CHECKERED, cosine=1.0, seed=0, **settings) -> np.ndarray:
    cosine = np.full(depth.shape, cosine, np.float32)
    return measured_depth(sensor, depth, rgb, cosine, CAMERA, np.random.default_rng(seed), **settings)


def correlation(error: np.ndarray, columns: int) -> float:
    """Of errors that many columns apart."""
    return np.corrcoef(error[:, columns:].ravel(), error[:, : error.shape[1] - columns].ravel())[0, 1]


@pytest.mark.parametrize("sensor", SENSORS)
def test_depth_has_its_form_and_follows_from_the_generator(sensor):
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)  # black pixels too
    depth = np.where(step(0.4, 7.0) > 1, 7.0 * rng.uniform(0.01, 1, (480, 640)), 0.4).astype(np.float32)
    found, again, other = (measure(sensor, depth, rgb, 0.3, seed) for seed in (0, 0, 1))
    assert found.dtype == np.float32 and found.shape == (480, 640) and np.isfinite(found).all()
    np.testing.assert_array_equal(found, again)
    assert np.mean(found != other) > 0.01
    near, far = RANGES[sensor]
    assert (found[found > 0] >= near).all() and found.max() <= far
    np.testing.assert_allclose(found / MILLIMETRE, np.round(found / MILLIMETRE), atol=2e-3)


@pytest.mark.parametrize("sensor", SENSORS[1:])
def test_beyond_the_range_there_is_nothing(sensor):
    near, far = RANGES[sensor]
    for depth in (0.6 * near, 1.4 * far):
        assert not measure(sensor, plane(depth)).any()
    assert np.mean(measure(sensor, plane(0.8 * far)) > 0) > 0.3


def test_axial_noise_is_what_the_tracker_assumes_and_may_be_none():
    for depth in (1.0, 3.0):
        sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
        error = measure("axial", plane(depth)) - depth
        assert error.std() == pytest.approx(np.hypot(sigma, MILLIMETRE / 12**0.5), rel=0.02)
        assert abs(correlation(error, 1)) < 0.01
    depth = step(1.23456, 2.34567)
    np.testing.assert_array_equal(measure("axial", depth, noise=0.0, holes=False), depth)


@pytest.mark.parametrize("depth", [1.0, 2.0, 4.0])
def test_structured_light_steps_by_an_eighth_of_a_pixel(depth):
    found = measure("structured_light", plane(depth))
    reach = 585 * 0.075
    steps = 8 * reach / found
    rounding = 8 * reach / depth**2 * MILLIMETRE / 2  # depth is stored in millimetres
    assert np.abs(steps - np.round(steps)).max() < 1.1 * rounding
    levels = np.unique(np.round(steps))
    assert (np.diff(levels) == 1).all()
    spacing = np.diff(np.sort(reach / (levels / 8)))
    assert spacing.mean() == pytest.approx(depth**2 / reach / 8, rel=0.05)
    # half a step in all (Khoshelham and Oude Elberink 2012): averaged over where a plane lies between steps
    planes = np.linspace(0.97 * depth, 1.03 * depth, 20)
    squares = [np.mean(((measure("structured_light", plane(z)) - z) / z**2) ** 2) for z in planes]
    assert np.sqrt(np.mean(squares)) == pytest.approx(1 / reach / 16, rel=0.1)


def test_noise_of_windows_goes_together_as_far_as_they_overlap():
    for sensor, window in (("structured_light", 9), ("stereo", 7)):
        error = measure(sensor, plane(2.5), noise=3.0) - 2.5  # so much that steps hardly matter
        for columns in (1, 3, 5):
            assert correlation(error, columns) == pytest.approx(1 - columns / window, abs=0.06)
        assert abs(correlation(error, window + 1)) < 0.06


def test_the_projector_casts_shadows_to_the_right():
    found = measure("structured_light", step(1.0, 3.0), noise=0.0)
    width = 585 * 0.075 * (1 / 1.0 - 1 / 3.0)  # how far the surfaces part, seen from the projector
    assert (found[:, :400] > 0).all() and not found[:, 400 : 400 + int(width) - 2].any()
    assert (found[:, 400 + int(width) + 1 :] > 0).all()
    assert (measure("structured_light", step(1.0, 3.0), holes=False) > 0).all()


def test_edges_of_structured_light_are_ragged():
    found = measure("structured_light", step(1.0, 3.0), holes=False)
    moved = (found < 2) != (step(1.0, 3.0) < 2)
    assert 0.1 < moved[:, [199, 200, 399, 400]].mean() < 0.5
    assert not moved[:, 210:390].any() and not moved[:, :190].any()
    assert not np.any((found > 1.1) & (found < 2.8)), "no depth between the two"


@pytest.mark.parametrize("sensor", ["axial", "structured_light", "stipple"])
def test_grazing_surfaces_have_no_depth(sensor):
    whole = np.mean(measure(sensor, plane(2.0)) > 0)
    share = lambda cosine: np.mean(measure(sensor, plane(2.0), cosine=cosine) > 0) / whole
    assert share(0.05) == 0 and share(0.15) == pytest.approx(0.5, abs=0.05) and share(0.25) == 1


def grating(contrast: float) -> np.ndarray:
    """Grey that rises and falls by `contrast` a pixel along the rows."""
    grey = 100 + np.rint(contrast * np.abs(np.arange(640) % 16 - 8))
    return np.repeat(np.broadcast_to(grey, (480, 640))[..., None], 3, 2).astype(np.uint8)


@pytest.mark.parametrize(("contrast", "sigma"), [(10, 0.08), (2, 0.15)])
@pytest.mark.parametrize("depth", [1.0, 2.0, 4.0])
def test_noise_of_stereo_follows_disparity_and_texture(contrast, sigma, depth):
    error = measure("stereo", plane(depth), grating(contrast)) - depth
    assert error.std() == pytest.approx(depth**2 / (585 * 0.05) * sigma, rel=0.1)


def test_stereo_finds_nothing_without_texture_along_the_rows():
    rgb = grating(8)
    rgb[:, 300:400] = 90
    found = measure("stereo", plane(2.0), rgb)
    assert not found[:, 305:395].any() and (found[:, :290] > 0).all() and (found[:, 410:] > 0).all()
    assert not measure("stereo", plane(2.0), np.ascontiguousarray(grating(8)[:, :1].repeat(640, 1))).any()
    assert (measure("stereo", plane(2.0), rgb, holes=False) > 0).all()


def test_stereo_fattens_what_is_near_and_loses_what_one_camera_sees():
    found = measure("stereo", step(1.0, 2.0), noise=0.0)
    near = (found > 0.9) & (found < 1.1)
    grown = near[:, 400:].sum(1), near[:, :200].sum(1)
    assert near[:, 200:400].all()
    for pixels in grown:
        assert set(pixels) <= {1, 2, 3} and 1.2 < pixels.mean() < 2.8  # at most half a window of 7
    hidden = int(585 * 0.05 * (1 / 1.0 - 1 / 2.0))  # to the left: the second camera is on the right
    assert not found[:, 200 - hidden + 1 : 197].any()
    assert (found[:, : 200 - hidden - 1] > 1.9).all() and (found[:, 403:] > 1.9).all()


@pytest.mark.parametrize("depth", [1.0, 2.0, 4.0])
def test_noise_of_light_falls_with_its_amplitude(depth):
    for grey, cosine in ((128, 1.0), (230, 0.5)):
        rgb = np.full((480, 640, 3), grey, np.uint8)
        electrons = 2e5 * (grey / 255) ** 2.2 * cosine / depth**2
        error = measure("time_of_flight", plane(depth), rgb, cosine) - depth
        sigma = 1.5 / 8**0.5 * np.sqrt(electrons + 1e4) / (2 * electrons)
        assert error.std() == pytest.approx(np.hypot(sigma, MILLIMETRE / 12**0.5), rel=0.03)
        assert abs(correlation(error, 1)) < 0.01 and abs(error.mean()) < 0.02 * sigma + 1e-5


def test_dark_surfaces_send_no_light_back():
    rgb = CHECKERED.copy()
    rgb[:, 300:400] = 10
    found = measure("time_of_flight", plane(2.0), rgb)
    assert not found[:, 301:399].any() and (found[:, :299] > 0).all() and (found[:, 401:] > 0).all()


def test_pixels_at_edges_fly_between_both_surfaces():
    found = measure("time_of_flight", step(1.0, 2.0), np.full((480, 640, 3), 200, np.uint8), noise=0.0)
    flying = (found > 1.01) & (found < 1.99)
    assert flying[:, [199, 200, 399, 400]].all() and flying.sum() == 4 * 480
    # a quarter of a pixel beside the edge is the strip's, and sends four times the light
    np.testing.assert_allclose(found[:, 199], (0.25 * 4 * 1 + 0.75 * 2) / (0.25 * 4 + 0.75), atol=MILLIMETRE)
    assert (found >= 1).all() and (found <= 2).all()


def test_a_concave_corner_is_measured_too_far_and_a_convex_one_is_not():
    bias = 1000 * corner_bias(upright(1.0), CAMERA)
    assert bias.min() >= 0 and 5 < bias[240, 320] <= 20
    assert (np.diff(bias[240, 325:420]) <= 1e-3).all(), "most in the corner itself"
    assert bias[:, :200].max() < 0.1 and bias[:, 440:].max() < 0.1
    assert corner_bias(upright(-0.5), CAMERA).max() < 1e-4
    for wall in (plane(2.0), (2 / (1 + 0.7 * X)).astype(np.float32)):
        assert corner_bias(wall, CAMERA).max() < 1e-5
    assert corner_bias(step(), CAMERA).max() < 1e-5, "an edge is no corner"
    error = measure("time_of_flight", upright(1.0), noise=0.0) - upright(1.0)
    assert 0.004 < np.median(error[:, 310:330]) < 0.02 and np.median(error[:, :200]) < 1e-3


@pytest.mark.parametrize("depth", [1.0, 2.0, 4.0])
def test_a_stipple_is_regular_and_a_third_full(depth):
    found = measure("stipple", plane(depth), noise=0.0)
    filled = found > 0
    seen = int(585 * 0.05 / depth) + 2  # columns that the depth camera, to the right, does not see
    assert 1 - filled.mean() == pytest.approx(0.65, abs=0.05)
    assert not filled[:, : seen - 3].any()
    inner = filled[:, seen + 1 :]
    assert inner.mean() == pytest.approx(0.36, abs=0.01)
    # three pixels in five, both ways: the pattern is the same five pixels on
    np.testing.assert_array_equal(inner[5:], inner[:-5])
    np.testing.assert_array_equal(inner[:, 5:], inner[:, :-5])
    gaps = np.diff(np.nonzero(inner[inner.any(1).argmax()])[0])
    assert set(gaps) == {1, 2}
    np.testing.assert_allclose(found[filled], depth, atol=MILLIMETRE / 2 + 1e-6)
    noisy = measure("stipple", plane(depth))
    assert (noisy[noisy > 0] - depth).std() == pytest.approx(
        np.hypot(0.003 * depth**2, MILLIMETRE / 12**0.5), rel=0.03
    )


def test_points_of_a_stipple_lie_on_the_surface_to_half_a_pixel():
    slanted = (2 / (1 + 0.7 * X)).astype(np.float32)
    found = measure("stipple", slanted, noise=0.0)
    error = np.abs(found - slanted)[found > 0]
    half = 0.5 * np.abs(np.gradient(slanted, axis=1))[found > 0]
    assert (error < 1.02 * half + MILLIMETRE).all() and error.max() > 1.5 * MILLIMETRE


def test_the_wall_shows_through_a_stipple_on_one_side_and_is_missing_on_the_other():
    found = measure("stipple", step(1.0, 2.0), noise=0.0)
    parted = int(585 * 0.05 * (1 / 1.0 - 1 / 2.0))
    through = found[:, 200:400] > 1.5
    assert through[:, -parted + 2 :].mean() > 0.08 and not through[:, : -parted - 2].any()
    assert not found[:, 200 - parted + 2 : 198].any()
    assert np.mean(found[:, 100 : 200 - parted - 3] > 0) == pytest.approx(0.36, abs=0.02)
    assert set(np.unique(found)) == {0, 1, 2}, "no depth between the two"


@pytest.mark.parametrize("width", [80, 320])
@pytest.mark.parametrize("sensor", SENSORS)
def test_noise_in_metres_is_the_same_in_smaller_images(sensor, width):
    def spread(width):
        camera = Camera(585 * width / 640, 585 * width / 640, 0, 0, width, width)
        ones, rgb = np.ones((width, width), np.float32), np.full((width, width, 3), 150, np.uint8)
        rng = np.random.default_rng(0)
        found = measured_depth(sensor, 2.04 * ones, rgb, ones, camera, rng, holes=False)
        return (found[found > 0] - 2.04).std()

    assert spread(width) == pytest.approx(spread(640), rel=0.1)


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_room_is_seen_by_any_sensor(sensor):
    config = RoomConfig(duration_s=1.0, width=80, height=60, sensor=sensor)
    exact = room(RoomConfig(duration_s=1.0, width=80, height=60, depth_noise=0.0, holes=False))
    first, again = room(config), room(config)
    depth = [first.read(i).depth for i in (4, 2)]
    np.testing.assert_array_equal(depth[1], again.read(2).depth)  # whatever was read before
    np.testing.assert_array_equal(first.read(2).rgb, exact.read(2).rgb)
    error = (depth[1] - exact.read(2).depth)[depth[1] > 0]
    empty = np.mean(depth[1] == 0)
    assert (0.6 < empty < 0.75) if sensor == "stipple" else empty < 0.4
    assert 0.001 < np.median(np.abs(error)) < 0.05
    assert np.mean(depth[0] != depth[1]) > 0.1
