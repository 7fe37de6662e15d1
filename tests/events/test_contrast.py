"""Motion from events by contrast: where events are carried, and the slide that is found."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter, map_coordinates

from jaxpose.datasets.events import registry as event_registry
from jaxpose.errors import DataError
from jaxpose.events import Events, simulate
from jaxpose.events.contrast import find_displacement, locate, warped
from jaxpose.geometry.camera import Camera

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)


def test_events_are_carried_to_where_their_points_are_at_the_middle_of_the_time():
    # Two events of points at depth 2 and 4, a camera that moves by (0.5, 0.2, 0.4) a second.
    events = Events(np.array([0.0, 2.0]), np.uint16([40, 20]), np.uint16([30, 10]), np.int8([1, -1]))
    velocity, depth = np.array([0.5, 0.2, 0.4]), np.array([2.0, 4.0])
    image = warped(
        CAMERA,
        locate(CAMERA, events),
        jnp.asarray(1 / depth, jnp.float32),
        jnp.asarray(velocity, jnp.float32),
    )
    image = np.asarray(image, np.float64)
    row, column = np.mgrid[:48, :64]
    for index, sign in enumerate([1, -1]):
        ray = np.array([(events.x[index] - 31.5) / 60, (events.y[index] - 23.5) / 60, 1.0])
        point = depth[index] * ray + velocity * (events.t[index] - 1.0)  # at t = 1 s, in the camera then
        expected = 60 * point[:2] / point[2] + [31.5, 23.5]
        part = np.where(sign * image > 1e-9, sign * image, 0)
        assert_allclose(part.sum(), 1.0, rtol=1e-4)
        assert_allclose([(part * column).sum(), (part * row).sum()], expected, atol=2e-3)


@pytest.fixture(scope="module")
def steps():
    """Events of a textured wall, its right half twice as near, seen by a camera that slides."""
    texture = gaussian_filter(np.random.default_rng(0).normal(size=(90, 200)), 1.5)
    texture *= 0.6 / texture.std()
    row, column = np.mgrid[:48, :64].astype(float)
    nearness = np.where(column < 32, 2 / 3, 4 / 3)
    flow = np.array([30.0, -12.0])  # [px/s] per nearness

    def images():
        for t in np.linspace(0, 0.3, 31):
            # The camera goes to the right: what it sees comes from farther right.
            at = [row + 20 + flow[1] * nearness * t, column + 60 + flow[0] * nearness * t]
            yield t, map_coordinates(texture, at, order=1)

    return simulate(images(), 0.1), flow / 60


def test_the_slide_of_a_camera_before_two_walls_is_found(steps):
    events, velocity = steps
    slide = find_displacement(CAMERA, events)
    angle = np.degrees(np.arctan2(*slide.velocity[[1, 0]]) - np.arctan2(*velocity[[1, 0]]))
    assert abs(angle) < 4
    assert slide.velocity[2] == 0
    assert_allclose(np.exp(np.log(slide.inverse_depth).mean()), 1, rtol=1e-5)
    left, right = slide.inverse_depth[1:-1, 1:3].mean(), slide.inverse_depth[1:-1, 5:7].mean()
    assert right / left == pytest.approx(2, rel=0.2)
    # Velocity times nearness is what events tell.
    assert left * np.linalg.norm(slide.velocity) == pytest.approx(2 / 3 * np.linalg.norm(velocity), rel=0.15)
    located = locate(CAMERA, events)
    near = jnp.ones(len(events.t))
    contrast = lambda k: float(
        jnp.var(warped(CAMERA, located, near, jnp.asarray(k * slide.velocity, jnp.float32)))
    )
    assert slide.contrast > contrast(1.0) > max(contrast(0.0), contrast(-1.0), contrast(2.0))


def test_few_events_are_refused(steps):
    few = Events(*(column[:50] for column in steps[0]))
    with pytest.raises(DataError, match="at least 100 events, got 50"):
        find_displacement(CAMERA, few)


@pytest.mark.data
@pytest.mark.slow
def test_the_slider_of_a_real_recording(data_dir):
    recording = event_registry.load_events(data_dir / "ecd_slider_depth")
    slide = find_displacement(recording.camera, recording.events)
    first, last = recording.T_world_cam[[0, -1]]
    way = first[:3, :3].T @ (last[:3, 3] - first[:3, 3])
    cosine = way @ slide.velocity / np.linalg.norm(way) / np.linalg.norm(slide.velocity)
    assert np.degrees(np.arccos(cosine)) < 5
