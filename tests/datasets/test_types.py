"""Photographs in part."""

import numpy as np
import pytest

from jaxpose.datasets.types import Photographs, every, take
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera


def photographs(n):
    return Photographs(
        "p",
        Camera(4.0, 4.0, 1.5, 1.5, 4, 4),
        np.arange(n) / 10,
        np.arange(n * 48, dtype=np.uint8).reshape(n, 4, 4, 3),
        np.arange(n * 16.0).reshape(n, 4, 4),
        2.0,
        6.0,
        "depth",
        tuple(f"{i}.png" for i in range(n)),
    )


def test_every_nth_photograph():
    whole = photographs(5)
    half = every(whole, 2)
    assert half.files == ("0.png", "2.png", "4.png")
    np.testing.assert_array_equal(half.t, [0, 0.2, 0.4])
    np.testing.assert_array_equal(half.rgb[1], whole.rgb[2])
    np.testing.assert_array_equal(half.T_world_cam[2], whole.T_world_cam[4])
    assert take(whole, np.array([3, 1])).files == ("3.png", "1.png")
    with pytest.raises(DataError, match="p: expected at least 2 images, got 1"):
        every(whole, 5)
    with pytest.raises(ValueError, match="at least 1, got 0"):
        every(whole, 0)
