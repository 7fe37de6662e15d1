"""A turn that all cameras share, found from events of points that a camera circles."""

import numpy as np
import pytest

from jaxpose.errors import DataError
from jaxpose.events import Events, find_turn_deg
from jaxpose.geometry.camera import Camera

CAMERA = Camera(137.0, 137.0, 49.5, 49.5, 100, 100)
DISTANCE = 4.0


def circling(t: np.ndarray) -> np.ndarray:
    """Camera-to-world poses on a circle in the plane z = 0 that look at its centre, y down."""
    cosine, sine, zero, one = np.cos(t), np.sin(t), np.zeros_like(t), np.ones_like(t)
    columns = (
        [-sine, cosine, zero],  # x, to the right
        [zero, zero, -one],
        [-cosine, -sine, zero],  # z, forward
        [DISTANCE * cosine, DISTANCE * sine, zero],
    )
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3] = np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)
    return T


def events_of_points(count: int) -> Events:
    """Each event is one of 40 points, seen at its time at the nearest pixel."""
    generator = np.random.default_rng(1)
    points = generator.uniform(-1, 1, (40, 3))
    t = np.sort(generator.uniform(0, 2 * np.pi, count))
    which = generator.integers(0, 40, count)
    T = circling(t)
    seen = np.einsum("nji,nj->ni", T[:, :3, :3], points[which] - T[:, :3, 3])
    x, y = (seen[:, k] / seen[:, 2] * 137.0 + 49.5 for k in (0, 1))
    polarity = np.where(which % 2, 1, -1)
    return Events(t, np.round(x).astype(np.uint16), np.round(y).astype(np.uint16), polarity.astype(np.int8))


@pytest.mark.parametrize("turned_deg", [2.85, -7.0])
def test_cameras_turned_alike_are_turned_back(turned_deg):
    angle = np.radians(turned_deg)
    wrong = np.eye(4)
    wrong[0, 0], wrong[0, 2], wrong[2, 0], wrong[2, 2] = (
        np.cos(angle),
        np.sin(angle),
        -np.sin(angle),
        np.cos(angle),
    )
    found = find_turn_deg(CAMERA, events_of_points(2000), lambda t: circling(t) @ wrong, (2.0, 6.0))
    assert found == pytest.approx(-turned_deg, abs=0.1)


def test_few_events_are_refused():
    with pytest.raises(DataError, match="expected at least 1000 events, got 10"):
        find_turn_deg(CAMERA, events_of_points(10), circling, (2.0, 6.0))
