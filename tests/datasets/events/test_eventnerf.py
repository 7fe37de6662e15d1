"""EventNeRF's folders, made of the exact layout, and damaged ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.datasets.events import eventnerf
from jaxpose.errors import DataError

SIZE = (32, 24)
VIEWS = 12
K = np.diag([40.0, 41, 1, 1])
K[:2, 2] = [16.0, 12.0]


def orbit(n, turns=1.0):
    """Cameras on a circle around the origin that look at it, the last one step before the first."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    turn = Rotation.from_rotvec(np.outer(2 * np.pi * turns * np.arange(n) / n, [0, 1, 0]))
    poses[:, :3, :3] = turn.as_matrix()
    poses[:, :3, 3] = turn.apply([0, 0, -0.8])
    return poses


def write_views(split, poses, save, *, lens=None, images=True):
    intrinsics = K if lens is None else np.vstack([K, [*lens, 0, 0]])
    for i, T in enumerate(poses):
        for kind, matrix in (("pose", T), ("intrinsics", intrinsics)):
            (split / kind).mkdir(parents=True, exist_ok=True)
            # One line of numbers, or several: both are read.
            words = [f"{x:.9f}" for x in matrix.ravel()]
            (split / kind / f"r_{i:05d}.txt").write_text(" ".join(words) if i % 2 else "\n".join(words))
        if images:
            save(split / "rgb" / f"r_{i:05d}.png", np.full((SIZE[1], SIZE[0], 3), 10 * i, np.uint8))


def events_of(n=4000):
    g = np.random.default_rng(1)
    t = 2000 + np.sort(g.integers(0, 300_000, n))  # whole microseconds
    return {"t": t, "x": g.integers(0, 32, n), "y": g.integers(0, 24, n), "p": g.choice([-1, 1], n)}


@pytest.fixture
def scene(tmp_path, save):
    """A turntable of 12 views with distortion, and three test views."""
    scene = tmp_path / "lego"
    write_views(scene / "train", orbit(VIEWS), save, lens=(-0.2, 0.05))
    write_views(scene / "test", orbit(3), save)
    (scene / "train/events").mkdir()
    np.savez(scene / "train/events/lego.npz", **events_of())
    return scene


def test_a_made_scene_reads_back(scene):
    recording = eventnerf.load(scene)
    raw = events_of()
    np.testing.assert_allclose(recording.events.t, raw["t"] / 1e6, rtol=1e-12)
    np.testing.assert_array_equal(recording.events.x, raw["x"])
    np.testing.assert_array_equal(recording.events.y, raw["y"])
    np.testing.assert_array_equal(recording.events.polarity, raw["p"])
    # Their pixels are counted from the outer corner of the first.
    assert recording.camera == (40, 41, 15.5, 11.5, 32, 24, (-0.2, 0.05, 0, 0))
    assert recording.mosaic == "rggb" and recording.cyclic and recording.threshold is None
    np.testing.assert_allclose(recording.t, np.arange(VIEWS) / (VIEWS - 1) * raw["t"].max() / 1e6)
    np.testing.assert_allclose(recording.T_world_cam, orbit(VIEWS), atol=1e-8)
    assert recording.notes[0].startswith("timestamps read as microseconds: 4000 events in ")
    assert "evenly spaced in time; the last view is next to the first: taken as cyclic" in recording.notes[1]
    assert eventnerf.load(scene / "train", mosaic="mono").mosaic == "mono"


def test_views_of_another_split_are_held_out(scene, save):
    held = eventnerf.load(scene).held_out
    assert held.rgb.shape == (3, 24, 32, 3) and [int(image.mean()) for image in held.rgb] == [0, 10, 20]
    np.testing.assert_allclose(held.T_world_cam, orbit(3), atol=1e-8)
    assert held.files == ("rgb/r_00000.png", "rgb/r_00001.png", "rgb/r_00002.png")
    assert held.camera.distortion == ()
    assert held.near == pytest.approx(1e-4) and held.far == pytest.approx(1.8)
    (scene / "test").rename(scene / "validation")
    assert eventnerf.load(scene).notes[-1] == "3 views held out, of validation"
    (scene / "validation").rename(scene / "else")
    recording = eventnerf.load(scene)
    assert recording.held_out is None and recording.notes[-1].startswith("no images in a split test or valid")


def test_far_cameras_see_the_sphere_between_near_and_far(scene, save):
    far = orbit(3)
    far[:, :3, 3] *= 5  # 4 from the origin
    write_views(scene / "test", far, save)
    held = eventnerf.load(scene).held_out
    assert (held.near, held.far) == pytest.approx((3, 5))


@pytest.mark.parametrize(("turns", "cyclic"), [(1.0, True), (0.95, True), (0.5, False), (2.0, True)])
def test_a_track_that_closes_is_cyclic(scene, save, turns, cyclic):
    write_views(scene / "train", orbit(VIEWS, turns), save)
    assert eventnerf.load(scene).cyclic is cyclic


def test_few_views_or_none_that_move_are_not_cyclic(tmp_path, save):
    for name, poses in (("few", orbit(4)), ("still", np.tile(np.eye(4), (10, 1, 1)))):
        write_views(tmp_path / name / "train1", poses, save)
        (tmp_path / name / "train1/events").mkdir()
        np.savez(tmp_path / name / "train1/events/a.npz", **events_of())
        assert not eventnerf.load(tmp_path / name).cyclic


def test_without_images_the_sensor_is_assumed_aloud(scene):
    for file in (scene / "train/rgb").iterdir():
        file.unlink()
    recording = eventnerf.load(scene)
    assert recording.camera[4:6] == (346, 260)
    assert "no images in rgb: size of the sensor taken as 346x260" in recording.notes
    assert eventnerf.load(scene, size=(32, 24)).camera[4:6] == (32, 24)


def test_a_span_leaves_views_as_they_are(scene):
    whole, part = eventnerf.load(scene), eventnerf.load(scene, span=(0.1, 0.2))
    kept = (whole.events.t >= 0.1) & (whole.events.t < 0.2)
    np.testing.assert_array_equal(part.events.x, whole.events.x[kept])
    np.testing.assert_array_equal(part.t, whole.t)
    with pytest.raises(DataError, match="expected events, got none from 7 to 8 s"):
        eventnerf.load(scene, span=(7.0, 8.0))


def drop(path):
    return lambda scene: (scene / path).unlink()


def write(path, text):
    return lambda scene: (scene / path).write_text(text)


def spoil_all(scene):
    for file in (scene / "train/intrinsics").iterdir():
        file.write_text("1 " * 20)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (drop("train/intrinsics/r_00003.txt"), "intrinsics: expected 12 files, as many as poses, got 11"),
        (drop("train/rgb/r_00003.png"), "rgb: expected 12 files, as many as poses, got 11"),
        (drop("train/events/lego.npz"), "events: expected exactly one npz file, got an empty folder"),
        (write("train/events/b.npz", ""), "events: expected exactly one npz file, got b.npz, lego.npz"),
        (write("train/events/lego.npz", "no"), "lego.npz: expected a whole npz file, got "),
        (write("train/pose/r_00003.txt", "1 2 3"), "r_00003.txt: expected 16 finite numbers, got '1 2 3'"),
        (write("train/pose/r_00003.txt", "nan " * 16), "r_00003.txt: expected 16 finite numbers, got 'nan"),
        (write("train/pose/r_00003.txt", "2 " * 16), "r_00003.txt: expected a rotation"),
        (
            write("train/intrinsics/r_00003.txt", "1 " * 20),
            "expected the intrinsics of r_00000.txt, got others",
        ),
        (write("train/intrinsics/r_00000.txt", "1 " * 18), "expected 16 or 20 finite numbers, got '1 1"),
        (spoil_all, "r_00000.txt: expected fx 0 cx / 0 fy cy"),
    ],
)
def test_unusable_files_are_named(scene, spoil, message):
    spoil(scene)
    with pytest.raises(DataError, match=message) as error:
        eventnerf.load(scene)
    assert str(scene) in str(error.value) and "\n" not in str(error.value)


def test_a_folder_that_is_none_is_refused(scene):
    (scene / "train").rename(scene / "trained")
    with pytest.raises(
        DataError, match="expected intrinsics/.* or a folder train of them, got test, trained"
    ):
        eventnerf.load(scene)
