"""Videos that PyAV writes, read back frame by frame, in order and not."""

import av
import numpy as np
import pytest

from jaxpose.datasets.video import Video
from jaxpose.errors import DataError


def write_video(path, frames, codec="libx264", rate=30):
    """Frames of colour; x264 keeps flat colours of 4:4:4 to a few counts."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options={"crf": "1", "g": "5", "bf": "2"})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv444p" if codec == "libx264" else "yuv420p"
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def flat(k, size=(48, 64)):
    return np.full((*size, 3), [20 * k, 200 - 10 * k, 100], np.uint8)


def test_frames_are_found_in_any_order(tmp_path):
    video = Video(write_video(tmp_path / "a.mp4", [flat(k) for k in range(12)]))
    assert len(video) == 12 and video.size == (64, 48)
    for k in (0, 1, 2, 7, 3, 11, 0, 10, 9):
        assert np.abs(video.read(k).astype(int) - flat(k)).max() <= 6, k
    assert video.read(4, (32, 24)).shape == (24, 32, 3)
    assert np.abs(video.read(5, (32, 24)).astype(int) - flat(5)[::2, ::2]).max() <= 6


def test_what_is_no_video_is_one_line(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.mp4", [flat(k) for k in range(12)])
    content = path.read_bytes()
    for share in (0.0, 0.3, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(DataError, match="a.mp4: expected a video, got ") as error:
            Video(path)
        assert "\n" not in str(error.value)
    with pytest.raises(DataError, match="b.mp4: expected a video"):
        Video(tmp_path / "b.mp4")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(DataError, match=r'needs the package av: pip install -e ".\[video\]"'):
        Video(path)


def test_a_codec_that_is_not_there_is_named(tmp_path):
    path = write_video(tmp_path / "a.mp4", [flat(k) for k in range(3)])
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzz1"))
    with pytest.raises(DataError, match="a.mp4: expected a video, got one of a codec that is not known here"):
        Video(path)
