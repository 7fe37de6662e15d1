"""DAVIS text on made folders of the exact layout, on damaged ones, and on the real slice."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.datasets.events import davis
from jaxpose.datasets.events.sidecar import check_mosaic
from jaxpose.errors import DataError

SIZE = (64, 48)
CALIB = "60 61 31.5 23.5 -0.3 0.1 0.001 -0.002 0.05\n"
T0 = 1_403_715_524.25  # seconds since 1970


def events_of(n=2000):
    g = np.random.default_rng(5)
    t = T0 + np.sort(g.integers(0, 200_000, n)) / 1e6  # 0.2 s
    return t, g.integers(0, 64, n), g.integers(0, 48, n), g.integers(0, 2, n)


def lines_of(t, x, y, p):
    return [f"{a:.6f} {b} {c} {d}\n" for a, b, c, d in zip(t, x, y, p, strict=True)]


def pose_of(t):
    """A camera that moves along x and turns about z."""
    return [0.5 * (t - T0), 1.0, 2.0], Rotation.from_rotvec([0, 0, t - T0])


@pytest.fixture
def scene(tmp_path, save):
    """0.2 s of events; frames every 0.04 s from 0.1 s before to 0.38 s after.

    Ground truth at 100 Hz around them.
    """
    (tmp_path / "events.txt").write_text("".join(lines_of(*events_of())))
    (tmp_path / "calib.txt").write_text(CALIB)
    listing, ground_truth = [], []
    for k in range(12):
        pixels = np.random.default_rng(k).integers(0, 256, (48, 64), np.uint8)
        save(tmp_path / f"images/frame_{k:08d}.png", pixels)
        listing.append(f"{T0 - 0.1 + 0.04 * k:.9f} images/frame_{k:08d}.png\n")
    for t in T0 + np.arange(-0.08, 0.23, 0.01):
        position, rotation = pose_of(t)
        ground_truth.append(" ".join(f"{v:.12f}" for v in (t, *position, *rotation.as_quat())) + "\n")
    (tmp_path / "images.txt").write_text("".join(listing))
    (tmp_path / "groundtruth.txt").write_text("".join(ground_truth))
    return tmp_path


def test_a_made_folder_reads_back(scene):
    recording = davis.load(scene)
    t, x, y, p = events_of()
    np.testing.assert_allclose(recording.events.t, t - t[0], atol=3e-7)
    np.testing.assert_array_equal(recording.events.x, x)
    np.testing.assert_array_equal(recording.events.y, y)
    np.testing.assert_array_equal(recording.events.polarity, 2 * p - 1)
    assert recording.camera == (60, 61, 31.5, 23.5, 64, 48, (-0.3, 0.1, 0.001, -0.002, 0.05))
    assert recording.mosaic == "mono" and not recording.cyclic and recording.threshold is None
    # Poses are the ground truth at its own timestamps, on the clock of the events.
    assert len(recording.t) == 31
    np.testing.assert_allclose(recording.t, T0 + np.arange(-0.08, 0.23, 0.01) - t[0], atol=3e-7)
    position, rotation = pose_of(T0 - 0.08)
    np.testing.assert_allclose(recording.T_world_cam[0, :3, 3], position, atol=1e-9)
    np.testing.assert_allclose(recording.T_world_cam[0, :3, :3], rotation.as_matrix(), atol=1e-9)


def test_frames_are_those_of_the_events_time(scene):
    recording = davis.load(scene)
    frames, t0 = recording.frames, events_of()[0][0]
    # Events from 0 to 0.2 s: the frames from -0.02 to 0.22 s are next to or within them.
    assert frames.files == tuple(f"images/frame_{k:08d}.png" for k in range(2, 9))
    np.testing.assert_allclose(frames.t, T0 - 0.1 + 0.04 * np.arange(2, 9) - t0, atol=3e-7)
    np.testing.assert_array_equal(
        frames.rgb[0, :, :, 1], np.random.default_rng(2).integers(0, 256, (48, 64), np.uint8)
    )
    for timestamp, T in zip(frames.t, frames.T_world_cam, strict=True):
        position, rotation = pose_of(timestamp + t0)
        np.testing.assert_allclose(T[:3, 3], position, atol=1e-7)
        np.testing.assert_allclose(T[:3, :3], rotation.as_matrix(), atol=1e-6)
    assert "5 of 12 frames left out, not next to or within the events' time" in recording.notes
    assert 0 < frames.near < frames.far and any("are guessed" in note for note in recording.notes)
    part = davis.load(scene, span=(0.05, 0.06))
    assert part.frames.files == ("images/frame_00000003.png", "images/frame_00000004.png")


def test_an_image_that_is_listed_and_missing_is_left_out_aloud(scene):
    (scene / "images/frame_00000003.png").unlink()
    recording = davis.load(scene)
    assert "images/frame_00000003.png" not in recording.frames.files and len(recording.frames.files) == 6
    assert any("frame_00000003.png" in note for note in recording.notes)


def test_frames_without_truth_are_left_out_aloud(scene):
    file = scene / "groundtruth.txt"
    file.write_text("".join(file.read_text().splitlines(True)[11:]))
    recording = davis.load(scene)
    assert recording.frames.files[0] == "images/frame_00000004.png"
    note = "2 frames left out, no true pose around their timestamp: frame_00000002.png, frame_00000003.png"
    assert note in recording.notes
    file.unlink()
    recording = davis.load(scene)
    assert recording.frames is None and recording.t.shape == (0,) and recording.T_world_cam.shape == (0, 4, 4)
    assert "no groundtruth.txt: there is no ground truth to compare with" in recording.notes


def test_truth_of_another_clock_is_told(scene):
    shifted = [
        f"{float(line.split(' ', 1)[0]) - T0:.9f} {line.split(' ', 1)[1]}"
        for line in (scene / "groundtruth.txt").read_text().splitlines()
    ]
    (scene / "groundtruth.txt").write_text("\n".join(shifted))
    assert any("so the clocks may differ" in note for note in davis.load(scene).notes)


@pytest.mark.parametrize("form", ["%.18e", "%.9f"])
def test_numbers_may_be_written_as_numpy_does(scene, form):
    t, x, y, p = events_of()
    np.savetxt(scene / "events.txt", np.column_stack([t, x, y, 2 * p - 1]), fmt=form, header="t x y p")
    expected = davis.load(scene).events
    (scene / "events.txt").write_text("\n# text\n\n" + "".join(lines_of(t, x, y, p)))
    for a, b in zip(davis.load(scene).events, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_nanoseconds_since_1970_keep_their_digits(scene):
    t = 1_403_715_524_250_000_000 + np.arange(1000) * 3001
    (scene / "events.txt").write_text("".join(f"{timestamp} 1 2 1\n" for timestamp in t))
    recording = davis.load(scene)
    np.testing.assert_allclose(recording.events.t, np.arange(1000) * 3001e-9, rtol=1e-12)
    assert recording.notes[0].startswith(
        "timestamps read as nanoseconds, as in the format's seconds their rate"
    )


def test_more_events_than_a_block_are_all_read(tmp_path):
    n = 140_000
    (tmp_path / "events.txt").write_text(
        "".join(f"{k * 1e-5:.6f} {k % 64} {k % 48} {k % 2}\n" for k in range(n))
    )
    (tmp_path / "calib.txt").write_text(CALIB)
    events = davis.load(tmp_path, size=SIZE).events
    np.testing.assert_allclose(events.t, np.arange(n) * 1e-5, atol=1e-9)
    np.testing.assert_array_equal(events.x, np.arange(n) % 64)
    with (tmp_path / "events.txt").open("a") as file:
        file.write("2.0 3 4\n")
    with pytest.raises(DataError, match=rf"events.txt:{n + 1}: expected 4 numbers \(t x y p\), got 3$"):
        davis.load(tmp_path, size=SIZE)


@pytest.mark.parametrize(
    ("centre", "reach", "size"),
    [
        ("132 110", (239, 179), (240, 180)),  # the data set's own calibration
        ("170 131", (345, 259), (346, 260)),
        ("170 131", (100, 100), (304, 240)),
        ("322 243", (639, 479), (640, 480)),
        ("322 243", (100, 100), (640, 480)),
        ("640 360", (1279, 719), (1280, 720)),
    ],
)
def test_the_size_of_the_sensor_is_guessed_aloud(tmp_path, centre, reach, size):
    g = np.random.default_rng(0)
    x, y = g.integers(0, reach[0] + 1, 1000), g.integers(0, reach[1] + 1, 1000)
    x[:3], y[:3] = reach[0], reach[1]
    (tmp_path / "events.txt").write_text("".join(lines_of(T0 + np.arange(1000) / 1e4, x, y, x % 2)))
    (tmp_path / "calib.txt").write_text(f"300 300 {centre} 0 0 0 0 0\n")
    recording = davis.load(tmp_path)
    assert (recording.camera.width, recording.camera.height) == size and recording.camera.distortion == ()
    note = f"size of the sensor taken as {size[0]}x{size[1]}, the smallest known that fits"
    assert recording.notes[0] == note
    assert davis.load(tmp_path, size=(1300, 900)).camera[4:6] == (1300, 900)


def test_without_calibration_the_camera_is_assumed_aloud(scene):
    (scene / "calib.txt").unlink()
    recording = davis.load(scene)
    assert recording.camera == (64, 64, 31.5, 23.5, 64, 48, ())
    assert "no calib.txt or camera.json: focal length taken as 64 px, no distortion" in recording.notes


def test_the_file_is_found_or_named(scene):
    (scene / "events.txt").rename(scene / "events_chunk.txt")
    assert len(davis.load(scene).events.t) == 2000
    (scene / "events_b.txt").write_text("0.1 3 4 1\n0.2 3 4 1\n")
    with pytest.raises(DataError, match="got 2 files, name one of them: events_b.txt, events_chunk.txt"):
        davis.load(scene)
    assert len(davis.load(scene / "events_b.txt").events.t) == 2
    for path, found in ((scene / "images", "frame_00000000.png, .*"), (scene / "nowhere", "nothing")):
        with pytest.raises(DataError, match=f"{path}: expected events.txt, or one events.*txt, got {found}"):
            davis.load(path)


def events_with(row, line):
    def change(scene):
        lines = lines_of(*events_of())
        lines[row] = line
        (scene / "events.txt").write_text("# first\n" + "".join(lines))

    return change


def write(name, text):
    return lambda scene: (scene / name).write_text(text)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (write("events.txt", ""), "events.txt: expected events, got none"),
        (write("events.txt", "# nothing\n"), "events.txt: expected events, got none"),
        (events_with(-1, "1403715524.44 10"), r"events.txt:2001: expected 4 numbers \(t x y p\), got 2"),
        (events_with(5, "1403715524.2501 1 2 1 9\n"), r"events.txt:7: expected 4 numbers \(t x y p\), got 5"),
        (events_with(5, "1403715524.2501,1,2,1\n"), r"events.txt:7: expected 4 numbers .*, got 1"),
        (
            events_with(5, "1403715524.2501 a 2 1\n"),
            r"events.txt:7: expected .*, got '1403715524.2501 a",
        ),
        (events_with(5, "nan 1 2 1\n"), "events.txt:7: expected a finite timestamp, got nan"),
        (events_with(5, "1403715524.2501 1.5 2 1\n"), "events.txt:7: expected a whole number for x, got 1.5"),
        (events_with(5, "1403715524.2501 1 2 3\n"), "events.txt:7: expected polarities 0 and 1, .*, got 3"),
        (events_with(900, "1403715524.25 1 2 1\n"), "events.txt:902: expected events in the order of time, "),
        (write("calib.txt", "1 2 3 4\n"), r"calib.txt:1: expected 9 numbers \(fx fy cx cy k1 .*\), got 4"),
        (write("calib.txt", CALIB * 2), "calib.txt: expected one line of 9 numbers .*, got 2 lines"),
        (write("calib.txt", CALIB.replace("31.5", "131.5")), "calib.txt: expected fx 0 cx .* in 64x48, got "),
        (write("groundtruth.txt", "1 2 3\n"), "groundtruth.txt:1: expected a trajectory"),
        (
            write("groundtruth.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n"),
            "expected poses with timestamps .*, got a KITTI",
        ),
        (
            write("images.txt", "0.1\n"),
            "images.txt:1: expected a timestamp in seconds and a file name, got ",
        ),
        (write("images/frame_00000003.png", "no"), "frame_00000003.png: expected an image, got "),
    ],
)
def test_unusable_files_are_named(scene, spoil, message):
    spoil(scene)
    with pytest.raises(DataError, match=message) as error:
        davis.load(scene)
    assert str(scene) in str(error.value) and "\n" not in str(error.value)


def test_settings_are_checked(scene):
    with pytest.raises(ValueError, match="mosaic: expected mono or rggb, got 'bggr'"):
        check_mosaic("bggr")
    with pytest.raises(DataError, match="images.txt: expected images of 240x180, got 64x48"):
        davis.load(scene, size=(240, 180))


# --- the real slice -----------------------------------------------------------------------------------------


@pytest.mark.data
def test_the_real_slice(data_dir):
    """50,000 events in 0.17 s on a rail along x."""
    folder = data_dir / "ecd_slider_depth"
    recording = davis.load(folder)
    events, t0 = recording.events, 0.003811
    assert len(events.t) == 50_000
    assert (events.t[0], events.x[0], events.y[0], events.polarity[0]) == (0.0, 96, 133, -1)
    assert (events.x[-1], events.y[-1], events.polarity[-1]) == (70, 103, 1)
    assert events.t[-1] == pytest.approx(0.174156 - t0, abs=1e-9)
    assert recording.camera[:6] == (335.419462958, 335.352935612, 129.924663379, 99.1864303447, 240, 180)
    assert recording.camera.distortion == (
        -0.138592767408, 0.0933736664192, -0.000335586987532, 0.000173720158228, 0.0
    )  # fmt: skip
    assert len(recording.t) == 339 and recording.t[0] == pytest.approx(0.022291582 - t0, abs=1e-12)
    way = recording.T_world_cam[-1, :3, 3] - recording.T_world_cam[0, :3, 3]
    assert way[0] > 0.9 and np.abs(way[1:]).max() == 0
    assert recording.frames.files == tuple(f"images/frame_{k:08d}.png" for k in range(1, 6))
    np.testing.assert_allclose(recording.frames.t[0], 0.038766001 - t0, atol=1e-12)
    ground_truth = np.loadtxt(folder / "groundtruth.txt")
    at = np.interp(recording.frames.t + t0, ground_truth[:, 0], ground_truth[:, 1])
    np.testing.assert_allclose(recording.frames.T_world_cam[:, 0, 3], at, atol=2e-4)
    assert recording.notes[0] == "81 of 87 frames left out, not next to or within the events' time"
    assert recording.notes[1].endswith("no true pose around their timestamp: frame_00000000.png")
