"""Rolling shutters: rows moved to the first one's time, and the line delay found, in rooms of closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.box import LOWER, UPPER, box_pixels, inside_of_a_box

from jaxpose.datasets.types import Frame, Recording
from jaxpose.errors import DataError
from jaxpose.geometry import rigid, se3
from jaxpose.geometry.camera import Camera, pixel_grid, unproject_numpy
from jaxpose.slam import SlamConfig, line_delay
from jaxpose.slam.config import TrackConfig
from jaxpose.slam.rolling_shutter import at_first_row
from jaxpose.slam.tracking.register import line_delay_correction, register
from jaxpose.slam.types import no_frames

CAMERA = Camera(140.0, 140.0, 79.5, 59.5, 160, 120, (-0.1, 0.02, 0.001, 0.0))
TWIST = np.array([0.6, -0.3, 0.2, 0.5, -1.0, 0.7])
DELAY_S = 1e-4


def box_seen(T_world_cam):
    """The box as each row's own pose (h, 4, 4) has it, by rays and walls: colour, depth."""
    ray = unproject_numpy(CAMERA, pixel_grid(CAMERA))
    direction = np.einsum("hij,hwj->hwi", T_world_cam[:, :3, :3], ray)
    origin = T_world_cam[:, None, :3, 3]
    depth = np.min(np.where(direction > 0, UPPER - origin, LOWER - origin) / direction, axis=-1)
    colour = 0.5 + 0.4 * np.sin(3 * (origin + depth[..., None] * direction))
    return Frame(np.round(255 * colour).astype(np.uint8), depth.astype(np.float32))


def test_rows_of_a_moving_camera_are_moved_to_the_first_one_s_time():
    T = rigid.exp(np.array([0.2, -0.1, 0.3, 0.1, 0.3, -0.2]))
    still = box_seen(np.tile(T, (CAMERA.height, 1, 1)))
    rows = np.arange(CAMERA.height)[:, None] * DELAY_S
    rolling = box_seen(T @ rigid.exp(rows * TWIST))
    moved = at_first_row(rolling, CAMERA, TWIST, DELAY_S)
    seen = moved.depth > 0
    off = lambda frame: np.abs(frame.depth - still.depth)[seen]
    assert seen.mean() > 0.95 and not seen.all()  # what came into view later is not made up
    assert np.percentile(off(moved), 90) < 1e-3 < 0.02 < np.percentile(off(rolling), 90)
    colour = lambda frame: np.abs(frame.rgb.astype(float) - still.rgb)[seen].mean()
    assert colour(moved) < 0.6 < 1.5 < colour(rolling)


def test_holes_stay_holes_and_a_camera_at_rest_keeps_its_frame():
    frame = box_seen(np.tile(np.eye(4), (CAMERA.height, 1, 1)))
    assert at_first_row(frame, CAMERA, np.zeros(6), DELAY_S) is frame
    holes = frame._replace(depth=np.where(np.arange(160) < 80, 0, frame.depth))
    moved = at_first_row(holes, CAMERA, TWIST, DELAY_S)
    assert (moved.depth[:, :60] == 0).all() and set(np.unique(moved.depth > 0)) == {False, True}
    none = frame._replace(depth=np.zeros_like(frame.depth))
    assert at_first_row(none, CAMERA, TWIST, DELAY_S) is none


def test_residuals_of_rows_tell_the_line_delay():
    """Points that were measured later than thought; the pose is registered, which takes up part of it."""
    T = np.asarray(se3.exp(jnp.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1])), np.float64)
    row = np.random.default_rng(1).uniform(0, 120, 600)
    pixels = box_pixels(T, 600)
    by_row = [box_pixels(T @ rigid.exp(r * DELAY_S * TWIST), 600) for r in row]
    pixels = pixels._replace(
        depth=jnp.stack([p.depth[k] for k, p in enumerate(by_row)]),
        rgb=jnp.stack([p.rgb[k] for k, p in enumerate(by_row)]),
    )
    wide, config = 0.25 * jnp.eye(6), TrackConfig()

    @jax.jit
    def found(T):
        at = register(inside_of_a_box, T, T, wide, pixels, config)
        of_row = jnp.asarray(row, jnp.float32), jnp.asarray(TWIST, jnp.float32)
        return line_delay_correction(inside_of_a_box, at, jnp.linalg.inv(wide), pixels, *of_row, config)

    correction, information = found(jnp.asarray(T, jnp.float32))
    assert correction == pytest.approx(DELAY_S, rel=0.1) and information > 0


def asked_by(corrections, monkeypatch):
    """An estimate from runs that ask for corrections [s] by the line delay that they assume."""

    def run(recording, config, on_frame):
        told = np.array([corrections(config.line_delay_us / 1e6), 1e12])
        return type("State", (), {"frames": no_frames(np.zeros(2)).put(1, line_delay=told)})

    monkeypatch.setattr(line_delay, "track_all", run)
    recording = Recording("made", CAMERA, np.arange(2.0), lambda i: None)
    return line_delay.estimate_line_delay(recording, SlamConfig())


def test_the_line_delay_is_where_no_correction_is_asked_for(monkeypatch):
    found = asked_by(lambda assumed: 0.1 * (4e-5 - assumed), monkeypatch)
    bent = asked_by(lambda assumed: 0.1 * (4e-5 - assumed) * (1 + 5e3 * assumed), monkeypatch)
    assert bent.line_delay_us == pytest.approx(40, abs=1)
    assert found.line_delay_us == pytest.approx(40) and found.sigma_us == pytest.approx(10)
    with pytest.raises(DataError, match="made: line delay: this motion says nothing of it"):
        asked_by(lambda assumed: 0.0, monkeypatch)
