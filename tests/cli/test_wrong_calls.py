"""More than 300 wrong calls: each option of each command with what it cannot be, and files that are none."""

import json
import time

import numpy as np
import pytest
from PIL import Image

from jaxpose.cli.main import SUBCOMMANDS, main
from jaxpose.experiments import command as command_module
from jaxpose.experiments.option_help import Option, options
from jaxpose.files import trajectories

POSITIONAL = {
    "check": ("good.txt",),
    "fit": ("good.txt",),
    "eval": ("good.txt", "good.txt"),
    "export": ("good.txt", "--format", "csv", "--out", "out.csv"),
    "view": ("good.txt", "--out", "page.html"),
}
FILES = {
    "empty.txt": b"",
    "zeros.txt": bytes(1000),
    "noise.txt": bytes(range(256)) * 40,
    "words.txt": b"what is this\n" * 20,
    "line.txt": b"1 2 3\n",
    "nan.txt": b"0 nan nan nan nan nan nan nan\n" * 3,
    "far.txt": b"0 1e300 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n",
    "back.txt": b"1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n",
    "nested.json": b"[" * 100_000,
    "object.json": json.dumps({"frames": [{"file_path": 3}]}).encode(),
    "short.npz": b"PK\x03\x04" + bytes(30),
    "head.npy": b"\x93NUMPY\x01\x00\xff\xff{",
    "head.h5": b"\x89HDF\r\n\x1a\n" + bytes(50),
    "head.bag": b"#ROSBAG V2.0\n" + bytes(20),
    "head.raw": b"% evt 9.0\n% end\n",
}
READS = {
    "check": ("{}",),
    "fit": ("{}",),
    "eval": ("{}", "good.txt"),
    "eval against": ("good.txt", "{}"),
    "export": ("{}", "--format", "tum", "--out", "out.txt"),
    "view": ("{}", "--out", "page.html"),
    "slam": ("--data", "{}", "--smoke"),
    "nerf": ("--data", "{}", "--smoke"),
    "events": ("--data", "{}", "--smoke"),
    "planar": ("--image", "{}", "--smoke"),
}
SLOWEST_S = 10.0


def bad_values(option: Option) -> list[list[str]]:
    """Arguments that an option cannot take."""
    if option.values == "":
        return [[f"{option.flag}=maybe"], [f"{option.flag}x"]]
    if option.values.startswith("{"):
        return [[option.flag, "nonsense"]]
    if "INT" in option.values or "FLOAT" in option.values:
        count = option.values.count("FLOAT") or 1
        return [[option.flag, *["x"] * count], [option.flag, *["-1e30"] * count]]
    return [[option.flag]] if "..." not in option.values else [[f"{option.flag}x", "a"]]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where the calls are made: a trajectory, and files and places that are none."""
    T = np.tile(np.eye(4), (9, 1, 1))
    T[:, 0, 3] = np.arange(9)
    trajectories.write_tum(tmp_path / "good.txt", trajectories.Trajectory(np.arange(9) / 10, T))
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    Image.new("RGB", (1, 1)).save(tmp_path / "pixel.png")
    (tmp_path / "bare").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def wrong_calls(monkeypatch) -> list[list[str]]:
    """The command lines."""
    calls = [[], ["nothing"], ["slam", "nerf"], ["--frobnicate"], ["evaluate"]]
    for name in SUBCOMMANDS:
        asked = []

        def keep(command, args, asked=asked):
            asked.append(command)
            raise SystemExit(0)

        with monkeypatch.context() as patch, pytest.raises(SystemExit):
            patch.setattr(command_module, "parse", keep)
            main([name])
        for option in options(asked[0].config, asked[0].hidden):
            if option.flag.startswith("--"):
                calls += [[name, *POSITIONAL.get(name, ()), *bad] for bad in bad_values(option)]
    bad = [*FILES, "pixel.png", "bare", "loop", "missing", "x" * 300, "/dev/null", "no\nline"]
    return calls + [
        [reading.split()[0], *(word.format(file) for word in words)]
        for reading, words in READS.items()
        for file in bad
    ]


@pytest.mark.slow
def test_wrong_calls_answer_in_one_line(folder, monkeypatch):
    calls, before = wrong_calls(monkeypatch), sorted(folder.rglob("*"))
    assert len(calls) > 300
    slow = []
    for call in calls:
        began = time.process_time()
        with pytest.raises(SystemExit) as stop:
            main(call)
        said = stop.value.code  # a text is printed on stderr, with exit code 1
        report = call[:1] == ["check"] and said == 1  # what it found is its report
        assert report or (isinstance(said, str) and "\n" not in said), f"{call}: {said!r}"
        if time.process_time() - began > SLOWEST_S:
            slow.append(call)
    assert slow == []
    assert sorted(folder.rglob("*")) == before  # nothing was written
