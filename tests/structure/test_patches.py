"""Patches that are found again: in photographs of a plane that are known affine maps of one another."""

import cv2
import numpy as np
import pytest

from jaxpose.structure.patches import align_patches


def blotches(size: tuple[int, int], spread: float) -> np.ndarray:
    random = np.random.default_rng(3)
    drawn = cv2.GaussianBlur(random.normal(0, 1, (*size, 3)).astype(np.float32), (0, 0), spread)
    return np.clip(128 + 50 * drawn / drawn.std(), 0, 255)


def photographs(brightness: float = 1.0):
    """A plane seen by five cameras: stretched, turned, moved; and pixels of 60 points in each."""
    whole, random = blotches((400, 400), 2.5), np.random.default_rng(4)
    first = random.uniform(40, 160, (60, 2))
    images, pixels = [], []
    for k in range(5):
        turn = 0.06 * k
        stretch = np.array([[1 + 0.05 * k, 0.03 * k], [0.0, 1 - 0.04 * k]])
        A = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ stretch
        b = 100 - A @ [100, 100] + [1.3 * k, -0.7 * k]
        warp = np.concatenate([A, (b - A @ [100, 100])[:, None]], axis=1)  # the plane's middle is at 200
        seen = cv2.warpAffine(whole, warp, (200, 200), flags=cv2.INTER_CUBIC)
        images.append(np.clip(brightness**k * seen, 0, 255).round().astype(np.uint8))
        pixels.append(first @ A.T + b)
    view = np.repeat(np.arange(5), 60)
    return np.stack(images), view, np.tile(np.arange(60), 5), np.concatenate(pixels)


@pytest.mark.parametrize(("enlarged", "brightness"), [(1, 1.0), (2, 1.0), (1, 0.85)])
def test_features_are_moved_to_where_one_of_them_is(enlarged, brightness):
    images, view, point, pixel = photographs(brightness)
    off = np.random.default_rng(5).normal(0, 0.3, pixel.shape)
    off[view == 2] = 0  # the middle one, which the others are brought to
    found = align_patches(images, view, point, pixel + off, enlarged)
    assert found.found.mean() > 0.8
    left = np.linalg.norm(found.pixel - pixel, axis=1)
    assert np.median(left[found.found & (view != 2)]) < 0.06
    np.testing.assert_array_equal(found.pixel[~found.found], (pixel + off)[~found.found])


def test_what_is_not_there_is_not_found():
    images, view, point, pixel = photographs()
    images[4] = blotches((200, 200), 2.0)[..., ::-1]
    found = align_patches(images, view, point, pixel).found
    assert found[view == 3].mean() > 0.8 and found[view == 4].mean() < 0.1
    grey = align_patches(np.full_like(images, 90), view, point, pixel)
    assert not grey.found.any()
    np.testing.assert_array_equal(grey.pixel, pixel)


def test_a_feature_at_the_edge_stays_within():
    images, view, point, pixel = photographs()
    pixel[:] = [0.2, 199.4]
    found = align_patches(images, view, point, pixel)
    assert np.isfinite(found.pixel).all()
    none = align_patches(images, view[:0], point[:0], pixel[:0])
    assert none.found.shape == (0,)
