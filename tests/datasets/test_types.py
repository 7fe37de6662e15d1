"""Photographs in part, frames as the library takes them, and what recordings share."""

import threading

import numpy as np
import pytest

from jaxpose.datasets.types import Frame, Photographs, Recording, check_frame, every, prefetch, take
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


CAMERA = Camera(4.0, 4.0, 1.5, 1.0, 4, 3)
RGB, DEPTH = np.zeros((3, 4, 3), np.uint8), np.full((3, 4), 2.5, np.float32)


def test_one_recording_cannot_change_another():
    one, other = (Recording(name, CAMERA, np.arange(2.0), lambda i: Frame(RGB, DEPTH)) for name in "ab")
    for array in (one.T_body_cam, one.gravity_world):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7
    np.testing.assert_array_equal(other.T_body_cam, np.eye(4))
    np.testing.assert_array_equal(other.gravity_world, [0, 0, -9.80665])


def test_a_frame_in_metres_is_taken_whatever_its_type():
    depth = DEPTH.astype(np.float64)
    depth[0, :3] = np.nan, np.inf, 0
    frame = check_frame(Frame(RGB, depth), CAMERA)
    assert frame.depth.dtype == np.float32
    np.testing.assert_array_equal(frame.depth[0], [0, 0, 0, 2.5])
    np.testing.assert_array_equal(frame.depth[1:], 2.5)


@pytest.mark.parametrize(
    ("rgb", "depth", "message"),
    [
        (
            RGB,
            (1000 * DEPTH).astype(np.uint16),
            "depth: expected metres, float.*, got uint16 up to 2500",
        ),
        (
            RGB,
            1000 * DEPTH,
            "depth: expected metres, float.*, got float32 up to 2500: divide mill",
        ),
        (RGB, DEPTH > 0, "depth: expected metres, floating point, got bool"),
        (RGB, -DEPTH, "depth: expected 0 or more, got -2.5"),
        (RGB, DEPTH.T, r"depth: expected shape \(3, 4\), got \(4, 3\)"),
        (RGB / 255, DEPTH, r"rgb: expected shape \(3, 4, 3\) of uint8, got \(3, 4, 3\) of float64"),
        (RGB[..., 0], DEPTH, r"rgb: expected shape \(3, 4, 3\) of uint8, got \(3, 4\) of uint8"),
    ],
)
def test_a_frame_that_is_none_is_named(rgb, depth, message):
    with pytest.raises(ValueError, match=message):
        check_frame(Frame(rgb, depth), CAMERA)


def test_frames_are_read_ahead_in_one_thread():
    asked, threads = [], set()

    def read(i):
        asked.append(i)
        threads.add(threading.get_ident())
        if i == 3:
            raise DataError("3.png: expected an image, got nothing")
        return Frame(RGB, DEPTH + i)

    recording = prefetch(Recording("r", CAMERA, np.arange(5.0), read))
    for i in (0, 1, 2, 1, 4):
        assert recording.read(i).depth[0, 0] == 2.5 + i
    with pytest.raises(DataError, match="3.png"):  # when it is asked for, not before
        recording.read(3)
    assert len(threads) == 1 and threading.get_ident() not in threads
    assert set(asked) == {0, 1, 2, 3, 4}
