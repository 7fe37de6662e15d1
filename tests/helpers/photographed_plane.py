"""A blotched plane in photographs that are known affine maps of one another."""

import cv2
import numpy as np


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
