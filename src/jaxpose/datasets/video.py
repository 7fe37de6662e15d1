"""Videos (mp4, mkv) through PyAV: frames decoded when asked for."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jaxpose.datasets.rgbd.frames import visible
from jaxpose.errors import DataError
from jaxpose.files.opening import check_file

EXTRA = 'pip install -e ".[video]"'
SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")
_NEAR = 8  # frames ahead that are decoded on the way instead of sought


def find_video(path: Path, suffixes: Sequence[str] = SUFFIXES) -> Path | None:
    """The video at a path.

    Args:
        path: A file or folder.
        suffixes: Of what counts as a video, in lower case.

    Returns:
        The file itself, or the only one in the folder; None where there is none, or more.
    """
    files = visible(path) if path.is_dir() else [path]
    videos = [file for file in files if file.suffix.lower() in suffixes and file.is_file()]
    return videos[0] if len(videos) == 1 else None


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file of tracks. Needs the package av (extra `video`).

    Args:
        path: The file.

    Yields:
        PyAV's container.

    Raises:
        DataError: For whatever goes wrong with it, and without the package.
    """
    try:
        import av
    except ImportError:
        raise DataError(f"{path}: a video needs the package av: {EXTRA}") from None
    try:
        check_file(path)
        with av.open(str(path)) as container:
            yield container
    except DataError:
        raise
    except Exception as error:  # PyAV raises many kinds
        raise _damaged(path, error) from None


class Video:
    """A video track of a file. Needs the package av (extra `video`).

    Args:
        path: The file.
        track: Its number among the video tracks.
        stamps: Of its frames, where they are known: else the file is passed over for them.

    Raises:
        DataError: For what is no video, or of a codec that is not there, and without the package.
    """

    def __init__(self, path: Path, track: int = 0, stamps: Sequence[int] = ()):
        self.path, self._track = path, track
        if not stamps:
            with opened(path) as container:
                stamps = [packet.pts for packet in container.demux(video=track) if packet.pts is not None]
        import av

        try:
            check_file(path)
            self._container = av.open(str(path))
            self._stream = self._container.streams.video[track]
            if self._stream.codec_context is None:
                raise ValueError("one of a codec that is not known here")
            self._stream.thread_type = "AUTO"
            self.size = (self._stream.codec_context.width, self._stream.codec_context.height)
        except DataError:
            raise
        except Exception as error:
            raise _damaged(path, error) from None
        if not stamps or min(self.size) < 1:
            raise DataError(f"{path}: expected a video with frames, got none")
        self._pts = sorted(set(stamps))
        self._rank = {pts: i for i, pts in enumerate(self._pts)}
        self._next, self._frames = len(self._pts), iter(())

    def __len__(self) -> int:
        return len(self._pts)

    @property
    def ns(self) -> list[int]:
        """Timestamps of the frames on the file's clock [ns]."""
        unit = self._stream.time_base or Fraction(1)
        return [round(pts * unit * 10**9) for pts in self._pts]

    @cached_property
    def quarter_turns(self) -> int:
        """How often frames are to be turned by 90 degrees to the left to be shown, by the file."""
        with opened(self.path) as container:
            return round(next(container.decode(video=self._track)).rotation / 90) % 4

    def read(self, i: int, size: tuple[int, int] | None = None) -> np.ndarray:
        """Frame i as (height, width, 3) uint8 RGB, resized by area to `size` (width, height) if given."""
        width, height = size or self.size
        return self._read(i, lambda frame: frame.reformat(width, height, "rgb24", interpolation="AREA"))

    def counts(self, i: int) -> np.ndarray:
        """Frame i of a grey track of 16 bits, as (height, width) uint16."""
        return self._read(i, lambda frame: frame.reformat(format="gray16le"))

    def _read(self, i: int, reformat: Callable[[Any], Any]) -> np.ndarray:
        try:
            if not self._next <= i < self._next + _NEAR:
                self._container.seek(self._pts[i], stream=self._stream)
                self._frames = self._decoded()
            for at, frame in self._frames:
                self._next = at + 1
                if at == i:
                    return reformat(frame).to_ndarray()
                if at > i:
                    break
        except Exception as error:
            raise _damaged(self.path, error) from None
        self._next = len(self._pts)
        raise DataError(f"{self.path}: expected frame {i} of {len(self)}, got none that can be decoded")

    def _decoded(self) -> Iterator[tuple[int, Any]]:
        """Frames from where the file was sought on, and which each is."""
        for frame in self._container.decode(self._stream):
            if frame.pts in self._rank:
                yield self._rank[frame.pts], frame


def _damaged(path: Path, error: Exception) -> DataError:
    words = re.sub(r"^\[Errno -?\d+\] |: '[^']*'$", "", " ".join(str(error).split())) or type(error).__name__
    return DataError(f"{path}: expected a video, got {words[:200]}")
