"""Lenses against COLMAP's and OpenCV's own projections, and images brought from them to a pinhole camera."""

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from jaxpose.datasets import lens as lenses
from jaxpose.datasets.lens import as_camera, from_colmap, lens, pinhole_for, project
from jaxpose.datasets.photos.pixels import read_views
from jaxpose.errors import DataError
from jaxpose.files.colmap import MODELS, ColmapCamera
from jaxpose.geometry.camera import project_numpy

EXTRA = {  # parameters behind the principal point, of real lenses' size
    "SIMPLE_RADIAL": (0.1,), "RADIAL": (0.1, -0.03), "OPENCV": (0.1, -0.03, 0.002, -0.003),
    "FULL_OPENCV": (0.1, -0.03, 0.002, -0.003, 0.01, 0.05, -0.01, 0.003),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.004, -0.001), "SIMPLE_RADIAL_FISHEYE": (0.03,),
    "RADIAL_FISHEYE": (0.03, -0.01), "FOV": (0.9,),
    "THIN_PRISM_FISHEYE": (0.05, -0.01, 0.002, -0.003, 0.004, -0.001, 0.005, -0.004),
}  # fmt: skip
REFUSED = ("RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM", "EQUIRECTANGULAR")


def colmap_camera(model):
    params = dict(MODELS)[model]
    extra = EXTRA.get(model, ())
    focal = (300.0,) if params - len(extra) == 3 else (300.0, 310.0)
    return ColmapCamera(model, 640, 480, (*focal, 322.0, 237.0, *extra))


@pytest.mark.parametrize("model", [name for name, _ in MODELS if name not in REFUSED])
def test_pixels_are_those_of_colmap(model):
    camera = colmap_camera(model)
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=camera.parameters)
    xy = np.random.default_rng(0).uniform(-1.3, 1.3, (400, 2))
    expected = theirs.img_from_cam(np.column_stack([xy, np.ones(400)])) - 0.5
    ours = from_colmap(camera, "f")
    pixel, inside = project(ours, xy)
    np.testing.assert_allclose(pixel, expected, atol=1e-9)
    held = (expected >= -0.5).all(1) & (expected <= [639.5, 479.5]).all(1)
    np.testing.assert_array_equal(inside, held)
    assert 0.2 < held.mean() < 1
    if as_camera(ours) is not None:  # what Camera has, it has alike
        assert model not in ("FULL_OPENCV", "FOV") and "FISHEYE" not in model
        again = project_numpy(as_camera(ours), np.column_stack([xy, np.ones(400)]))
        np.testing.assert_allclose(again[inside], pixel[inside], atol=1e-9)


@pytest.mark.parametrize("model", REFUSED)
def test_other_models_are_refused_with_the_undistorter(model):
    params = tuple(np.full(dict(MODELS)[model], 0.5))
    with pytest.raises(DataError, match=rf"cameras.bin: .*got {model}: undistort with colmap image_undist"):
        from_colmap(ColmapCamera(model, 640, 480, params), "cameras.bin")


def test_fisheye_is_that_of_opencv_and_the_rational_model_too():
    xy = np.random.default_rng(0).uniform(-1.5, 1.5, (100, 2))
    points = np.column_stack([xy, np.ones(100)])[:, None]
    K = np.array([[200.0, 0, 320], [0, 210, 240], [0, 0, 1]])
    fish, k = ("k1", "k2", "k3", "k4"), (0.05, -0.02, 0.01, -0.002)
    seen = lens("fisheye", (200.0, 210.0, 320.0, 240.0), (640, 480), dict(zip(fish, k, strict=True)))
    theirs = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(k))[0][:, 0]
    np.testing.assert_allclose(project(seen, xy)[0], theirs, atol=1e-8)
    rational = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    k = (0.1, -0.05, 0.002, 0.003, 0.01, 0.2, 0.03, 0.004)
    seen = lens("opencv", (200.0, 210.0, 320.0, 240.0), (640, 480), dict(zip(rational, k, strict=True)))
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(k))[0][:, 0]
    np.testing.assert_allclose(project(seen, xy)[0], theirs, atol=1e-8)


def test_rays_beyond_the_turning_point_are_not_in_the_image():
    seen = lens(
        "opencv", (300.0, 300.0, 320.0, 240.0), (640, 480), {"k1": -0.3}
    )  # r - 0.3 r^3 falls from 1.05 on
    pixel, inside = project(seen, np.array([[0.5, 0.0], [1.9, 0.0]]))
    assert 0 < pixel[1, 0] < 639 and inside.tolist() == [True, False]


def pattern(x, y):
    """A smooth scene on the plane z = 1: three channels in [0, 255]."""
    return 127 + 100 * np.stack([np.sin(3 * x) * np.cos(2 * y), np.sin(2 * x + 1), np.cos(3 * y)], -1)


def photograph(seen, file):
    """The scene through a lens, every pixel found by search, without `pinhole_for` and the resampler."""
    grid = np.linspace(-2.2, 2.2, 1101)
    rays = np.stack(np.meshgrid(grid, grid), -1)
    pixel, inside = project(seen, rays)
    column, row = np.rint(pixel[inside]).astype(int).T
    colour = np.zeros((seen.height, seen.width, 3))
    count = np.zeros((seen.height, seen.width, 1))
    keep = (column >= 0) & (column < seen.width) & (row >= 0) & (row < seen.height)
    np.add.at(colour, (row[keep], column[keep]), pattern(*rays[inside][keep].T))
    np.add.at(count, (row[keep], column[keep]), 1)
    Image.fromarray((colour / np.maximum(count, 1)).round().astype(np.uint8)).save(file)


def test_photographs_of_several_lenses_become_those_of_one_pinhole_camera(tmp_path):
    seen = [
        lens("fisheye", (75.0, 75.0, 63.5, 47.5), (128, 96), {"k1": 0.02}),
        lens("opencv", (80.0, 80.0, 47.5, 63.5), (96, 128), {"k1": -0.05, "k4": 0.02}),  # and upright
    ]
    files = [tmp_path / "fish.png", tmp_path / "upright.png"]
    for one, file in zip(seen, files, strict=True):
        photograph(one, file)
    full, beyond = pinhole_for(seen)
    assert not beyond
    pixels = read_views(files, seen, [None, None], stated="", width=full.width // 2)
    camera = pixels.camera
    assert (camera.width, camera.distortion) == (full.width // 2, ())
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    expected = pattern((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
    for image, mask in zip(pixels.rgb, pixels.mask, strict=True):
        assert 0.2 < mask.mean() < 0.9
        error = np.abs(image - expected)[mask]
        assert error.mean() < 3 and np.quantile(error, 0.99) < 15
        assert (image[~mask] == 255).all()
    assert "2 cameras (fisheye, opencv): images brought to one pinhole camera" in pixels.notes[0]
    # Every pixel of the originals but those at the rim is within what is kept: nothing is cropped.
    for one, mask in zip(seen, pixels.mask, strict=True):
        at = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy], -1)[mask]
        shown = project(one, at)[0]
        assert np.ptp(shown, axis=0).min() > 0.93 * min(one.width, one.height)


def test_what_a_wide_fisheye_sees_beyond_60_degrees_is_left_out():
    wide = lens("fisheye", (50.0, 50.0, 127.5, 127.5), (256, 256), {})  # sees 146 degrees, and 206 across
    camera, beyond = pinhole_for([wide])
    assert beyond
    half = np.degrees(np.arctan((camera.width / 2) / camera.fx))
    assert half == pytest.approx(lenses.WIDEST_DEG, abs=0.5)
