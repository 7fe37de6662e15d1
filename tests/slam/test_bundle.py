"""Keyframes adjusted together at the end: nearer to the truth, but not where colour is beside depth."""

import numpy as np
import pytest

from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.evaluation import trajectory_error
from jaxpose.evaluation.consistency import aligned_error, consistency, relative_error
from jaxpose.slam import SlamConfig
from jaxpose.slam.batch import final_trajectory
from jaxpose.slam.loops.bundle import adopt, propose
from jaxpose.slam.pipeline import track_all


def tracked(recording):
    return track_all(recording, SlamConfig(map_every_s=0.3))


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["stereo", "time_of_flight"])
def test_poses_are_nearer_to_the_truth_and_the_map_is_made_anew(sensor):
    walk = room(RoomConfig(duration_s=5.0, sensor=sensor, seed=1))
    state = tracked(walk)
    before, seen = state.frames, []
    assert before.keyframe.sum() > 10 and not before.lost.any()
    poses = lambda frames: frames.T_world_body @ state.T_body_cam
    error = lambda frames: trajectory_error.ate(poses(frames), walk.T_world_cam).rmse
    found = propose(state, walk.read, lambda done, total: seen.append((done, total)))
    assert found is not None and found.agrees and found.inflation == 1 and 0.9 < found.depths_apart < 1.05
    mapped = []
    after = adopt(state, found, walk.read, lambda done, total: mapped.append((done, total)))
    assert mapped == [(i + 1, len(mapped)) for i in range(before.mapped.sum())]
    moved = np.linalg.norm((poses(after.frames) - poses(before))[before.keyframe][:, :3, 3], axis=1)
    assert moved.max() == pytest.approx(found.moved_max, rel=1e-6)
    assert error(after.frames) < 0.6 * error(before)
    assert seen == [(i + 1, len(seen)) for i in range(3 * before.keyframe.sum())]
    np.testing.assert_allclose(after.frames.T_world_body[0], before.T_world_body[0], atol=1e-9)
    known = final_trajectory(after, None, found)
    assert known.covariances is not None
    errors = relative_error(
        (known.T_world_cam[:-5], known.T_world_cam[5:]), (walk.T_world_cam[:-5], walk.T_world_cam[5:])
    )
    first = np.searchsorted(known.covariances.t, walk.t[:-5] - walk.t[0] - 1e-6)
    squares = consistency(errors, known.covariances.second[first], independent=10)
    assert 1.5 < squares.nees < 8 and squares.inside_90 > 0.8  # moves of a second; 6 is right
    places = np.searchsorted(known.covariances.t, walk.t - walk.t[0] - 1e-6)
    of_poses = known.covariances.pose[np.minimum(places, len(known.covariances.t) - 1)]
    aligned = trajectory_error.align(
        trajectory_error.ate(known.T_world_cam, walk.T_world_cam).alignment, known.T_world_cam
    )
    squares = consistency(aligned_error(aligned, walk.T_world_cam, of_poses), of_poses, independent=10)
    assert 1.5 < squares.nees < 9 and squares.inside_90 > 0.8
    sigma = lambda frames: np.trace(frames.covariance[frames.keyframe][1:, :3, :3], axis1=1, axis2=2)
    assert np.median(sigma(after.frames)) < np.median(sigma(before))
    assert after.map is not None and int(after.map.params.count) > 100 and not len(after.pending)


@pytest.mark.slow
def test_nothing_is_changed_where_colour_is_beside_the_depth():
    """A colour camera a hand beside the depth camera, whose images nobody has registered."""
    walk = room(RoomConfig(duration_s=4.0, seed=2))

    def read(i):
        frame = walk.read(i)
        near = np.where(frame.depth > 0, 0.1 * walk.camera.fx / np.maximum(frame.depth, 0.3), 0)
        row, column = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
        column = np.clip(np.rint(column + near).astype(int), 0, frame.depth.shape[1] - 1)
        return frame._replace(rgb=frame.rgb[row, column])

    state = tracked(walk._replace(read=read))
    found = propose(state, read)
    assert found is not None and not found.agrees
    assert found.inflation > 4, "a contradiction, so that both are less sure than they say"
    known, inflated = (final_trajectory(state, None, by).covariances for by in (None, found))
    np.testing.assert_allclose(inflated.pose[0], found.inflation * known.pose[0], rtol=1e-6)
    assert (inflated.second[:, 0, 0] > 4 * known.second[:, 0, 0]).all()
    T, truth = (x[found.keyframes] for x in (state.frames.T_world_body @ state.T_body_cam, walk.T_world_cam))
    assert trajectory_error.ate(found.T_world_cam, truth).rmse > 2 * trajectory_error.ate(T, truth).rmse
    few = state.frames.put(np.arange(2, state.frames.count), keyframe=False)
    few = state._replace(frames=few, keyframe_features=state.keyframe_features[:2])
    assert propose(few, read) is None
