"""Loops: drift, candidates, what is believed, frames that follow keyframes, a map made anew."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.evaluation import trajectory_error
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera
from jaxpose.scenes.voxel_blocks import BlockConfig, sample_blocks
from jaxpose.slam import SlamConfig, checkpoint, init
from jaxpose.slam.config import LoopConfig
from jaxpose.slam.keyframes import seen_shares
from jaxpose.slam.loops.closure import corrected, followed, is_same_place, poses_by_motions
from jaxpose.slam.loops.drift import drift_to_last, may_be_doubled
from jaxpose.slam.loops.rebuild import rebuilt, resumed
from jaxpose.slam.loops.refine import refined
from jaxpose.slam.loops.types import no_loops
from jaxpose.slam.loops.verify import Comparison, Verified, verify
from jaxpose.slam.map.backend import seen_points
from jaxpose.slam.pipeline import track_all
from jaxpose.slam.tracking.features import FeaturePose, detect, locate_camera
from jaxpose.slam.types import TrackingStatus, no_frames

CAMERA = Camera(50.0, 50.0, 39.5, 29.5, 80, 60)


def walked(count: int, sigma=(0.01, 0.002)):
    """A run along x by a tenth of a metre a frame, every frame a keyframe, each known to `sigma` [m, rad]."""
    frames = no_frames(np.arange(count) / 10)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = np.arange(count) / 10
    frames = frames._replace(
        T_world_body=T, T_odometry=T, keyframe=np.ones(count, bool), sigma=np.tile(sigma, (count, 1))
    )
    return init(CAMERA, T_world_cam=np.eye(4))._replace(frames=frames, grid=BlockConfig(0.02, 0.06))


def test_drift_adds_up_with_the_lever_of_what_was_turned():
    state, chosen = walked(11), np.arange(11)
    found = drift_to_last(state, chosen)
    for k in range(11):
        steps = [0.1 * (0.01**2 + 0.002**2 * (0.1 * (10 - j)) ** 2) for j in range(k, 10)]
        assert found.translation[k] == pytest.approx(np.sqrt(sum(steps)), abs=1e-5)
        assert found.rotation[k] == pytest.approx(np.sqrt((10 - k) * 0.1) * 0.002, abs=1e-5)
    doubled = may_be_doubled(state, chosen, found, depth=3.0)
    off = np.hypot(found.translation, 3 * found.rotation)
    assert not doubled.any() and off.max() > 0.01
    state = state._replace(grid=BlockConfig(0.01, 0.03))
    assert (may_be_doubled(state, chosen, found, depth=3.0) == (off > 0.01)).all()


def test_a_loss_on_the_way_leaves_what_a_search_may_be_off_by():
    state = walked(11)
    status = np.where(np.arange(11) == 5, TrackingStatus.LOST, TrackingStatus.TRACKED)
    keyframe = np.arange(11) != 5
    state = state._replace(frames=state.frames._replace(status=status.astype(np.int8), keyframe=keyframe))
    found = drift_to_last(state, np.flatnonzero(keyframe))
    assert found.translation[5] < 0.01 < 0.04 <= found.translation[4]


def test_a_settled_loop_takes_drift_away():
    state, chosen = walked(101), np.arange(101)
    loops = no_loops().appended(0, 99, rigid.inverse(np.eye(4)), 1e6 * np.eye(6))
    before = drift_to_last(state._replace(loops=loops), chosen)
    after = drift_to_last(state._replace(loops=loops, settled=99), chosen)
    assert before.translation[0] > 0.03 and after.translation[0] < 0.015
    assert after.translation[10] < before.translation[10]
    doubtful = loops._replace(believed=np.array([False]))
    unheard = drift_to_last(state._replace(loops=doubtful, settled=99), chosen)
    np.testing.assert_array_equal(unheard.translation, before.translation)


def test_frames_follow_the_keyframes_around_them():
    state, keyframes = walked(11), np.array([2, 6])
    moved = np.stack([np.eye(4), rigid.exp(np.array([0.0, 0.3, 0, 0, 0, 0.4]))])
    found = followed(state.frames, keyframes, moved).T_world_body
    before = state.frames.T_world_body
    np.testing.assert_allclose(found[:3], before[:3], atol=1e-12)
    np.testing.assert_allclose(found[6:], moved[1] @ before[6:], atol=1e-12)
    turns = Slerp([2, 6], Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.4]]))
    for k in (3, 4, 5):
        angle = Rotation.from_matrix(found[k, :3, :3]).inv() * turns(k)
        assert angle.magnitude() < 1e-9
    assert (np.diff(found[2:7, 1, 3]) > 0).all()


@pytest.mark.parametrize(("jump", "believed"), [(0.001, True), (0.05, False)])
def test_a_camera_that_jumps_is_where_motions_lead(jump, believed):
    """One motion of 3 mm, one sigma, differs from the poses by less, or by far more than that."""
    state = walked(11)
    T = state.frames.T_world_body.copy()
    T[7:, 1, 3] += jump
    state = state._replace(frames=state.frames._replace(T_world_body=T), settled=4)
    found = poses_by_motions(state)
    np.testing.assert_allclose(found, T if believed else state.frames.T_odometry, atol=1e-12)
    np.testing.assert_array_equal(poses_by_motions(state._replace(settled=8)), T)  # that was before


def test_a_wall_hides_what_is_behind_it():
    ahead = np.array([[0.0, 0.0, 3.0], [0.5, 0.2, 3.0], [0.0, 0.0, -3.0]])
    poses, depth = np.tile(np.eye(4), (2, 1, 1)), np.full((2, 12, 16), 3.0)
    depth[1] = 2.0
    np.testing.assert_allclose(seen_shares(ahead, poses, depth, CAMERA), [2 / 3, 0])
    half = np.where(np.arange(16) < 8, 2.0, 4.0) * np.ones((1, 12, 1))
    np.testing.assert_allclose(seen_shares(ahead[1:2], poses[:1], half, CAMERA), [1])
    np.testing.assert_allclose(seen_shares(ahead[1:2] * [-1, 1, 1], poses[:1], half, CAMERA), [0])


GOOD = Comparison(np.eye(4), 1e5 * np.eye(6), *(np.array(x) for x in (0.6, 0.95, 0.01, 0.95)))


def test_what_is_in_any_doubt_is_no_loop():
    def believed(information=1e5, beside=0.0, **changes):
        compared = GOOD._replace(**{name: np.array(x) for name, x in changes.items()})
        seen = FeaturePose(rigid.make(np.eye(3), np.array([beside, 0, 0])), 1e-5 / 30 * np.eye(6), 50)
        return is_same_place(Verified(np.eye(4), information * np.eye(6), seen, compared), LoopConfig())

    assert believed()
    for doubt in ({"overlap": 0.1}, {"agreement": 0.5}, {"conflict": 0.2}, {"colour": 0.3}):
        assert not believed(**doubt)
    assert not believed(information=1e3)  # 3 cm
    assert believed(beside=0.010) and not believed(beside=0.016)  # 3.2 and 5 sigmas from what features said


@pytest.fixture(scope="module")
def again():
    """A walk one and a half times around the room, tracked without loops."""
    recording = room(RoomConfig(duration_s=9.0, speed=2.0, rate_hz=8.0, width=160, height=120))
    return recording, track_all(recording, SlamConfig(loops=False, voxel=0.04))


def own_map(state):
    """The state with a copy of its map, which may be written over."""
    return state._replace(map=jax.tree.map(jnp.copy, state.map))


def pairs(recording, first: int, last: int):
    """Frames and what features say of the second's pose in axes of the first."""
    frames = recording.read(first), recording.read(last)
    features = [detect(frame, recording.camera) for frame in frames]
    return frames, locate_camera(features[1], [(features[0], np.eye(4))], recording.camera)


@pytest.mark.slow
def test_the_same_place_is_known_and_another_is_not(again):
    recording, _ = again
    lap = round(12.5 / 2 * 8)
    for first in (0, 5, 10):
        frames, seen = pairs(recording, first, first + lap)
        assert seen is not None
        found = verify(*frames, seen, recording.camera)
        T = recording.T_world_cam[[first, first + lap]]
        off = rigid.log(rigid.inverse(rigid.inverse(T[0]) @ T[1]) @ found.T_a_b)
        assert is_same_place(found, LoopConfig())
        assert np.linalg.norm(off[:3]) < 0.015 and np.linalg.norm(off[3:]) < np.radians(0.3)
        assert off @ found.information @ off < 22.46
        frames, _ = pairs(recording, first, first + lap // 2)  # across the room
        wrong = FeaturePose(np.eye(4), 1e-5 * np.eye(6), 50)
        assert not is_same_place(verify(*frames, wrong, recording.camera), LoopConfig())


@pytest.mark.slow
def test_loops_straighten_a_bent_run_and_its_map(again, tmp_path):
    """Poses of a good run bent by 20 cm and 3 degrees over its way; two loops know nothing of that."""
    recording, state = again
    frames, count = state.frames, state.frames.count
    bend = rigid.exp(np.linspace(0, 1, count)[:, None] * np.array([0.15, -0.1, 0.08, 0.03, -0.02, 0.04]))
    bent = frames._replace(T_world_body=bend @ frames.T_world_body, T_odometry=bend @ frames.T_world_body)
    state = state._replace(frames=bent)
    keyframes, lap, loops = np.flatnonzero(frames.keyframe), 12.5 / 2, state.loops
    state = rebuilt(own_map(state), keyframes, recording.read)
    for b in keyframes[recording.t[keyframes] > lap + 0.2][::4]:
        a = int(keyframes[np.argmin(np.abs(recording.t[keyframes] - recording.t[b] + lap))])
        images, seen = pairs(recording, a, int(b))
        if seen is not None and is_same_place(found := verify(*images, seen, recording.camera), LoopConfig()):
            loops = loops.appended(a, int(b), found.T_a_b, found.information)
    assert len(loops.a) >= 2

    def off(state):
        T = state.frames.T_world_body @ recording.T_body_cam
        chosen = keyframes[:: len(keyframes) // 4].tolist()
        points = [seen_points(recording.read(i), recording.camera, T[i]) for i in chosen]
        at = jax.vmap(partial(sample_blocks, state.grid, state.map.params))
        distance = at(jnp.asarray(np.concatenate(points), jnp.float32))[:, 0]
        return trajectory_error.ate(T, recording.T_world_cam).rmse, np.median(np.abs(distance))

    ate_bent, _ = off(state)
    begun = corrected(state._replace(loops=loops), None, recording.read)
    assert len(begun.pending) == len(keyframes) - 12  # made anew while the run goes on
    fixed = resumed(begun, recording.read)
    assert not len(fixed.pending)
    ate, wall = off(fixed)
    assert ate_bent > 0.05 and ate < 0.02 and ate < ate_bent / 4
    assert wall < 0.01
    assert fixed.settled == count - 1 and fixed.loops.believed.all()
    checkpoint.save(tmp_path / "checkpoint.npz", fixed)
    kept = checkpoint.load(tmp_path / "checkpoint.npz", recording, fixed.config)
    for part in ("frames", "loops", "map", "settled"):
        jax.tree.map(np.testing.assert_array_equal, getattr(kept, part), getattr(fixed, part))


@pytest.mark.slow
def test_frames_in_doubt_are_found_between_their_neighbours_at_the_end(again):
    recording, state = again
    frames, count = state.frames, state.frames.count
    doubted = np.array([20, 21, 22, count - 1])
    T, status = frames.T_world_body.copy(), frames.status.copy()
    T[doubted, :3, 3] += [0.2, -0.2, 0.1]
    status[doubted] = TrackingStatus.APPEARANCE_OUTLIER
    off = np.random.default_rng(0).normal(size=(count, 6)) * ([0.004] * 3 + [0.001] * 3)
    T[1:] = T[1:] @ rigid.exp(off[1:])
    moved = own_map(state)._replace(frames=frames._replace(T_world_body=T, status=status.astype(np.int8)))
    error = lambda T: np.linalg.norm((T @ recording.T_body_cam - recording.T_world_cam)[:, :3, 3], axis=1)
    motions = lambda T: rigid.inverse(T[:-1]) @ T[1:]
    true = motions(recording.T_world_cam)
    off = lambda T: np.median(np.abs(rigid.log(rigid.inverse(true) @ motions(T @ recording.T_body_cam))))
    few = refined(moved, recording.read).frames
    whole = refined(moved._replace(config=replace(state.config, refine="all")), recording.read).frames
    for found in (few, whole):
        assert (found.status[doubted[:-1]] <= TrackingStatus.WEAK).all()
        assert error(found.T_world_body)[20:23].max() < 0.03
        np.testing.assert_array_equal(found.T_world_body[-1], T[-1])  # there is no frame after it
        assert found.status[-1] == TrackingStatus.APPEARANCE_OUTLIER
    rest = ~np.isin(np.arange(count), doubted)
    np.testing.assert_array_equal(few.T_world_body[rest], T[rest])
    assert off(whole.T_world_body) < 0.5 * off(T)
    np.testing.assert_array_equal(moved.frames.T_world_body, T)
