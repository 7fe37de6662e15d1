"""Recordings of phones in the layouts of their apps, written here, read back."""

import struct
import zipfile

import numpy as np
import pytest
from helpers import phones

from jaxpose.datasets.rgbd import arkitscenes, polycam, record3d, stray_scanner
from jaxpose.datasets.rgbd.registry import find_format, load_recording
from jaxpose.errors import DataError
from jaxpose.geometry import rigid


def expected_depth(walk, k):
    counts = np.where(walk.counts[k] == 65535, 0, walk.counts[k])
    return np.where(phones.confidence(k) > 0, counts / 1000, 0)


def check_frames(recording, walk, most=0):
    for k in (0, 3, 1, 5):
        rgb, depth = recording.read(k)
        assert np.abs(rgb.astype(int) - walk.rgb[k]).mean() <= most
        np.testing.assert_allclose(depth, expected_depth(walk, k), rtol=1e-6)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-6)


# --- Stray Scanner ------------------------------------------------------------------------------------------


def test_stray_scanner(tmp_path, walk, save):
    folder = phones.stray_scanner(tmp_path, walk, save)
    assert find_format(folder) == "stray_scanner"
    recording = load_recording(folder)
    check_frames(recording, walk, most=4)
    assert recording.camera == (30, 31, 15, 11, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.arange(6) / 60, atol=1e-9)
    assert recording.t0_ns == 2_000_500_000_000
    np.testing.assert_allclose(recording.gravity_world, [0, -9.81, 0], atol=1e-2)
    np.testing.assert_allclose(recording.imu.t, np.arange(30) / 100 - 0.05, atol=1e-9)
    np.testing.assert_array_equal(recording.imu.omega_body[:, 2], np.arange(30))
    assert "colour resized from 64x48 to 32x24, the size of depth" in recording.notes


def test_another_case_and_a_folder_in_a_zip_are_found(tmp_path, walk, save):
    (tmp_path / "stray").mkdir()
    folder = phones.stray_scanner(tmp_path / "stray", walk, save)
    (folder / "rgb.mp4").rename(folder / "RGB.MP4")
    check_frames(load_recording(folder), walk, most=4)
    phones.record3d(tmp_path / "a.r3d", walk)
    with (
        zipfile.ZipFile(tmp_path / "a.r3d") as archive,
        zipfile.ZipFile(tmp_path / "shared.zip", "w") as other,
    ):
        for name in archive.namelist():
            other.writestr(f"walk/{name}", archive.read(name))
    assert find_format(tmp_path / "shared.zip") == "record3d"
    np.testing.assert_array_equal(
        load_recording(tmp_path / "shared.zip").read(3).depth,
        load_recording(tmp_path / "a.r3d").read(3).depth,
    )


@pytest.mark.parametrize(
    "force, up_in_camera",
    [
        ((0.0, -1.0, 0.0), [-1, 0, 0]),  # upright in the hand: the sensor's right edge is down
        ((-1.0, 0.0, 0.0), [0, -1, 0]),  # on its left edge: the sensor is upright
        ((0.0, 0.0, -9.81), [0, 0, 1]),  # m/s^2 is a force already: up is where it points
    ],
)
def test_the_phone_s_accelerometer_is_turned_to_the_camera(tmp_path, walk, save, force, up_in_camera):
    recording = stray_scanner.load(phones.stray_scanner(tmp_path, walk, save, force=force))
    up = recording.imu.acceleration_body[0] @ rigid.inverse(recording.T_body_cam)[:3, :3].T
    np.testing.assert_allclose(up, 9.81 * np.array(up_in_camera), atol=0.01)


def test_an_accelerometer_without_gravity_is_left_out_aloud(tmp_path, walk, save):
    recording = stray_scanner.load(phones.stray_scanner(tmp_path, walk, save, force=(0.01, 0, 0)))
    assert recording.imu is None
    assert any("imu.csv left out: its mean acceleration is 0.01" in note for note in recording.notes)


def test_gaps_and_a_moving_focus_are_told(tmp_path, walk, save):
    folder = phones.stray_scanner(tmp_path, walk, save, per_frame=True)
    (folder / "depth/000002.png").unlink()
    (folder / "depth/._000003.png").write_bytes(b"resource fork")
    lines = (folder / "odometry.csv").read_text().splitlines()
    lines[5] = ", ".join([*lines[5].split(", ")[:2], *["nan"] * 7, *lines[5].split(", ")[9:]])
    (folder / "odometry.csv").write_text("\n".join([*lines[:4], lines[3], *lines[4:]]))
    recording = stray_scanner.load(folder)
    np.testing.assert_allclose(recording.t, np.array([0, 1, 3, 4, 5]) / 60, atol=1e-9)
    assert np.abs(recording.read(2).rgb.astype(int) - walk.rgb[3]).mean() <= 4
    np.testing.assert_array_equal(np.isnan(recording.T_world_cam[:, 0, 0]), [0, 0, 0, 1, 0])
    notes = "; ".join(recording.notes)
    assert "1 of 6 frames left out, without depth or colour" in notes
    assert "1 rows of odometry.csv left out, of a timestamp not after those before" in notes
    assert "focal length varies by 7.9%" in notes and recording.camera.fx == 31.5
    assert "1 frames without a usable pose (NaN or no quaternion): 000004" in notes


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("odometry.csv", "a,b\n1,2\n", "odometry.csv:2: expected timestamp, frame, x"),
        ("odometry.csv", "a,b\n", "odometry.csv: expected lines of timestamp"),
        ("odometry.csv", "a\n1,inf,0,0,0,0,0,0,1\n", "odometry.csv: expected numbers of frames, got inf"),
        (
            "odometry.csv",
            "a\n1e300,1,0,0,0,0,0,0,1\n",
            "odometry.csv: expected timestamps until the year 2200",
        ),
        ("camera_matrix.csv", "1, 2", "camera_matrix.csv: expected 9 numbers"),
        ("camera_matrix.csv", "60,0,90\n0,60,22\n0,0,1", "camera_matrix.csv: expected fx 0 cx .* in 64x48"),
        ("rgb.mp4", "no video", "rgb.mp4: expected a video"),
        ("imu.csv", "a\n1,2\n", "imu.csv:2: expected timestamp, 3 accelerations"),
    ],
)
def test_unusable_files_of_stray_scanner_are_named(tmp_path, walk, save, name, content, message):
    folder = phones.stray_scanner(tmp_path, walk, save)
    (folder / name).write_text(content)
    with pytest.raises(DataError, match=message):
        stray_scanner.load(folder)


# --- Record3D -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compress", [phones.lzfse.compress, bytes], ids=["lzfse", "raw"])
def test_record3d(tmp_path, walk, compress):
    path = phones.record3d(tmp_path / "desk.r3d", walk, compress=compress)
    assert find_format(path) == "record3d"
    recording = load_recording(path)
    assert recording.name == "desk" and recording.camera == (30, 31, 15, 11, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.arange(6) / 60, atol=1e-9)
    for k in (0, 4):
        rgb, depth = recording.read(k)
        np.testing.assert_array_equal(rgb, phones.small(walk.rgb[k]))
        np.testing.assert_allclose(depth[1:], expected_depth(walk, k)[1:], rtol=1e-6)
        assert depth[0, 1] == 0
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-9)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["desk.r3d"]  # nothing is unpacked


def test_record3d_unpacked_with_a_lost_frame_and_its_own_focus(tmp_path, walk):
    each = [[60 + k, 62, 30.5, 22.5] for k in range(6)]
    archive = phones.record3d(
        tmp_path / "a.r3d", walk, metadata={"perFrameIntrinsicCoeffs": each}, drop=("3.depth", "4.conf")
    )
    with zipfile.ZipFile(archive) as content:
        content.extractall(tmp_path / "a")
    recording = load_recording(tmp_path / "a")
    np.testing.assert_allclose(recording.t, np.array([0, 1, 2, 4, 5]) / 60, atol=1e-9)
    np.testing.assert_array_equal(recording.read(3).rgb, phones.small(walk.rgb[4]))
    assert recording.read(3).depth[-1, -1] == np.float32(walk.counts[4][-1, -1] / 1000)
    assert recording.camera.fx == 31  # the median of 60, 61, 62, 64, 65, at half the size
    assert "1 frames left out, without colour or depth: 3" in recording.notes


def only_metadata(path, content):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", content)


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda p, w: p.write_bytes(p.read_bytes()[:-200]), "a.r3d: expected an archive of Record3D"),
        (
            lambda p, w: phones.record3d(p, w, compress=lambda b: b"bvx2" + b[:90]),
            "depth: expected LZFSE, got",
        ),
        (
            lambda p, w: phones.record3d(p, w, compress=lambda b: phones.lzfse.compress(b[:8])),
            "expected LZFSE, got 8 bytes, not 3072",
        ),
        (
            lambda p, w: phones.record3d(p, w, metadata={"dw": 24, "dh": 32}),
            "expected 64x48, the size of 0.jpg, got 24x32",
        ),
        (lambda p, w: phones.record3d(p, w, metadata={"K": [1]}), "a.r3d: K: expected 9 finite numbers"),
        (lambda p, w: phones.record3d(p, w, metadata={"poses": "x"}), "a.r3d: poses: expected"),
        (
            lambda p, w: phones.record3d(p, w, metadata={"frameTimestamps": [k * 1e300 for k in range(9)]}),
            "a.r3d: expected timestamps until the year 2200, got 1e.300 s",
        ),
        (lambda p, w: zipfile.ZipFile(p, "w").close(), "a.r3d: metadata: expected an entry"),
        (lambda p, w: only_metadata(p, b"[" * 100_000), "a.r3d: metadata: .*got nesting without end"),
    ],
)
def test_unusable_archives_are_one_line(tmp_path, walk, spoil, message):
    path = phones.record3d(tmp_path / "a.r3d", walk)
    spoil(path, walk)
    with pytest.raises(DataError, match=message) as error:
        record3d.load(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_an_encrypted_archive_is_one_line(tmp_path, walk):
    path = phones.record3d(tmp_path / "a.r3d", walk)
    content = bytearray(path.read_bytes())
    central = content.find(b"PK\x01\x02")  # the flags of the first entry, in its header and in the list
    content[6] |= 1
    content[central + 8] |= 1
    path.write_bytes(content)
    with pytest.raises(
        DataError, match="a.r3d: metadata: expected an entry that can be read, got .*encrypted"
    ):
        record3d.load(path)


def test_without_lzfse_the_extra_is_named(tmp_path, walk, monkeypatch):
    path = phones.record3d(tmp_path / "a.r3d", walk)
    monkeypatch.setitem(__import__("sys").modules, "lzfse", None)
    with pytest.raises(DataError, match=r'needs the package lzfse: pip install -e ".\[phone\]"'):
        record3d.load(path)


# --- ARKitScenes, Polycam -----------------------------------------------------------------------------------


def test_arkitscenes(tmp_path, walk, save):
    folder = phones.arkitscenes(tmp_path, walk, save)
    assert find_format(folder) == find_format(folder / "47331606_frames") == "arkitscenes"
    recording = load_recording(folder)
    check_frames(recording, walk)
    assert recording.camera == (30, 31, 15, 11, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.arange(6) / 10, atol=1e-9)
    assert recording.t0_ns == 1_000_123_000_000
    (folder / "47331606_frames/lowres_depth/47331606_1000.324.png").unlink()
    (folder / "47331606_frames/lowres_wide.traj").unlink()
    recording = arkitscenes.load(folder)
    assert len(recording.t) == 5 and recording.T_world_cam is None
    np.testing.assert_array_equal(recording.read(2).rgb, walk.rgb[3])
    (folder / "47331606_frames/lowres_wide_intrinsics/47331606_1000.123.pincam").write_text(
        "64 48 30 31 15 11"
    )
    with pytest.raises(
        DataError, match="1000.123.pincam: expected 32 24 and a camera's fx fy cx cy, got 64 48"
    ):
        arkitscenes.load(folder)


def test_polycam(tmp_path, walk, save):
    folder = phones.polycam(tmp_path, walk, save)
    assert find_format(folder) == "polycam"
    recording = load_recording(folder)
    check_frames(recording, walk, most=40)  # jpg of noise
    assert recording.camera == (31.25, 31, 15, 11, 32, 24, ())
    np.testing.assert_allclose(recording.t, np.arange(6) / 20, atol=1e-9)
    assert "took the names for timestamps in us" in recording.notes
    sheet = next((folder / "keyframes/cameras").iterdir())
    sheet.write_text(sheet.read_text().replace('"fx"', '"f"'))
    with pytest.raises(DataError, match=f"{sheet.name}: fx: expected a finite number above 0, got no such"):
        polycam.load(folder)


@pytest.mark.parametrize("size", [0, 50, 5_000, 300_000])
def test_lzfse_says_how_large_it_is_before_it_is_unpacked(size):
    """Every kind of block, by the package's own writer: stored, LZVN, and LZFSE of several blocks."""
    data = np.random.default_rng(0).integers(0, 9, size).astype(np.uint8).tobytes()
    packed = phones.lzfse.compress(data)
    assert record3d._unpacked_size(packed) == size
    with pytest.raises((ValueError, struct.error)):
        record3d._unpacked_size(packed[:-6])
