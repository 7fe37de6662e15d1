"""The camera against numbers worked by hand, the real lenses of two data sets, and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.distortion import pixel_of, ray_of

from jaxpose.geometry import camera
from jaxpose.geometry.camera import Camera

PINHOLE = Camera(500.0, 480.0, 319.5, 239.5, 640, 480)
EUROC = Camera(
    458.654, 457.296, 367.215, 248.375, 752, 480, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
)
TUM_FR1 = Camera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
LENSES = [PINHOLE, EUROC, TUM_FR1]


def whole_image(lens: Camera) -> np.ndarray:
    """Pixels over the whole image, its outer edge included."""
    u, v = np.meshgrid(np.linspace(-0.5, lens.width - 0.5, 33), np.linspace(-0.5, lens.height - 0.5, 25))
    return np.stack([u, v], axis=-1)


@pytest.mark.parametrize("lens", LENSES)
def test_project_undoes_unproject(lens, dtype):
    pixel = whole_image(lens)
    depth = np.linspace(0.3, 9, 25 * 33).reshape(25, 33, 1)

    @jax.jit
    def there_and_back(pixel, depth):
        ray = camera.unproject(lens, pixel)
        return ray, camera.project(lens, depth * ray)

    ray, back = there_and_back(jnp.asarray(pixel, dtype), jnp.asarray(depth, dtype))
    assert ray.dtype == back.dtype == dtype
    np.testing.assert_array_equal(ray[..., 2], 1)
    np.testing.assert_allclose(back, pixel, rtol=0, atol=5e-4 if dtype == jnp.float32 else 1e-11)


def test_pinhole_by_hand(dtype):
    ray = camera.unproject(PINHOLE, jnp.asarray([[319.5, 239.5], [819.5, -0.5]], dtype))
    np.testing.assert_allclose(ray, [[0, 0, 1], [1, -0.5, 1]], rtol=1e-6)
    pixel = camera.project(PINHOLE, jnp.asarray([0.2, -0.1, 2.0], dtype))
    np.testing.assert_allclose(pixel, [369.5, 215.5], rtol=1e-6)


def test_distortion_by_hand(dtype):
    """x = 0.5, y = -0.25, r^2 = 0.3125, with each of the five terms worked out from OpenCV's formula."""
    lens = Camera(100.0, 100.0, 0.0, 0.0, 100, 100, (0.1, 0.2, 0.01, 0.02, 0.4))
    pixel = camera.project(lens, jnp.asarray([1.0, -0.5, 2.0], dtype))
    # radial = 1 + 0.03125 + 0.01953125 + 0.01220703125 = 1.06298828125
    x = 0.531494140625 - 0.0025 + 0.01625
    y = -0.2657470703125 + 0.004375 - 0.005
    np.testing.assert_allclose(pixel, [100 * x, 100 * y], rtol=1e-6)


@pytest.mark.parametrize("lens", [EUROC, TUM_FR1])
def test_derivative_through_the_undistortion(lens):
    with jax.enable_x64(True):
        pixel = jnp.asarray(whole_image(lens)[::6, ::8])
        direction = jnp.broadcast_to(jnp.asarray([0.6, -0.8]), pixel.shape)
        ray = jax.jit(lambda p: camera.unproject(lens, p))
        _, tangent = jax.jvp(ray, (pixel,), (direction,))
        difference = (ray(pixel + 1e-3 * direction) - ray(pixel - 1e-3 * direction)) / 2e-3
        np.testing.assert_allclose(tangent, difference, rtol=1e-6, atol=1e-10)


def test_no_distortion_costs_nothing():
    """A pinhole without coefficients compiles to the same program as the two lines of arithmetic."""
    pixel = jnp.zeros((4, 2))
    operations = str(jax.make_jaxpr(lambda p: camera.unproject(PINHOLE, p))(pixel))
    assert operations.count("sub") == operations.count("div") == 2
    assert "mul" not in operations


@pytest.mark.parametrize("lens", [PINHOLE, TUM_FR1])
@pytest.mark.parametrize("point", [(0.1, 0.2, -1.0), (0.1, 0.2, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 1e-9)])
def test_a_point_behind_has_no_pixel_and_no_gradient(lens, point, dtype):
    point = jnp.asarray(point, dtype)
    assert np.all(np.asarray(camera.project(lens, point)) == -1e6)
    gradient = jax.jit(jax.jacrev(lambda p: camera.project(lens, p)))(point)
    np.testing.assert_array_equal(gradient, 0)


@pytest.mark.parametrize(("factor", "size"), [(0.5, (320, 240)), (0.25, (160, 120)), (2.0, (1280, 960))])
def test_scale_keeps_rays(factor, size, dtype):
    """The centre of a block of pixels sees along the ray of the resized pixel that averages the block."""
    small = camera.scale(TUM_FR1, factor)
    assert (small.width, small.height) == size
    pixel = whole_image(TUM_FR1)
    resized = (pixel + 0.5) * factor - 0.5
    before, after = (
        jax.jit(lambda p, lens=lens: camera.unproject(lens, p))(jnp.asarray(p, dtype))
        for lens, p in ((TUM_FR1, pixel), (small, resized))
    )
    np.testing.assert_allclose(after, before, rtol=0, atol=2e-6 if dtype == jnp.float32 else 1e-13)


def test_scale_to_a_rounded_size_keeps_the_image_edges(dtype):
    """752 x 0.3 is not whole: the scale is that of the rounded size, in each axis its own."""
    small = camera.scale(EUROC._replace(distortion=()), 0.3)
    assert (small.width, small.height) == (226, 144)
    corners = [
        camera.unproject(lens, jnp.asarray([lens.width - 0.5, lens.height - 0.5], dtype))
        for lens in (EUROC._replace(distortion=()), small)
    ]
    np.testing.assert_allclose(corners[1], corners[0], rtol=1e-6)


def test_a_camera_can_be_traced():
    """Intrinsics may be optimised: the camera is a pytree."""
    pixel = jnp.asarray([[100.0, 50.0]])
    traced = jax.jit(camera.unproject)(TUM_FR1, pixel)
    np.testing.assert_allclose(traced, camera.unproject(TUM_FR1, pixel), rtol=1e-6)


@pytest.mark.parametrize("count", [1, 3, 8])
def test_a_wrong_number_of_coefficients_is_named(count):
    lens = PINHOLE._replace(distortion=(0.1,) * count)
    with pytest.raises(ValueError, match=f"expected k1 k2 p1 p2 .* got {count}"):
        camera.project(lens, jnp.ones(3))


@pytest.mark.parametrize("lens", LENSES)
def test_the_numpy_twins_are_opencvs_formulas_and_those_of_jax(lens):
    pixel = whole_image(lens)
    ray = camera.unproject_numpy(lens, pixel)
    points = np.linspace(0.3, 9, 25 * 33).reshape(25, 33, 1) * ray
    seen = camera.project_numpy(lens, points)
    np.testing.assert_allclose(ray, ray_of(lens, pixel[..., 0], pixel[..., 1]), rtol=0, atol=1e-13)
    np.testing.assert_allclose(seen, np.stack(pixel_of(lens, *np.moveaxis(points, -1, 0)), -1), atol=1e-10)
    with jax.enable_x64(True):
        np.testing.assert_allclose(camera.unproject(lens, jnp.asarray(pixel)), ray, rtol=0, atol=1e-14)
        np.testing.assert_allclose(camera.project(lens, jnp.asarray(points)), seen, rtol=0, atol=1e-11)


@pytest.mark.parametrize("project", [lambda *a: camera.project(*a), camera.project_numpy])
def test_what_the_polynomial_would_fold_back_has_no_pixel(project):
    """k1 = -0.3 alone: x (1 - 0.3 x^2) grows up to x = 1.054; 1.7 would be seen where 0.226 is."""
    lens = Camera(200.0, 200.0, 92.0, 62.0, 188, 120, (-0.3, 0.0, 0.0, 0.0))
    assert 0 < 200 * 1.7 * (1 - 0.3 * 1.7**2) + 92 < 188
    points = np.float32([[1.7, 0.0, 1.0], [0.0, 6.0, 2.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
    pixel = np.asarray(project(lens, points if project is camera.project_numpy else jnp.asarray(points)))
    np.testing.assert_array_equal(pixel[[0, 1, 3]], -1e6)
    np.testing.assert_allclose(pixel[2], [200 * 0.7 + 92, 62], rtol=1e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_pixel_slopes_are_finite_differences(lens):
    with jax.enable_x64(True):
        ray = camera.unproject(lens, jnp.asarray(whole_image(lens)[::6, ::8]))
        found = camera.pixel_slopes(lens, np.asarray(ray))
        for k in range(2):
            h = 1e-6 * jnp.eye(3)[k][None, None]
            difference = (camera.project(lens, ray + h) - camera.project(lens, ray - h)) / 2e-6
            np.testing.assert_allclose(found[..., k], difference, rtol=1e-6, atol=1e-5)


def test_points_and_pixels_of_a_wrong_shape_are_named(unchecked):
    for project, lib in ((camera.project, jnp), (camera.project_numpy, np)):
        with pytest.raises(ValueError, match=r"point_cam: expected 3 coordinates .* got shape \(5, 2\)"):
            project(PINHOLE, lib.ones((5, 2)))
    for unproject, lib in ((camera.unproject, jnp), (camera.unproject_numpy, np)):
        with pytest.raises(ValueError, match=r"pixel: expected 2 coordinates .* got shape \(3,\)"):
            unproject(PINHOLE, lib.ones(3))


def test_a_camera_of_no_size_is_refused():
    with pytest.raises(ValueError, match="factor: expected a positive number, got 0"):
        camera.scale(PINHOLE, 0.0)
    with pytest.raises(ValueError, match="at least 1x1 pixels, got 0x10"):
        camera.resized(PINHOLE, 0, 10)
