"""A second session in the map of a first: one world, one map, also after a kill; elsewhere it is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose import slam
from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.types import select
from jaxpose.errors import DataError
from jaxpose.experiments.slam.map_file import read_map, write_map
from jaxpose.geometry.camera import unproject_numpy
from jaxpose.scenes.voxel_blocks import packed, sample_blocks
from jaxpose.slam import SlamConfig, checkpoint
from jaxpose.slam.loops.rebuild import rebuilt
from jaxpose.slam.map.texture import SIDE, Texture, painted_over
from jaxpose.slam.sessions import with_earlier

CONFIG = SlamConfig(voxel=0.05)
COUNT, FIRST = 18, 10  # frames of the walk; the second session begins two frames before the first one ends


@pytest.fixture(scope="module")
def walk():
    return room(RoomConfig(duration_s=(COUNT - 1) / 5, width=160, height=120, sensor="time_of_flight"))


@pytest.fixture(scope="module")
def sessions(walk):
    """Both halves, the second on a clock and with true poses of its own."""
    later = select(walk, np.arange(FIRST - 2, COUNT))
    turned = np.array([[0.0, -1, 0, 5], [1, 0, 0, -2], [0, 0, 1, 1], [0, 0, 0, 1]])
    return select(walk, np.arange(FIRST)), later._replace(
        t=later.t + 100, T_world_cam=turned @ later.T_world_cam
    )


@pytest.fixture(scope="module")
def file(sessions, tmp_path_factory):
    """What the first session has left."""
    path = tmp_path_factory.mktemp("first") / "map.npz"
    write_map(path, slam.saved_map(slam.run(sessions[0], CONFIG)))
    return path


@pytest.fixture(scope="module")
def second(sessions, file):
    return slam.run(sessions[1], CONFIG, state=slam.begin_in(read_map(file), sessions[1], CONFIG))


@pytest.mark.slow
def test_the_world_is_that_of_the_first_session(walk, second):
    """No alignment: the first session stood in the true world, the second says that it is elsewhere."""
    off = np.linalg.norm((second.T_world_cam - walk.T_world_cam[FIRST - 2 :])[:, :3, 3], axis=1)
    assert not second.frames.uncertain.any() and off[0] < 0.02 and off.max() < 0.04


@pytest.mark.slow
def test_the_map_holds_what_both_have_seen(sessions, file, second):
    """Along the rays of frames that only one session had: the surface is where its depth is."""
    camera = sessions[0].camera
    first, blocks = read_map(file), second.scene_params[0]
    count = len(packed(first.blocks)[0])
    assert len(second.earlier.coords) == count < len(packed(blocks)[0])
    np.testing.assert_array_equal(packed(blocks)[0][:count], packed(first.blocks)[0])
    distance = jax.jit(jax.vmap(lambda p: sample_blocks(second.map_config, blocks, p)))
    for recording, i, T_world_cam in (
        (sessions[0], 0, sessions[0].T_world_cam[0]),
        (sessions[1], -1, second.T_world_cam[-1]),
    ):
        frame = recording.read(np.arange(len(recording.t))[i])
        row, column = (x.ravel() for x in np.mgrid[10:110:7, 10:150:7])
        depth = frame.depth[row, column].astype(np.float64)
        ray = unproject_numpy(camera, np.stack([column, row], axis=-1))
        points = (ray * depth[:, None]) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
        value = np.asarray(distance(jnp.asarray(points[depth > 0], jnp.float32)))
        assert np.median(np.abs(value[:, 0])) < 0.02
        assert np.mean(value[:, 5] > 0.99) > 0.9  # measured there


@pytest.mark.slow
def test_a_third_session_finds_itself_by_what_the_first_has_seen(walk, sessions, second):
    """It begins where the second one never was, in the map that the second has left."""
    third = select(walk, np.arange(0, 4))
    state = slam.begin_in(slam.saved_map(second), third._replace(T_world_cam=None), CONFIG)
    off = np.linalg.norm((state.T_world_cam_first - walk.T_world_cam[0])[:3, 3])
    assert off < 0.04


@pytest.mark.slow
def test_a_map_made_anew_begins_with_that_of_the_first_session(sessions, file):
    first = read_map(file)
    before = np.array(packed(first.blocks)[1])
    state = slam.begin_in(first, sessions[1], CONFIG)
    state = rebuilt(state, np.zeros(0, int), sessions[1].read)
    np.testing.assert_array_equal(packed(state.map.params)[1], before)


@pytest.mark.slow
def test_a_killed_session_goes_on_in_the_same_map(sessions, file, second, tmp_path):
    class Killed(Exception):
        pass

    def kill(progress):
        if progress.index == 3:
            checkpoint.save(tmp_path / "checkpoint.npz", progress.state)
            raise Killed

    with pytest.raises(Killed):
        slam.run(sessions[1], CONFIG, kill, slam.begin_in(read_map(file), sessions[1], CONFIG))
    state = checkpoint.load(tmp_path / "checkpoint.npz", sessions[1], CONFIG)
    found = slam.run(sessions[1], CONFIG, state=with_earlier(state, read_map(file)))
    np.testing.assert_array_equal(found.T_world_cam, second.T_world_cam)
    for a, b in zip(jax.tree.leaves(found.scene_params), jax.tree.leaves(second.scene_params), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_what_shows_nothing_of_the_map_is_refused(sessions, file):
    first, elsewhere = read_map(file), room(RoomConfig(duration_s=1.0, width=160, height=120, seed=7))
    with pytest.raises(
        DataError, match="expected a first frame that shows what the map holds, .*nor do others"
    ):
        slam.begin_in(first, elsewhere, CONFIG)
    mixed = sessions[1]._replace(
        read=lambda i: elsewhere.read(0) if i < 4 else sessions[1].read(i), camera=sessions[1].camera
    )
    with pytest.raises(DataError, match=r"but the one (0.8|1.0)0 s later does: --start skips"):
        slam.begin_in(first, mixed, CONFIG)
    with pytest.raises(DataError, match="expected features and a fused map"):
        slam.begin_in(first, sessions[1], replace(CONFIG, features="none"))
    with pytest.raises(DataError, match="expected one with the features of its keyframes"):
        slam.begin_in(first._replace(features=()), sessions[1], CONFIG)


def test_what_is_painted_lies_over_what_was():
    tiles = lambda count: np.zeros((count, SIDE, SIDE, SIDE, 4), np.uint8)
    before, now = Texture(np.array([0, 1, 2, 0]), tiles(3)), Texture(np.array([0, 0, 1, 2, 0, 0]), tiles(3))
    before.tiles[1] = [10, 20, 30, 255]
    before.tiles[2, :9] = [40, 50, 60, 255]
    now.tiles[1, 5:] = [70, 80, 90, 255]
    now.tiles[2, 3] = [1, 2, 3, 255]
    found = painted_over(before, now)
    at = lambda row: found.tiles[found.slot[row]]
    np.testing.assert_array_equal(at(1), before.tiles[1])
    np.testing.assert_array_equal(at(2)[:5], before.tiles[2][:5])
    np.testing.assert_array_equal(at(2)[5:], now.tiles[1][5:])
    np.testing.assert_array_equal(at(3), now.tiles[2])
    assert found.slot[0] == found.slot[4] == found.slot[5] == 0 and not found.tiles[0].any()
    assert now.slot[1] == 0 and now.tiles.shape[0] == 3  # as they were


def test_options_that_do_not_go_with_an_earlier_map(tmp_path):
    from jaxpose.experiments.rgbd_slam import Config

    with pytest.raises(ValueError, match="--voxel: has no effect with --map, whose voxels are as they are"):
        Config(map=tmp_path, slam=SlamConfig(voxel=0.1))
    with pytest.raises(ValueError, match="--map: expected features and a fused map with it"):
        Config(map=tmp_path, slam=SlamConfig(features="none"))
