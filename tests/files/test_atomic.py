"""Files of the user: written whole, links followed, devices refused, one run in a folder at a time."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxpose.errors import DataError
from jaxpose.files import run_folder
from jaxpose.files.atomic import atomic, write_text


def test_a_link_that_leads_to_itself_is_refused(tmp_path):
    (tmp_path / "loop.txt").symlink_to("loop.txt")
    with pytest.raises(DataError, match="loop.txt: expected a file to write, got a link"):
        write_text(tmp_path / "loop.txt", "new")
    assert (tmp_path / "loop.txt").is_symlink()


def test_a_link_is_followed(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "there.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "disk" / "there.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "disk" / "there.txt").read_text() == "new"
    assert [path.name for path in (tmp_path / "disk").iterdir()] == ["there.txt"]


def test_a_device_and_a_folder_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place, got in (
        (Path("/dev/null"), "a device"),
        (tmp_path / "pipe", "a device"),
        (tmp_path, "a folder"),
    ):
        with pytest.raises(DataError, match=f"{place}: expected a file to write, got {got}"):
            write_text(place, "text")
    assert Path("/dev/null").is_char_device()


def test_it_is_on_the_disk_before_it_takes_the_place(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: (done.append("fsync"), fsync(number)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("replace"), replace(a, b)))
    write_text(tmp_path / "a.txt", "text")
    assert done == ["fsync", "replace"]


def test_a_full_disk_is_named(tmp_path):
    with pytest.raises(OSError, match=r"No space left on device: '.*a\.txt'"):
        with atomic(tmp_path / "a.txt"):
            raise OSError(errno.ENOSPC, "no space")
    assert list(tmp_path.iterdir()) == []


def test_what_no_encoding_holds_is_escaped(tmp_path):
    write_text(tmp_path / "a.txt", "name \udcff")
    assert (tmp_path / "a.txt").read_text() == "name \\udcff"


def test_what_a_killed_run_was_writing_is_deleted_and_nothing_else(tmp_path):
    mine = [".hidden", ".notes.12.txt", "a.5.unfinished.txt", ".x.unfinished"]
    for name in mine:
        (tmp_path / name).write_text("mine")
    code = (
        "import os, sys; from jaxpose.files.atomic import atomic\n"
        "with atomic(sys.argv[1]) as path:\n    path.write_text('half'); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / "checkpoint.npz"])
    assert len(list(tmp_path.iterdir())) == len(mine) + 1
    with run_folder.opened(tmp_path):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(mine)


def test_two_runs_in_one_folder(tmp_path):
    code = (
        "import sys; from pathlib import Path; from jaxpose.files import run_folder\n"
        "with run_folder.opened(Path(sys.argv[1])):\n    print('open', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, tmp_path / "run"]
    first = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None and first.stdout.readline() == "open\n"
    with pytest.raises(DataError, match=rf"run: expected no other run in it, .* process {first.pid} on"):
        with run_folder.opened(tmp_path / "run"):
            pass
    first.kill()  # its lock goes with it
    first.wait()
    assert (tmp_path / "run" / run_folder.LOCK).exists()
    with run_folder.opened(tmp_path / "run") as folder:
        assert str(os.getpid()) in (folder / run_folder.LOCK).read_text()
        with pytest.raises(DataError, match=f"got one of process {os.getpid()} on"):
            with run_folder.opened(tmp_path / "run"):
                pass
    assert list((tmp_path / "run").iterdir()) == []


def test_the_lock_of_another_host_stays(tmp_path):
    (tmp_path / run_folder.LOCK).write_text("elsewhere 7\n")
    with pytest.raises(DataError, match=r"one of process 7 on elsewhere; if that has ended, delete .*\.lock"):
        with run_folder.opened(tmp_path):
            pass
    assert (tmp_path / run_folder.LOCK).read_text() == "elsewhere 7\n"
