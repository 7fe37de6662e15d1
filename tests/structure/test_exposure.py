"""Exposures: those that photographs of a plane were given, found again from the points that they share."""

import numpy as np
from helpers.photographed_plane import photographs
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose.geometry.camera import Camera, unproject_numpy
from jaxpose.structure import Tracks, evenly_exposed, matching_exposure, relative_exposures
from jaxpose.structure.patches import align_patches

CAMERA = Camera(200.0, 210.0, 99.5, 99.5, 200, 200)


def shared(wrong: float = 0.0):
    """Photographs exposed differently, what they share, and how they were exposed."""
    random = np.random.default_rng(0)
    images, view, point, pixel = photographs()
    exposure = np.exp(random.uniform(-0.4, 0.4, (5, 1)) + random.uniform(-0.2, 0.2, (5, 3)))
    images = np.clip(exposure[:, None, None] * (0.35 * images + 20), 0, 255).round().astype(np.uint8)
    placed = align_patches(images.__getitem__, view, point, pixel)
    at = placed.pixel.copy()
    lost = random.random(len(at)) < wrong
    at[lost] = random.uniform(20, 180, (lost.sum(), 2))
    tracks = Tracks(view, point, unproject_numpy(CAMERA, at)[:, :2], 5, 205.0, placed.found)
    return images, tracks, exposure / np.exp(np.log(exposure).mean(axis=0))


def test_exposures_are_found():
    images, tracks, exposure = shared()
    assert tracks.aligned.mean() > 0.7
    found = relative_exposures(images, CAMERA, tracks)
    assert_allclose(found, exposure, rtol=0.01)
    assert_allclose(np.log(found).mean(axis=0), 0, atol=1e-9)


def test_wrong_points_do_not_count():
    images, tracks, exposure = shared(wrong=0.1)
    assert_allclose(relative_exposures(images, CAMERA, tracks), exposure, rtol=0.04)


def test_photographs_that_nothing_is_known_of_stay_as_they_are():
    images, tracks, exposure = shared()
    alone = tracks._replace(aligned=tracks.aligned & (tracks.view != 3))
    found = relative_exposures(images, CAMERA, alone)
    others = [0, 1, 2, 4]
    assert_allclose(found[others] / found[0], exposure[others] / exposure[0], rtol=0.01)
    assert_allclose(found[3], 1, rtol=1e-4)
    none = tracks._replace(aligned=np.zeros_like(tracks.aligned))
    assert_array_equal(relative_exposures(images, CAMERA, none), np.ones((5, 3)))


def test_photographs_are_brought_to_one_exposure():
    even = np.random.default_rng(1).integers(0, 256, (2, 30, 40, 3), np.uint8)
    exposure = np.array([[1.5, 1.2, 1.0], [0.5, 0.8, 1.0]])
    seen = np.clip(even * exposure[:, None, None], 0, 255).round().astype(np.uint8)
    found, known = evenly_exposed(seen, exposure)
    assert np.abs(found[known].astype(int) - even[known]).max() <= 1
    cut_off = np.any(even[0] * exposure[0] >= 254.5, axis=-1) & ~np.all(even[0] >= 254, axis=-1)
    assert not known[0][cut_off & np.any(found[0] < even[0] - 2.0, axis=-1)].any() and known[1].all()


def test_the_exposure_of_an_image_is_that_of_its_photograph():
    image = np.random.default_rng(2).uniform(0, 0.9, (20, 30, 3))
    wanted = np.array([0.7, 1.0, 1.6])
    photograph = np.clip(255 * wanted * image, 0, 255).round().astype(np.uint8)
    assert_allclose(matching_exposure(image, photograph), wanted, rtol=0.01)
    some = image[..., 0] > 0.3
    assert_allclose(matching_exposure(image[some], photograph[some]), wanted, rtol=0.01)
    assert_array_equal(matching_exposure(np.zeros_like(image), photograph), np.ones(3))
    assert_array_equal(matching_exposure(image, np.full_like(photograph, 255)), np.ones(3))
