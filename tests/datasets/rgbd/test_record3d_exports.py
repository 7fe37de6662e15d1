"""Record3D's other exports: EXR + JPG, by OpenEXR; and the RGBD video, by PyAV, as its maker documents it."""

import colorsys
import json
import shutil

import av
import numpy as np
import OpenEXR
import pytest
from helpers import phones

from jaxpose.datasets.rgbd import registry
from jaxpose.errors import DataError

K, SIZE = (60.0, 61.0, 31.0, 23.0), (64, 48)


def exr(file, channels, compression=OpenEXR.ZIP_COMPRESSION):
    header = {"compression": compression, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as image:
        image.write(str(file))


@pytest.fixture
def export(tmp_path, walk, save):
    """`metadata.json` as in the archive, `rgb/N.jpg` and `depth/N.exr` with one channel R of metres."""
    phones.record3d(tmp_path / "a.r3d", walk)
    shutil.unpack_archive(tmp_path / "a.r3d", tmp_path / "raw", "zip")
    folder = tmp_path / "export"
    (folder / "depth").mkdir(parents=True)
    (tmp_path / "raw/metadata").rename(folder / "metadata.json")
    for k, rgb in enumerate(walk.rgb):
        save(folder / f"rgb/{k}.png", phones.large(rgb))
        (folder / f"rgb/{k}.png").rename(folder / f"rgb/{k}.jpg")  # of exact pixels
        depth = walk.counts[k].astype(np.float32) / 1000
        depth[0, 1] = np.nan
        exr(folder / f"depth/{k}.exr", {"R": depth})
    return folder


def test_exr_and_jpg_are_read_as_the_archive_is(export, tmp_path, walk):
    archive = registry.load_recording(tmp_path / "a.r3d")
    shutil.make_archive(str(tmp_path / "zipped"), "zip", tmp_path, "export")
    for path in (export, tmp_path / "zipped.zip"):
        assert registry.find_format(path) == "record3d"
        read = registry.load_recording(path)
        np.testing.assert_array_equal(read.t, archive.t)
        np.testing.assert_array_equal(read.T_world_cam, archive.T_world_cam)
        assert read.camera == archive.camera
        for k in range(6):
            np.testing.assert_array_equal(read.read(k).rgb, archive.read(k).rgb)
            wanted = walk.counts[k] / np.float32(1000)
            wanted[0, 1] = 0
            np.testing.assert_array_equal(read.read(k).depth, wanted)


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "PIZ"])
def test_any_compression_and_half_floats(export, walk, compression):
    depth = (walk.counts[0] / 1000).astype(np.float16)
    exr(export / "depth/0.exr", {"Z": depth}, getattr(OpenEXR, f"{compression}_COMPRESSION"))
    np.testing.assert_array_equal(registry.load_recording(export).read(0).depth, depth.astype(np.float32))


def test_unusable_exr_is_named_in_one_line(export, capfd):
    file = export / "depth/0.exr"
    content = file.read_bytes()
    exr(export / "color.exr", {"RGB": np.zeros((24, 32, 3), np.float32)})
    for data, got in (
        (content[: len(content) - 9], "got"),
        (content[:200], "got"),
        (b"PNG", "got"),
        ((export / "color.exr").read_bytes(), "got channels R G B|got channels B G R"),
    ):
        file.write_bytes(data)
        with pytest.raises(
            DataError, match=f"depth/0.exr: expected an image of depth in OpenEXR, ({got})"
        ) as error:
            registry.load_recording(export)
        assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")
    shutil.rmtree(export / "rgb")
    (export / "rgb.zip").write_bytes(b"")
    with pytest.raises(
        DataError, match="expected rgbd/N.jpg with rgbd/N.depth, or rgb/N.jpg with depth/N.exr"
    ):
        registry.load_recording(export)


# --- the video --------------------------------------------------------------------------------------------


def depth_of(k):
    """A slope, and a hole whose depth is not known, which is red."""
    depth = np.tile(np.linspace(0.5, 2.5, SIZE[0]), (SIZE[1], 1)) + 0.02 * k
    depth[8:16, 8:16] = 3.0
    return depth


def color_of(k):
    return np.full((SIZE[1], SIZE[0], 3), [20 * k, 200 - 10 * k, 100], np.uint8)


def video(file, content, count=5, span=3.0):
    hues = {}
    with av.open(str(file), "w", format="mp4") as container:
        container.metadata["comment"] = content
        track = container.add_stream("libx264", rate=30, options={"crf": "1"})
        track.width, track.height, track.pix_fmt = 2 * SIZE[0], SIZE[1], "yuv444p"
        for k in range(count):
            levels = depth_of(k) / span
            colors = {h: colorsys.hsv_to_rgb(h, 1, 1) for h in np.unique(levels)}
            hues = np.array([[colors[h] for h in row] for row in levels])
            pixels = np.concatenate([np.rint(255 * hues).astype(np.uint8), color_of(k)], axis=1)
            container.mux(track.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(track.encode(None))
    return file


METADATA = {"intrinsicMatrix": [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1]}


def test_depth_is_the_hue_of_the_left_half(tmp_path):
    (tmp_path / "in").mkdir()
    inside = video(tmp_path / "in/walk.mp4", json.dumps(METADATA | {"rangeOfEncodedDepth": [0, 3]}))
    (tmp_path / "beside").mkdir()
    beside = video(tmp_path / "beside/walk.mp4", "")
    (tmp_path / "beside/metadata.json").write_text(json.dumps(METADATA))
    for path in (inside, beside, inside.parent, beside.parent):
        assert registry.find_format(path) == "record3d"
        read = registry.load_recording(path)
        assert read.camera[:6] == (*K, *SIZE) and read.T_world_cam is None
        np.testing.assert_allclose(read.t, np.arange(5) / 30, atol=1e-6)
        for k in (0, 3):
            rgb, depth = read.read(k)
            np.testing.assert_allclose(rgb.astype(int), color_of(k), atol=8)
            hole = np.zeros(depth.shape, bool)
            hole[4:20, 4:20] = True  # and what compression mixes around it
            assert (depth[10:14, 10:14] == 0).all()
            assert np.abs(depth - depth_of(k))[~hole].max() < 0.05
    assert "depth is the hue of a video: 0 to 3 m, in steps of some millimetres" in read.notes


def test_a_video_that_is_no_rgbd_video(tmp_path):
    file = video(tmp_path / "a.mp4", "holiday")
    with pytest.raises(DataError, match="expected a recording"):
        registry.find_format(file)
    for content, message in (
        ({"intrinsicMatrix": [1, 2]}, "intrinsicMatrix: expected 9 finite numbers"),
        (METADATA | {"rangeOfEncodedDepth": [3, 3]}, "got 3 to 3 m"),
        ({"intrinsicMatrix": [0] * 9}, "expected fx 0 cx"),
    ):
        video(file, json.dumps(content))
        with pytest.raises(DataError, match=message) as error:
            registry.load_recording(file)
        assert "\n" not in str(error.value)
