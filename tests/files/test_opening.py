"""What is no file is refused before anybody reads it: a pipe that nobody writes to would wait for ever."""

import os
import socket
from pathlib import Path

import pytest

from jaxpose.errors import DataError
from jaxpose.files import opening
from jaxpose.files.texts import read_text
from jaxpose.files.untrusted import read_json, read_npz


@pytest.mark.parametrize(
    "read", [opening.open_file, opening.open_text, opening.read_bytes, opening.BoundedFile]
)
def test_pipes_sockets_and_devices_are_refused(tmp_path, read, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a socket's name is short
    os.mkfifo("pipe")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("socket")
        for name, kind in (("pipe", "a pipe"), ("socket", "a socket"), (os.devnull, "a device")):
            with pytest.raises(DataError, match=f"{name}: expected a file, got {kind}"):
                read(Path(name))
    with pytest.raises(FileNotFoundError):
        read(Path("none"))
    with pytest.raises(IsADirectoryError):
        read(tmp_path)


def test_readers_refuse_a_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for read in (read_text, lambda path: read_json(path, "numbers"), lambda path: read_npz(path, "numbers")):
        with pytest.raises(DataError, match="pipe: expected a file, got a pipe"):
            read(tmp_path / "pipe")


def test_a_file_is_read_as_it_is(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"\xef\xbb\xbfa\xffb\r\n" * 2000)
    assert opening.read_bytes(path) == path.read_bytes()
    with opening.open_text(path) as lines:
        assert lines.readline() == "a\ufffdb\n"
    with opening.BoundedFile(path) as stream:
        assert stream.size == 16000 and stream.read(3) == b"\xef\xbb\xbf"
        assert len(stream.read(1 << 60)) == 16000 - 3  # without space for all of that
        assert stream.read(1 << 60) == b"" and stream.read() == b""
        stream.seek(1)
        assert stream.read(3) == b"\xbb\xbfa" and stream.read() == path.read_bytes()[4:]
