"""The ICL-NUIM loader on made folders of its TUM-compatible layout, on damaged ones, and on a real one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.datasets.rgbd import icl_nuim
from jaxpose.datasets.rgbd.registry import find_format, has_timestamps, load_recording
from jaxpose.errors import DataError

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
TRUTH = "livingRoom2.gt.freiburg"


def write_truth(file, numbers, T_world_cam):
    """The poses as published, in a world and a camera whose y points up."""
    rows = []
    for number, pose in zip(numbers, MIRROR @ T_world_cam @ MIRROR, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(f"{number} " + " ".join(f"{x:.12f}" for x in (*pose[:3, 3], *quaternion)))
    file.write_text("\n".join(rows) + "\n")


@pytest.fixture
def living_room(tmp_path, walk, save):
    """Frames 0 to 5, listed all, and true poses from 1 on, as in the published packages."""
    folder = tmp_path / "living_room_traj2_frei_png"
    for i in range(6):
        save(folder / f"rgb/{i}.png", walk.rgb[i])
        save(folder / f"depth/{i}.png", walk.counts[i])
    lines = [f"{i} depth/{i}.png {i} rgb/{i}.png" for i in range(6)]
    (folder / "associations.txt").write_text("\n".join(lines) + "\n")
    write_truth(folder / TRUTH, range(1, 6), walk.T_world_cam[1:])
    (folder / "camera-intrinsics.txt").write_text("30 0 15.5\n0 31 11.5\n0 0 1\n")
    return folder


def test_a_made_sequence_reads_back(living_room, walk, metres):
    recording = icl_nuim.load(living_room, rate_hz=20.0)
    assert recording.files == tuple(f"rgb/{i}.png" for i in range(6))
    assert recording.name.endswith("/living_room_traj2_frei_png") and recording.imu is None
    assert recording.camera == (30, 31, 15.5, 11.5, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.arange(6) / 20)
    assert np.isnan(recording.T_world_cam[0]).all()
    np.testing.assert_allclose(recording.T_world_cam[1:], walk.T_world_cam[1:], atol=1e-9)
    assert recording.notes == (f"1 frames without a usable pose (none in {TRUTH}): 0",)
    for i in range(6):
        rgb, depth = recording.read(i)
        np.testing.assert_array_equal(rgb, walk.rgb[i])
        np.testing.assert_allclose(depth, metres(walk.counts[i], 5000), rtol=1e-6)
        assert depth.dtype == np.float32 and depth[0, 0] == 0


def test_the_registry_gives_it_the_rate(living_room):
    assert find_format(living_room) == "icl_nuim" and not has_timestamps(living_room, "icl_nuim")
    np.testing.assert_allclose(load_recording(living_room, rate_hz=10.0).t, np.arange(6) / 10)
    np.testing.assert_allclose(load_recording(living_room).t, np.arange(6) / 30)


def test_colour_may_be_listed_first(living_room):
    expected = icl_nuim.load(living_room)
    lines = [f"{i} rgb/{i}.png {i} depth/{i}.png" for i in range(6)]
    (living_room / "associations.txt").write_text("# colour, depth\n" + "\n".join(lines))
    recording = icl_nuim.load(living_room)
    assert recording.files == expected.files
    for i in range(6):
        for got, wanted in zip(recording.read(i), expected.read(i), strict=True):
            np.testing.assert_array_equal(got, wanted)


def test_listed_images_that_are_not_there(living_room, walk):
    (living_room / "rgb/0.png").unlink()
    (living_room / "depth/3.png").unlink()
    recording = icl_nuim.load(living_room)
    np.testing.assert_allclose(recording.t, np.array([0, 1, 3, 4]) / 30)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam[[1, 2, 4, 5]], atol=1e-9)
    np.testing.assert_array_equal(recording.read(2).rgb, walk.rgb[4])
    assert recording.notes == ("2 of 6 listed frames skipped, without color or depth: 0, 3",)
    for file in living_room.glob("rgb/*"):
        file.unlink()
    with pytest.raises(DataError) as error:
        icl_nuim.load(living_room)
    assert str(error.value) == (
        f"{living_room}: expected images that associations.txt lists, "
        "got no frame with color and depth of 0, 1, 2, 3, 4, ..."
    )


def test_the_published_camera_is_for_the_published_size(living_room, save):
    (living_room / "camera-intrinsics.txt").unlink()
    recording = icl_nuim.load(living_room)
    assert recording.camera == (481.2, 480, 319.5, 239.5, 32, 24, ())
    assert recording.notes[0].endswith("which are for 640x480; the images are 32x24")
    for i in range(6):
        save(living_room / f"rgb/{i}.png", np.zeros((480, 640, 3), np.uint8))
        save(living_room / f"depth/{i}.png", np.full((480, 640), 5000, np.uint16))
    recording = icl_nuim.load(living_room)
    assert recording.camera == (481.2, 480, 319.5, 239.5, 640, 480, ()) and len(recording.notes) == 1
    (living_room.parent / "camera-intrinsics.txt").write_text("500 0 320\n0 500 240\n0 0 1\n")
    assert icl_nuim.load(living_room).camera == (500, 500, 320, 240, 640, 480, ())


def test_where_the_ground_truth_comes_from(living_room, walk):
    moved = walk.T_world_cam.copy()
    moved[:, 0, 3] += 1
    write_truth(living_room / "groundtruth.txt", range(6), moved)
    np.testing.assert_allclose(icl_nuim.load(living_room).T_world_cam, moved, atol=1e-9)
    (living_room / "groundtruth.txt").unlink()
    (living_room / "traj2.gt.freiburg").write_text("")
    with pytest.raises(
        DataError,
        match=r"groundtruth.txt or one \*.gt.freiburg, got 2 files, name one of them: living.*, traj2.*",
    ):
        icl_nuim.load(living_room)
    for file in living_room.glob("*.gt.freiburg"):
        file.unlink()
    recording = icl_nuim.load(living_room)
    assert recording.T_world_cam is None
    assert recording.notes == (
        "no groundtruth.txt or *.gt.freiburg: there is no ground truth to compare with",
    )


LINE = r"associations.txt:2: expected N depth/N.png N rgb/N.png \(or rgb before depth\)"


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("associations.txt", "# nothing\n", "associations.txt: expected lines of N depth/N.png.*, got none"),
        ("associations.txt", "# a\n1 depth/1.png 1\n", f"{LINE}.*, got '1 depth/1.png 1'"),
        ("associations.txt", "# a\none depth/1.png one rgb/1.png\n", f"{LINE}.*, got 'one depth"),
        ("associations.txt", "# a\n1 depth/1.png 2 rgb/1.png\n", f"{LINE} with the frame number N, got"),
        ("associations.txt", "# a\n13.1 rgb/13.1.png 13.2 depth/13.2.png\n", f"{LINE}.*, got '13.1 rgb"),
        ("associations.txt", "# a\n1 rgb/1.png 1 rgb/1.png\n", f"{LINE}.*, got '1 rgb"),
        ("associations.txt", "# a\n1 depth/1.png 1 depth/1.png\n", f"{LINE}.*, got '1 depth"),
        (
            "associations.txt",
            "2 depth/2.png 2 rgb/2.png\n2 depth/3.png 2 rgb/3.png\n",
            "associations.txt:2: expected a frame number after 2, got 2",
        ),
        (TRUTH, "1 2 3\n", rf"{TRUTH}:1: expected 8 numbers \(t tx ty tz qx qy qz qw\), got 3"),
        (TRUTH, "1 0 0 x 0 0 0 1\n", f"{TRUTH}:1: expected 8 numbers"),
        (TRUTH, "# a\n1 0 0 0 0 0 0 1\n1.5 0 0 0 0 0 0 1\n", f"{TRUTH}: expected frame numbers, got 1.5"),
        (TRUTH, "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", f"{TRUTH}:2: expected a timestamp"),
        ("camera-intrinsics.txt", "30 0 15\n0 -31 11\n0 0 1\n", "intrinsics.txt: expected fx 0 cx.*0 -31 11"),
        ("rgb/0.png", "text", "rgb/0.png: expected an image, got bytes of no kind"),
    ],
)
def test_unusable_files_are_named(living_room, file, content, message):
    (living_room / file).write_text(content)
    with pytest.raises(DataError, match=message) as error:
        icl_nuim.load(living_room)
    assert str(living_room) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "file, pixels, message",
    [
        ("depth/0.png", np.full((24, 32), 7, np.uint8), "expected depth in 1/5000 m, one channel of 16 bits"),
        ("depth/4.png", np.full((20, 32), 7, np.uint16), "expected 32x24, the size of 0.png, got 32x20"),
        ("rgb/2.png", np.zeros((24, 30, 3), np.uint8), "expected 32x24, the size of 0.png, got 30x24"),
    ],
)
def test_images_of_the_wrong_kind(living_room, save, file, pixels, message):
    save(living_room / file, pixels)
    with pytest.raises(DataError, match=f"{file}: {message}"):
        icl_nuim.load(living_room)


def test_wrong_folders_and_rates(living_room, tmp_path):
    (tmp_path / "empty").mkdir()
    for name, got in [("nowhere", "nothing"), ("empty", "an empty folder")]:
        with pytest.raises(
            DataError,
            match=f"{name}: expected a folder with associations.txt, depth/ and rgb/, got {got}",
        ):
            icl_nuim.load(tmp_path / name)
    with pytest.raises(ValueError, match="rate_hz: expected a positive rate, got 0"):
        icl_nuim.load(living_room, rate_hz=0.0)


# --- the real sequence --------------------------------------------------------------------------------------

PAIRS = [(i, i + apart) for apart in (10, 20, 40) for i in range(3, 49 - apart, 6)]  # rows of the recording


@pytest.fixture(scope="module")
def kt3(data_dir):
    return icl_nuim.load(data_dir / "icl_nuim_kt3")


def carried(recording, T_world_cam):
    """Frames carried into others by their depth: share of depth met within 1%, and error of colour [0, 255].

    Means over pairs; of points that land in the other image, the nearest pixel there.
    """
    camera = recording.camera
    v, u = np.mgrid[8:472:4, 8:632:4]
    read = {i: recording.read(i) for i in sorted({i for pair in PAIRS for i in pair})}
    grey = {i: frame.rgb.astype(float).mean(axis=2) for i, frame in read.items()}
    shares, errors = [], []
    for i, j in PAIRS:
        z = read[i].depth[v, u]
        point = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
        T = np.linalg.inv(T_world_cam[j]) @ T_world_cam[i]
        x, y, depth = np.moveaxis(point[z > 0] @ T[:3, :3].T + T[:3, 3], -1, 0)
        column = np.round(camera.fx * x / depth + camera.cx).astype(int)
        row = np.round(camera.fy * y / depth + camera.cy).astype(int)
        inside = (column >= 0) & (column < 640) & (row >= 0) & (row < 480)
        assert inside.mean() > 0.6
        column, row, depth = column[inside], row[inside], depth[inside]
        shares.append((np.abs(read[j].depth[row, column] - depth) < 0.01 * depth).mean())
        errors.append(np.abs(grey[j][row, column] - grey[i][v, u][z > 0][inside]).mean())
    return np.mean(shares), np.mean(errors)


@pytest.mark.data
def test_the_real_sequence(kt3):
    assert kt3.camera == (481.2, 480, 319.5, 239.5, 640, 480, ())
    np.testing.assert_allclose(kt3.t, np.arange(50) / 30)
    (note,) = kt3.notes
    assert note.startswith("1190 of 1240 listed frames skipped, without color or depth: 51, 52, ")
    np.testing.assert_allclose(kt3.T_world_cam[1, :3, 3], [-0.00126362, -0.00400925, -2.49997], atol=1e-12)


@pytest.mark.data
def test_real_poses_carry_images_onto_each_other(kt3):
    share, error = carried(kt3, kt3.T_world_cam)
    assert share > 0.75 and error < 3


@pytest.mark.data
@pytest.mark.parametrize(
    "convention",
    [
        lambda T: MIRROR @ T @ MIRROR,  # as published
        lambda T: T @ np.diag([1.0, -1.0, -1.0, 1.0]),  # OpenGL's axes
        lambda T: np.diag([-1.0, 1.0, 1.0, 1.0]) @ T @ np.diag([-1.0, 1.0, 1.0, 1.0]),  # the other mirror
        np.linalg.inv,  # world-to-camera
        lambda T: np.linalg.inv(MIRROR @ T @ MIRROR),
        lambda T: np.tile(np.eye(4), (len(T), 1, 1)),  # at rest
    ],
    ids=["published", "opengl", "mirrored-x", "inverse", "inverse-published", "rest"],
)
def test_no_other_convention_carries_real_images(kt3, convention):
    share, error = carried(kt3, convention(kt3.T_world_cam))
    assert share < 0.7 and error > 6


@pytest.mark.data
@pytest.mark.parametrize("shift", [-1, 1])
def test_a_pose_is_that_of_the_frame_of_its_number(kt3, shift):
    _, error = carried(kt3, np.roll(kt3.T_world_cam, shift, axis=0))
    assert error > 4


@pytest.mark.data
def test_real_gravity_is_across_the_floor(kt3):
    """The carpet in a corner of frame 45: its plane's normal, and that it is below the camera."""
    v, u = np.mgrid[435:475:2, 8:56:2]
    z = kt3.read(44).depth[v, u]
    camera, T = kt3.camera, kt3.T_world_cam[44]
    point = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)[z > 0]
    offset = point @ T[:3, :3].T
    normal = np.linalg.svd(offset - offset.mean(axis=0))[2][2]
    down = kt3.gravity_world / np.linalg.norm(kt3.gravity_world)
    assert abs(normal @ down) > 0.99 and 1.2 < offset.mean(axis=0) @ down < 1.8
