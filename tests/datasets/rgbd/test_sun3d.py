"""SUN3D's layout and Redwood's, written here, read back."""

import numpy as np
import pytest

from jaxpose.datasets.rgbd import sun3d
from jaxpose.datasets.rgbd.registry import find_format, load_recording
from jaxpose.errors import DataError


def write(folder, walk, save, *, color="image", turned=True):
    """Depth of SUN3D is turned: bitor(bitshift(d, 3), bitshift(d, 3 - 16)) in its toolbox."""
    for k in range(6):
        save(folder / f"{color}/{k + 1:07d}-{33_333 * k:012d}.jpg", walk.rgb[k])
        counts = walk.counts[k]
        stored = (counts << 3) | (counts >> 13) if turned else counts
        save(folder / f"depth/{k + 2:07d}-{33_333 * k + 5000:012d}.png", stored)
    if turned:
        (folder / "intrinsics.txt").write_text("30 0 15\n0 31 11\n0 0 1\n")
        (folder / "extrinsics").mkdir()
        for name, poses in (
            ("20130101.txt", np.zeros((18, 4))),
            ("20140101.txt", walk.T_world_cam[:, :3].reshape(18, 4)),
        ):
            np.savetxt(folder / "extrinsics" / name, poses)
    return folder


def test_sun3d(tmp_path, walk, save):
    folder = write(tmp_path, walk, save)
    assert find_format(folder) == "sun3d"
    recording = load_recording(folder)
    assert recording.camera == (30, 31, 15, 11, 32, 24, ())
    np.testing.assert_allclose(recording.t, 0.033333 * np.arange(6), atol=1e-9)
    np.testing.assert_allclose(recording.T_world_cam, walk.T_world_cam, atol=1e-9)
    depth = recording.read(4).depth
    np.testing.assert_allclose(depth[1:], walk.counts[4][1:] / 1000, rtol=1e-6)


def test_redwood_scan_with_a_lost_image(tmp_path, walk, save, metres):
    folder = write(tmp_path, walk, save, color="rgb", turned=False)
    (folder / "depth/0000004-000000071666.png").unlink()
    recording = load_recording(folder)
    assert len(recording.t) == 5 and recording.T_world_cam is None
    np.testing.assert_allclose(recording.read(2).depth, metres(walk.counts[3], 1000), rtol=1e-6)
    assert "1 of 6 colour images left out, no depth of their own within 0.02 s" in recording.notes[0]
    assert any("took the published fx fy cx cy = 525 525 319.5 239.5" in note for note in recording.notes)


def test_unusable_files_are_named(tmp_path, walk, save):
    folder = write(tmp_path, walk, save)
    (folder / "extrinsics/20140101.txt").write_text("1 0 0 0\n")
    with pytest.raises(DataError, match="20140101.txt: expected 3 lines for each of 6 colour images, got 1"):
        sun3d.load(folder)
