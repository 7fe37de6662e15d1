"""What is compiled while frames are tracked is not compiled again where it is needed."""

import threading
from functools import partial

import numpy as np
import pytest
from helpers import hand_held

from jaxpose import slam
from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera
from jaxpose.slam.ahead import end_compiled
from jaxpose.slam.batch import estimate_trajectory
from jaxpose.slam.map import backend
from jaxpose.slam.map.backend import map_backend, pool_size
from jaxpose.slam.types import TrackingStatus, no_frames

OWN = np.repeat([0.004, 0.003], 3)


def compiled_ahead():
    """Wait for what threads are compiling."""
    for thread in threading.enumerate():
        if thread.name == "compile ahead":
            thread.join()


def test_a_run_s_end_is_compiled_while_it_tracks(compiled):
    """By the recording alone, whatever frames are lost; not for a run without an IMU, nor after an error."""
    t = 1.7e9 + np.arange(30) / 4
    imu = hand_held.readings(8.0, 100.0, np.random.default_rng(0))
    recording = Recording(
        "", Camera(50.0, 50.0, 31.5, 23.5, 64, 48), t, lambda i: None, imu=imu._replace(t=imu.t + t[0])
    )
    config = slam.SlamConfig(imu="combined", estimate=("offset", "line-delay"))
    seen = []
    with end_compiled(recording, slam.SlamConfig(imu="none"), seen.append) as on_frame:
        on_frame(0)
        on_frame(1)
    with pytest.raises(DataError), end_compiled(recording, config, None) as on_frame:
        on_frame(0)
        raise DataError("the second frame")
    assert not {"linearise", "spread"} & compiled() and seen == [0, 1]
    with end_compiled(recording, config, seen.append) as on_frame:
        for i in range(2, 5):
            on_frame(i)
    assert {"linearise", "spread"} <= compiled() and seen == [0, 1, 2, 3, 4]
    poses, noise = hand_held.cameras(t - t[0], np.random.default_rng(1), np.eye(4), OWN[:3], OWN[3:])
    frames = no_frames(t)._replace(T_world_body=noise)
    frames = frames.put(np.arange(30), covariance=np.diag(OWN**2))
    frames = frames.put(np.array([9, 17, 18]), status=TrackingStatus.LOST)
    state = slam.init(recording.camera, config)._replace(frames=frames)
    posterior, _ = estimate_trajectory(state, recording.imu)
    assert posterior is not None and len(posterior.covariances().pose) > 100
    assert np.linalg.norm(posterior.pose(t - t[0])[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.02
    assert not compiled() & {"linearise", "_moved", "spread", "camera_rows", "_joint"}


def test_the_search_is_there_before_a_frame_is_in_doubt(compiled):
    recording = room(RoomConfig(duration_s=1.0, width=64, height=48))
    state = slam.init(recording.camera, slam.SlamConfig(imu="none", voxel=0.11, features="none"))
    state = slam.step(state, *recording.read(0), recording.t[0])
    compiled_ahead()
    assert "search" in compiled()
    assert not state.frames.lost[0]
    search = map_backend(state).relocalise
    assert search._cache_size() == 0
    slam.step(state, *recording.read(5), recording.t[1])  # at a speed that nothing has told
    assert search._cache_size() == 1, "it was searched for"
    assert not {"search", "update"} & compiled()


def test_no_frame_waits_for_a_larger_pool(compiled, monkeypatch):
    """What a pool needs that is half as large again is there when the first is full."""
    monkeypatch.setattr(backend, "empty_blocks", partial(backend.empty_blocks, capacity=210))
    recording = room(RoomConfig(duration_s=6.0, width=64, height=48))
    config = slam.SlamConfig(imu="none", voxel=0.11, features="none", map_every_s=0.0)
    state, sizes, at = slam.init(recording.camera, config), [], []
    for i, t in enumerate(recording.t):
        state = slam.step(state, *recording.read(i), t)
        sizes.append(pool_size(state)[1])
        compiled_ahead()
        at.append(compiled())
        if sizes[-1] == 472:
            break
    assert sorted({*sizes}) == [210, 315, 472]
    # The first growth passes three quarters of what it makes, too: the size after that is compiled there.
    assert "_enlarged" in at[-1] and not at[-1] & {"step", "update", "search"}
    assert [frame for frame in at[2:] if "step" in frame] == [frame for frame in at[2:] if "search" in frame]
    assert sum("step" in frame for frame in at[2:]) == 2
