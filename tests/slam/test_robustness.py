"""Losses: the wide search in a closed-form room, lost frames, blackouts; and what a run keeps in memory."""

import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.box import box_pixels, inside_of_a_box

from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.types import Frame, Recording, select
from jaxpose.evaluation import trajectory_error
from jaxpose.geometry import rigid, se3
from jaxpose.geometry.camera import Camera
from jaxpose.slam import RecoveryConfig, SlamConfig, init, run, tracker
from jaxpose.slam.keyframes import thumbnail
from jaxpose.slam.observation import to_device
from jaxpose.slam.tracker import _is_appearance_outlier, _looks_better, _usual
from jaxpose.slam.tracking.features import FeaturePose, Features
from jaxpose.slam.tracking.register import Tracked
from jaxpose.slam.tracking.relocalise import CENTRES, relocalise
from jaxpose.slam.types import Frames, TrackingStatus, no_frames

BAND, POLICY = 0.3, RecoveryConfig()


def truncated_box(point):
    """The box as a map knows it: distances up to a band."""
    near = inside_of_a_box(point)
    return near._replace(valid=(jnp.abs(near.distance) < BAND).astype(near.distance.dtype))


def off(T, ground_truth):
    """Distances [m, rad] of two poses."""
    xi = np.asarray(se3.log(se3.compose(se3.inverse(jnp.asarray(T)), jnp.asarray(ground_truth, jnp.float32))))
    return np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])


@pytest.fixture(scope="module")
def find():
    return jax.jit(lambda T, s, pixels, key: relocalise(truncated_box, T, s, pixels, key))


@pytest.mark.parametrize("seed", range(3))
def test_a_search_finds_a_camera_that_prediction_missed(find, seed):
    ground_truth = np.asarray(se3.exp(jnp.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1])))
    start = se3.compose(jnp.asarray(ground_truth), se3.exp(jnp.array([0.2, -0.15, 0.1, 0.15, -0.1, 0.2])))
    centres = jnp.tile(start[None], (CENTRES, 1, 1))
    found = find(centres, jnp.array([0.25, 0.25]), box_pixels(ground_truth, 400), jax.random.key(seed))
    metres, radians = off(found, ground_truth)
    assert off(start, ground_truth)[0] > 0.25 and metres < 0.2 and radians < 0.1  # near enough to be aligned


def test_a_search_begins_at_every_centre(find):
    ground_truth = np.asarray(se3.exp(jnp.array([0.5, -0.2, 0.3, 0.2, 1.0, -0.1])))
    away = [se3.exp(jnp.array([0.1 * k, 0.0, 0.0, 0.0, -0.05 * k, 0.0])) for k in range(CENTRES - 1)]
    near = se3.compose(jnp.asarray(ground_truth), se3.exp(jnp.array([0.05, -0.05, 0.1, 0.05, -0.1, 0.02])))
    found = find(
        jnp.stack([*away, near]), jnp.array([0.2, 0.2]), box_pixels(ground_truth, 400), jax.random.key(1)
    )
    metres, radians = off(found, ground_truth)
    assert metres < 0.08 and radians < 0.05


def test_lost_frames_lead_to_where_the_camera_is_found():
    frames = no_frames(np.array([0.0, 1.0, 2.0, 4.0])).put(np.arange(4), T_world_body=np.eye(4))
    correction = np.asarray(se3.exp(jnp.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.8])), np.float64)
    frames = frames.put(np.array([1, 2]), status=int(TrackingStatus.LOST))
    bent = frames.corrected(correction)
    np.testing.assert_array_equal(bent.T_world_body[[0, 3]], np.tile(np.eye(4), (2, 1, 1)))
    for i, share in ((1, 0.25), (2, 0.5)):
        expected = np.asarray(se3.exp(share * jnp.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.8])))
        np.testing.assert_allclose(bent.T_world_body[i], expected, atol=1e-6)
    assert np.all(frames.T_world_body == np.eye(4))  # what was given is as it was


def test_of_two_poses_that_fit_the_surfaces_colour_decides():
    found = Tracked(
        np.eye(4), None, 1.0, 1.0, colour_error=0.1, exposure=np.ones(3), valid=0.9, iterations=5, sigma=0.0,
        covariance=np.eye(6), information=np.zeros((6, 6)), line_delay=np.zeros(2),
    )  # fmt: skip
    better = found._replace(colour_error=0.03)
    assert _looks_better(POLICY, better, found) and not _looks_better(POLICY, found, better)
    assert not _looks_better(POLICY, found._replace(colour_error=0.099), found)  # no matter
    assert not _looks_better(
        POLICY, better._replace(valid=0.3), found
    )  # little in view, which may fit by chance
    assert not _looks_better(POLICY, better._replace(loss=2.0), found)  # the surfaces go first


def test_what_is_usual_is_that_of_the_last_frames_found():
    loss, lost = np.arange(50.0), np.isin(np.arange(50), range(40, 45))
    loss[0], loss[lost] = np.nan, 1e3  # the first frame is not tracked
    usual = lambda i: _usual(loss[:i], lost[:i])
    assert usual(1) == np.inf and usual(2) == 1 and usual(31) == 15.5
    assert usual(46) == np.median([*range(11, 40), 45])


def test_colours_of_another_place_are_doubted_until_they_must_be_another_light():
    def is_outlier(frames, i, colour_error):
        return _is_appearance_outlier(POLICY, Frames(*(x[: i + 1] for x in frames)), colour_error)

    frames = no_frames(np.arange(20) / 4).put(np.arange(1, 5), colour_error=0.01)
    assert not is_outlier(frames, 1, 0.5)  # nothing is usual yet
    assert not is_outlier(frames, 5, 0.024) and is_outlier(frames, 5, 0.026)
    frames = frames.put(np.arange(5, 12), colour_error=0.1, status=TrackingStatus.APPEARANCE_OUTLIER)
    assert is_outlier(frames, 11, 0.1) and not is_outlier(frames, 12, 0.1)  # 2 s after frame 4
    frames = frames.put(12, colour_error=0.1)
    assert not is_outlier(frames, 13, 0.2) and is_outlier(frames, 13, 0.26)
    clean = no_frames(np.arange(20) / 4).put(np.arange(1, 5), colour_error=0.001)
    assert not is_outlier(clean, 5, 0.019) and is_outlier(clean, 5, 0.021)


@pytest.mark.parametrize(("colour_there", "found_m"), [(0.01, 0.0), (0.05, 2.0)])
def test_features_of_another_place_are_given_up_where_colours_speak_against_them(
    monkeypatch, colour_there, found_m
):
    """Features say 2 m off, where surfaces fit and colours do not; with another light they fit nowhere."""
    frames = no_frames(np.arange(7) / 10).put(
        np.arange(6), T_world_body=np.eye(4), colour_error=0.01, loss=0.5
    )
    state = init(Camera(50.0, 50.0, 39.5, 29.5, 80, 60), T_world_cam=np.eye(4))._replace(frames=frames)
    off = rigid.make(np.eye(3), np.array([2.0, 0, 0]))

    def track(state, frames, predicted, *others):
        T = predicted.T_ref_body[-1]
        colour = 0.05 if np.linalg.norm(T[:3, 3]) > 1 else colour_there
        few = {"valid": 0.9, "iterations": 5, "sigma": np.zeros(2), "exposure": np.ones(3)}
        unknown = {"covariance": np.eye(6), "information": np.eye(6), "line_delay": np.zeros(2)}
        return Tracked(T, None, 0.5, 0.01, colour_error=colour, **few, **unknown)

    monkeypatch.setattr(tracker, "seen_pose", lambda *_: FeaturePose(off, 1e-5 * np.eye(6), 50))
    monkeypatch.setattr(tracker, "_track", track)
    rng = np.random.default_rng(0)
    frame = Frame(rng.integers(0, 255, (60, 80, 3)).astype(np.uint8), np.ones((60, 80), np.float32))
    by_motion = tracker.expected_motion(state)
    nothing = Features(np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros((0, 32), np.uint8))
    seen = frame, to_device(frame), nothing
    found = tracker.next_pose(state, by_motion, *seen, rng, jax.random.key(0)).frames
    assert np.linalg.norm(found.T_world_body[-1, :3, 3]) == pytest.approx(found_m, abs=1e-3)
    assert found.status[-1] == TrackingStatus.TRACKED  # features that know where they are hold the frame


def test_a_frame_looks_like_itself_in_another_light():
    rng = np.random.default_rng(0)
    coarse = rng.uniform(20, 120, (12, 16))
    rgb = np.repeat(np.kron(coarse, np.ones((5, 5)))[..., None], 3, axis=-1)
    frame = Frame(rgb.astype(np.uint8), np.kron(rng.uniform(1, 3, (12, 16)), np.ones((5, 5))))
    brighter = frame._replace(rgb=(2 * rgb).astype(np.uint8))
    other = Frame(frame.rgb[::-1], frame.depth[:, ::-1])
    difference = lambda a, b: np.mean((thumbnail(a) - thumbnail(b)) ** 2)
    assert difference(frame, brighter) < 0.01 < 1 < difference(frame, other)
    assert np.isfinite(thumbnail(Frame(0 * frame.rgb, 0 * frame.depth))).all()


@pytest.fixture(scope="module")
def walk() -> Recording:
    return room(RoomConfig(duration_s=5.0, width=80, height=60))


def blacked_out(recording: Recording, dark: range) -> Recording:
    """The recording with frames that hold nothing."""

    def read(i):
        frame = recording.read(i)
        return Frame(0 * frame.rgb, 0 * frame.depth) if i in dark else frame

    return recording._replace(read=read)


@pytest.mark.slow
def test_a_camera_that_comes_back_is_recognised_without_an_imu(walk):
    """2 s of darkness, in which it has gone where it was 1.6 s before."""
    indices = np.concatenate([np.arange(12), np.arange(12, 22), np.arange(4, 12)])
    back = select(walk, indices)._replace(t=np.arange(len(indices)) / 5, imu=None)
    result = run(blacked_out(back, range(12, 22)))
    assert (
        result.frames.lost[12:22].all()
        and not result.frames.lost[:12].any()
        and not result.frames.lost[22:].any()
    )
    assert (
        not result.frames.mapped[12:23].any() and result.frames.mapped[24:].any()
    )  # the first found is not mapped yet
    assert result.frames.uncertain[12:22].all()
    ground_truth = back.T_world_cam
    assert ground_truth is not None
    error = np.linalg.norm(result.T_world_cam[23:, :3, 3] - ground_truth[23:, :3, 3], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.05  # without alignment: in the world of before


@pytest.mark.slow
def test_an_imu_bridges_two_seconds_of_darkness(walk):
    result = run(blacked_out(walk, range(10, 20)), SlamConfig(imu="combined"))
    assert result.frames.lost[10:20].all() and not result.frames.lost[21:].any()
    assert result.frames.uncertain[10:20].all() and result.frames.mapped[20:].any()
    ground_truth = walk.T_world_cam
    assert ground_truth is not None
    error = np.linalg.norm(result.T_world_cam[:, :3, 3] - ground_truth[:, :3, 3], axis=1)
    assert error.max() < 0.06 and trajectory_error.ate(result.T_world_cam, ground_truth).rmse < 0.03


@pytest.mark.slow
def test_a_gyroscope_s_bias_is_found_where_features_know_the_motion_too():
    recording, bias = room(RoomConfig(duration_s=2.0, width=160, height=120)), np.array([0.05, -0.08, 0.06])
    assert recording.imu is not None
    imu = recording.imu._replace(omega_body=recording.imu.omega_body + bias)
    seen = []
    run(
        recording._replace(imu=imu),
        SlamConfig(imu="combined"),
        lambda p: seen.append(p.state.motion.gyro_bias),
    )
    assert np.abs(seen[-1] - bias).max() < 0.01 < 0.04 < np.abs(seen[0] - bias).max()


@pytest.mark.slow
def test_without_true_poses_the_readings_find_their_gravity(walk):
    ground_truth = walk.T_world_cam
    assert ground_truth is not None
    result = run(walk._replace(T_world_cam=None), SlamConfig(imu="combined"))
    assert not result.frames.lost.any() and trajectory_error.ate(result.T_world_cam, ground_truth).rmse < 0.02
    up = (result.T_world_cam @ np.linalg.inv(ground_truth))[:, :3, 2]
    assert (np.rad2deg(np.arccos(up[:, 2])) < 3).all()


def holes(frame, rng):
    return frame._replace(depth=np.where(rng.uniform(size=frame.depth.shape) < 0.7, 0, frame.depth))


def large_holes(frame, rng):
    """Without depth in 70% of the image, in one piece."""
    depth = frame.depth.copy()
    depth[:, : int(0.7 * depth.shape[1])] = 0
    return frame._replace(depth=depth)


def sometimes(change):
    return lambda frame, rng: change(frame) if rng.uniform() < 0.2 else frame


FAULTS = {
    "70% of the pixels without depth": (holes, "none"),
    "70% of the image without depth": (large_holes, "combined"),
    "black at times": (sometimes(lambda frame: frame._replace(rgb=0 * frame.rgb)), "none"),
    "saturated at times": (
        sometimes(lambda frame: frame._replace(rgb=0 * frame.rgb + np.uint8(255))),
        "combined",
    ),
    "nothing at times": (sometimes(lambda frame: Frame(0 * frame.rgb, 0 * frame.depth)), "combined"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "imu"), FAULTS.values(), ids=FAULTS.keys())
def test_bad_frames_are_survived(walk, fault, imu):
    def read(i):
        return walk.read(i) if i == 0 else fault(walk.read(i), np.random.default_rng(i))

    result = run(walk._replace(read=read), SlamConfig(imu=imu))
    empty = [i for i in range(len(walk.t)) if not read(i).depth.any()]
    assert set(np.flatnonzero(result.frames.lost)) <= set(empty) and result.frames.uncertain[empty].all()
    assert trajectory_error.ate(result.T_world_cam, walk.T_world_cam).rmse < 0.03


@pytest.mark.slow
def test_a_lamp_that_goes_out_is_survived(walk):
    """Darker than an exposure may be: in doubt for a while, then mapped as it is seen."""

    def read(i):
        frame = walk.read(i)
        return frame._replace(rgb=frame.rgb // 10) if i >= 10 else frame

    result = run(walk._replace(read=read))
    assert (
        not result.frames.lost.any()
        and trajectory_error.ate(result.T_world_cam, walk.T_world_cam).rmse < 0.03
    )
    assert (
        result.frames.uncertain[10]
        and not result.frames.uncertain[:10].any()
        and not result.frames.uncertain[20:].any()
    )
    assert not result.frames.mapped[result.frames.uncertain].any() and result.frames.mapped[20:].any()


@pytest.mark.slow
def test_dropped_frames_are_survived(walk):
    kept = np.flatnonzero(np.random.default_rng(1).uniform(size=len(walk.t)) > 0.3)
    some = select(walk, np.union1d([0], kept))
    result = run(some, SlamConfig(imu="combined"))
    assert (
        not result.frames.lost.any()
        and trajectory_error.ate(result.T_world_cam, some.T_world_cam).rmse < 0.02
    )


@pytest.mark.slow
@pytest.mark.parametrize("exposed", [1.0, 0.6])
def test_a_camera_before_a_floor_of_planks_does_not_settle_a_plank_away(exposed):
    """One plane and nothing but colour to hold on to, which pulls from half a plank; images may darken."""
    camera = Camera(146.0, 146.0, 79.5, 59.5, 160, 120)
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = [0, 0.09, 0.18, 0.1, 0.02, 0.11], [0, 0.0, 0.03, 0.06, 0.02, -0.02]
    stain = np.random.default_rng(0).uniform(0.2, 0.6, 100)

    def read(i):
        row, column = np.mgrid[:120, :160]
        x, y = (2 * (column - 79.5) / 146 + T[i, 0, 3], 2 * (row - 59.5) / 146 + T[i, 1, 3])
        plank = np.floor(x / 0.08).astype(int) + 50
        grain = 0.1 * np.sin(2 * np.pi * y / 0.3 + plank) + 0.1 * np.sin(5 * y + 3 * plank)
        grey = 255 * (stain[plank] + grain) * (exposed if i else 1)
        noise = np.random.default_rng(i).normal(size=grey.shape)
        return Frame(
            np.repeat(grey[..., None], 3, -1).astype(np.uint8), (2 + 0.006 * noise).astype(np.float32)
        )

    result = run(Recording("planks", camera, np.arange(6) / 5, read, T), SlamConfig(voxel=0.03))
    assert not result.frames.lost.any()
    assert np.linalg.norm(result.T_world_cam[:, :3, 3] - T[:, :3, 3], axis=1).max() < 0.02


@pytest.mark.slow
def test_no_image_is_kept_in_memory():
    """However long a recording is: keyframes are read again when they are needed."""
    source = room(RoomConfig(duration_s=5.0, width=80, height=60))
    alive, most = [], []

    def read(i):
        frame = source.read(i)
        frame = Frame(frame.rgb.copy(), frame.depth.copy())
        alive.extend(weakref.ref(array) for array in frame)
        return frame

    run(source._replace(read=read), on_frame=lambda _: most.append(sum(r() is not None for r in alive)))
    assert len(most) == len(source.t)
    assert max(most) <= 4  # the arrays of two frames: the last one, and one that is on its way out
