"""Patches that are found again: in photographs of a plane that are known affine maps of one another."""

import numpy as np
import pytest
from helpers.photographed_plane import blotches, photographs

from jaxpose.structure.patches import align_patches


@pytest.mark.parametrize(("enlarged", "brightness"), [(1, 1.0), (2, 1.0), (1, 0.85)])
def test_features_are_moved_to_where_one_of_them_is(enlarged, brightness):
    images, view, point, pixel = photographs(brightness)
    off = np.random.default_rng(5).normal(0, 0.3, pixel.shape)
    off[view == 2] = 0  # the middle one, which the others are brought to
    found = align_patches(images.__getitem__, view, point, pixel + off, enlarged)
    assert found.found.mean() > 0.8
    left = np.linalg.norm(found.pixel - pixel, axis=1)
    assert np.median(left[found.found & (view != 2)]) < 0.06
    np.testing.assert_array_equal(found.pixel[~found.found], (pixel + off)[~found.found])


def test_what_is_not_there_is_not_found():
    images, view, point, pixel = photographs()
    images[4] = blotches((200, 200), 2.0)[..., ::-1]
    found = align_patches(images.__getitem__, view, point, pixel).found
    assert found[view == 3].mean() > 0.8 and found[view == 4].mean() < 0.1
    grey = align_patches(np.full_like(images, 90).__getitem__, view, point, pixel)
    assert not grey.found.any()
    np.testing.assert_array_equal(grey.pixel, pixel)


def test_a_feature_at_the_edge_stays_within():
    images, view, point, pixel = photographs()
    pixel[:] = [0.2, 199.4]
    found = align_patches(images.__getitem__, view, point, pixel)
    assert np.isfinite(found.pixel).all()
    none = align_patches(images.__getitem__, view[:0], point[:0], pixel[:0])
    assert none.found.shape == (0,)
