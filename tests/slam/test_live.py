"""Frames that come one by one: the same as a recording, states that stay usable, bad frames refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose import slam
from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.types import select
from jaxpose.errors import DataError
from jaxpose.imu import Imu
from jaxpose.scenes.voxel_blocks import sample_blocks
from jaxpose.slam import SlamConfig, TrackingStatus, checkpoint
from jaxpose.slam.map.backend import seen_points


@pytest.fixture(scope="module")
def walk():
    return select(room(RoomConfig(duration_s=1.0, width=80, height=60)), np.arange(5))


def live(walk, config, start, **first):
    """A run fed with readings as a sensor gives them: those up to each frame, and one more."""
    state = slam.init(walk.camera, config, T_body_cam=walk.T_body_cam, **first)
    states = [state]
    for i, t in enumerate(walk.t):
        frame = walk.read(i)
        since = walk.t[i - 1] if i else -np.inf
        new = (walk.imu.t > since) & (walk.imu.t <= t + 0.005)
        imu = Imu(*(x[new] for x in walk.imu)) if config.uses_gyroscope else None
        states.append(slam.step(states[-1], frame.rgb, frame.depth, start + t, imu))
    return states


@pytest.mark.slow
@pytest.mark.parametrize(("imu", "start"), [("none", 1.7e9), ("combined", 0.0)])
def test_frames_one_by_one_end_where_a_recording_does(walk, imu, start):
    config = SlamConfig(imu=imu, voxel=0.05)
    expected = slam.run(walk, config)
    states = live(walk, config, start, T_world_cam=walk.T_world_cam[0])
    found = slam.finish(states[-1])
    np.testing.assert_allclose(found.T_world_cam, expected.T_world_cam, atol=1e-5)
    np.testing.assert_array_equal(found.frames.status, expected.frames.status)
    np.testing.assert_array_equal(found.keyframes, expected.keyframes)
    for a, b in zip(jax.tree.leaves(found.scene_params), jax.tree.leaves(expected.scene_params), strict=True):
        assert np.mean(np.abs(np.asarray(a, np.float32) - np.asarray(b, np.float32)) > 1e-2) < 1e-3
    # The state before is as it was: the last frame taken again from there ends in the same place.
    if imu == "none":
        again = slam.step(states[-2], *walk.read(4), start + walk.t[4])
        np.testing.assert_array_equal(again.frames.T_world_body, states[-1].frames.T_world_body)
    assert len(jax.tree.leaves(states[-1])) > 20  # a pytree, all of it


def test_the_world_is_upright_by_the_first_readings(walk):
    frame, config = walk.read(0), SlamConfig(imu="tight", voxel=0.1)
    near = walk.imu.t <= 0.5
    state = slam.init(walk.camera, config, T_body_cam=walk.T_body_cam)
    state = slam.step(state, frame.rgb, frame.depth, 0.0, Imu(*(x[near] for x in walk.imu)))
    up_cam = (state.frames.T_world_body[0] @ state.T_body_cam)[2, :3]
    assert np.rad2deg(np.arccos(up_cam @ walk.T_world_cam[0, 2, :3])) < 5
    assert state.frames.status[0] == TrackingStatus.TRACKED


def test_bad_frames_are_refused_by_the_argument(walk):
    state, (rgb, depth) = slam.init(walk.camera), walk.read(0)
    for args, message in (
        ((rgb[:-1], depth, 0.0), r"rgb: expected shape \(60, 80, 3\) of uint8, got \(59, 80, 3\)"),
        ((rgb / 255, depth, 0.0), "uint8, got .* float64"),
        ((rgb, (1000 * depth).astype(np.uint16), 0.0), "depth: expected metres, floating point, got uint16"),
        ((rgb, depth[None], 0.0), r"got \(1, 60, 80\)"),
        ((rgb, depth, np.nan), r"expected a time \[s\], got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            slam.step(state, *args)
    with pytest.raises(DataError, match="expected depth in the first frame"):
        slam.step(state, rgb, 0 * depth, 0.0)
    state = slam.step(state, rgb, depth, 3.0)
    with pytest.raises(ValueError, match=r"expected a time \[s\] after 3, got 2.5"):
        slam.step(state, rgb, depth, 2.5)
    with pytest.raises(DataError, match="at least 2 frames, got 1"):
        slam.finish(state)
    with pytest.raises(DataError, match="imu='tight' needs inertial readings"):
        slam.step(slam.init(walk.camera, SlamConfig(imu="tight")), rgb, depth, 0.0)
    with pytest.raises(ValueError, match=r"T_body_cam to be a rigid transform \(4, 4\)"):
        slam.init(walk.camera, T_body_cam=2 * np.eye(4))
    with pytest.raises(ValueError, match="expected duration_s"):
        slam.init(walk.camera, SlamConfig(frame="intrinsic"))


def test_a_budget_too_small_for_the_first_frame_is_one_line(walk):
    state = slam.init(walk.camera, SlamConfig(voxel=0.05, map_budget_gb=1e-5))
    with pytest.raises(DataError, match=r"^map_budget_gb: expected 0\.0\d+ for the first frame, got 1e-05$"):
        slam.step(state, *walk.read(0), 0.0)


@pytest.mark.slow
def test_a_map_that_reaches_its_budget_goes_on_with_coarser_voxels(walk, tmp_path):
    whole = live(walk, SlamConfig(voxel=0.05), 0.0, T_world_cam=walk.T_world_cam[0])
    counts = [int(state.map.params.count) for state in whole[1:]]
    assert counts[-1] > counts[0] + 1
    config = SlamConfig(voxel=0.05, map_budget_gb=(counts[0] + 1) * 9**3 * 16 / 1e9)
    state = live(walk, config, 0.0, T_world_cam=walk.T_world_cam[0])[-1]
    at = int(np.flatnonzero(np.array(counts) > counts[0] + 1)[0])
    assert state.coarser_at.tolist() == [at] and state.grid.voxel == 0.1
    assert len(state.map.params.values) == counts[0] + 1
    T_world_cam = state.frames.T_world_body[-1] @ state.T_body_cam
    points = seen_points(walk.read(4), walk.camera, T_world_cam, step=4)
    at_points = jax.vmap(partial(sample_blocks, state.grid, state.map.params))
    distance = np.asarray(at_points(jnp.asarray(points, jnp.float32)))
    assert np.median(np.abs(distance[:, 0])) < 0.02 and np.mean(distance[:, 5] == 1) > 0.8
    checkpoint.save(tmp_path / "c.npz", state)
    kept = checkpoint.load(tmp_path / "c.npz", walk, config)
    assert kept.coarser_at.tolist() == [at] and kept.grid == state.grid
