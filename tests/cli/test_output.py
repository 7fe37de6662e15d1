"""What commands print where that is not easy: closed and full streams, odd names, interrupted imports."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from helpers.refused import complaint

from jaxpose._terminal import printable
from jaxpose.cli.main import main
from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_apart, own_folder
from jaxpose.files import trajectories


def said(command: str) -> subprocess.CompletedProcess[str]:
    """What a shell makes of `jaxpose ...`."""
    shell = f"{sys.executable} -m jaxpose {command}"
    return subprocess.run(shell, shell=True, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("--help > /dev/full", "jaxpose: stdout: No space left on device\n"),
        ("--help >&-", "jaxpose: expected an open stdout, got a closed one\n"),
        ("export --help > /dev/full", "jaxpose export: stdout: No space left on device\n"),
    ],
)
def test_a_stream_that_takes_nothing(command, message):
    done = said(command)
    assert done.returncode == 1
    assert done.stderr.splitlines(keepends=True)[-1] == message and "Traceback" not in done.stderr


def test_without_stderr_it_works():
    done = said("--version 2>&-")
    assert done.returncode == 0 and done.stdout.startswith("jaxpose ")


_IMPORTED = """
import gc, importlib, signal, sys
from jaxpose.experiments.command import start

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

def load(name):
    def swallow(phase, info):  # as JAX's callback does
        signal.raise_signal(signal.SIGINT)
    gc.callbacks.append(swallow)
    gc.collect()
    gc.callbacks.remove(swallow)
    return __import__("types").SimpleNamespace(main=lambda args, prog: print("loaded"))

importlib.import_module = load
start("any", [], prog="jaxpose slam")
"""


def test_an_interrupt_that_a_library_swallows_ends_the_loading():
    done = subprocess.run([sys.executable, "-c", _IMPORTED], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "jaxpose slam: interrupted\n")


@pytest.mark.slow
@pytest.mark.parametrize("module", ["jaxpose.experiments.command", "numpy", "scipy", "jax", "optax"])
def test_interrupted_while_it_is_loading(module):
    """Right after a module of those that the command imports, which Python itself tells."""
    command = [sys.executable, "-X", "importtime", "-m", "jaxpose", "slam", "--data", "none"]
    heard = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, heard)
    said = []
    for line in process.stderr:
        if not line.startswith(("import time:", "  ")):  # nor of its progress
            said.append(line)
        elif line.split("|")[-1].strip() == module:
            process.send_signal(signal.SIGINT)
    assert said == ["jaxpose slam: interrupted\n"]
    assert process.wait() != 0


def test_names_that_no_terminal_shows_are_escaped(tmp_path, capsys):
    assert printable("a\x1b[2Jb\tc\nd\x9b") == "a\\x1b[2Jb\tc\nd\\x9b"
    line = complaint(main, "eval", tmp_path / "odd\x1b[31mname", tmp_path / "b")
    assert "odd\\x1b[31mname" in line and "\x1b" not in line
    name = os.fsdecode(b"odd\xff.txt")
    t = np.arange(0, 4, 0.1)
    trajectories.write_tum(tmp_path / name, trajectories.Trajectory(t, np.tile(np.eye(4), (40, 1, 1))))
    environment = os.environ | {"PYTHONIOENCODING": "utf-8:strict"}
    command = [sys.executable, "-m", "jaxpose", "check", tmp_path / name]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert "odd\\udcff.txt" in done.stdout and "Traceback" not in done.stderr


def test_output_in_the_place_of_the_input(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "poses.txt").write_text("")
    os.link(tmp_path / "poses.txt", tmp_path / "same.txt")
    (tmp_path / "link.txt").symlink_to(tmp_path / "poses.txt")
    for out in ("same.txt", "link.txt", "poses.txt"):
        with pytest.raises(ValueError, match="--out: expected another place than the input"):
            check_apart("--out", tmp_path / out, tmp_path / "poses.txt")
    with pytest.raises(ValueError, match="--out: expected no file of the run that is read"):
        check_apart("--out", tmp_path / "run" / "field.npz", tmp_path / "run")
    check_apart("--out", tmp_path / "run" / "mine.npz", tmp_path / "run", None)


def test_links_out_of_a_run_folder_are_not_followed_to_delete(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "00.json").write_text("{}")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "settings.json").write_text("{}")
    (tmp_path / "run" / "motions").symlink_to(tmp_path / "mine")
    with pytest.raises(DataError, match="motions/00.json: expected a file in the run folder, got a link out"):
        own_folder(tmp_path / "run", tmp_path / "run" / "settings.json", {}, False, "motions/[0-9]*.json")
    assert (tmp_path / "mine" / "00.json").exists()


def test_damaged_settings_of_a_run(tmp_path):
    (tmp_path / "settings.json").write_text("[1, 2")
    with pytest.raises(DataError, match="settings.json:1: expected the settings of a run, got"):
        own_folder(tmp_path, tmp_path / "settings.json", {}, True, "results.json")
