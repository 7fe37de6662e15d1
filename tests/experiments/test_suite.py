"""The suite: what is run, a table of medians and ranges with failures in it, and resuming."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import refused
from PIL import Image

from jaxpose.experiments import many_runs, suite
from jaxpose.experiments.suite import Config, cases, table


def complaint(*args):
    return refused.complaint(suite.main, *args)


def test_every_recording_at_every_rate_and_every_sensor(tmp_path):
    config = Config(data=(tmp_path / "walk", tmp_path / "desk"), rates_hz=(5.0, 2.5), sensors=("stipple",))
    found = [(case.recording, case.rate) for case in cases(config)]
    assert found == [
        ("walk", "all"), ("walk", "5 Hz"), ("walk", "2.5 Hz"),
        ("desk", "all"), ("desk", "5 Hz"), ("desk", "2.5 Hz"),
        ("room, stipple", "5 Hz"),
    ]  # fmt: skip


def test_recordings_of_one_name_are_told_apart():
    found = [case.recording for case in cases(Config(data=(Path("a/seq-01"), Path("b/seq-01")), sensors=()))]
    assert found == ["a/seq-01", "b/seq-01"]


def test_an_interrupted_suite_leaves_no_run_behind(tmp_path, monkeypatch):
    """What is running ends at once, and what waits is never started."""
    started = []

    class Endless(subprocess.Popen):
        def __init__(self, command, **options):
            super().__init__([sys.executable, "-c", "import time; time.sleep(600)"], **options)
            started.append(self)

    def interrupt(futures):
        while len(many_runs._RUNNING) < 2:
            time.sleep(0.01)
        raise KeyboardInterrupt

    names = SimpleNamespace(Popen=Endless, DEVNULL=subprocess.DEVNULL, PIPE=subprocess.PIPE)
    monkeypatch.setattr(many_runs, "subprocess", names)
    monkeypatch.setattr(many_runs, "as_completed", interrupt)
    with pytest.raises(KeyboardInterrupt):
        suite.run(Config(sensors=("axial",), processes=2, out=tmp_path / "suite"))
    assert len(started) == 2 and all(process.wait(10) != 0 for process in started)


def test_the_table_shows_ranges_and_failures():
    spread = lambda *values: {"median": float(np.median(values)), "min": min(values), "max": max(values)}
    good = {
        "recording": "walk", "rate": "all", "frames": 9, "ate_m": spread(0.02, 0.03, 0.05),
        "rpe_m": spread(0.01), "frames_lost": spread(0, 0, 4), "frames_uncertain": spread(0, 1, 5),
        "frames_wrong": spread(4, 4, 4), "frames_wrong_and_marked": spread(3, 3, 3),
        "seconds_per_frame": spread(0.25), "peak_rss_bytes": spread(2**30), "failures": [],
    }  # fmt: skip
    failed = {name: None for name in good} | {"recording": "desk", "rate": "5 Hz", "failures": ["no depth"]}
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in table([good, failed]).splitlines()
    ]
    assert rows[2] == [
        "walk", "all", "3.00 (2.00 to 5.00)", "1.00", "0 (0 to 4) of 9", "1 (0 to 5)",
        "3 of 4", "0.25", "1024",
    ]  # fmt: skip
    assert rows[3][2] == "n/a, 1 failed" and rows[3][6] == "n/a"


@pytest.mark.slow
def test_a_suite_is_run_and_resumed(tmp_path):
    """The room with one sensor, and a folder that is no recording: its line stands in the report."""
    (tmp_path / "nothing").mkdir()
    command = [sys.executable, "-m", "jaxpose.experiments.suite", "--smoke", "--seeds", "1"]
    command += ["--data", str(tmp_path / "nothing"), "--sensors", "stipple", "--out", str(tmp_path / "suite")]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    results = json.loads((tmp_path / "suite" / "results.json").read_text())
    failed, room = results["rows"]
    assert failed["ate_m"] is None and "expected a recording" in failed["failures"][0]
    assert re.search(r"failed +nothing, all: .*expected a recording", ended.stdout)
    run = json.loads((tmp_path / "suite" / "runs" / "room-stipple-5-Hz-0" / "results.json").read_text())
    assert room["ate_m"]["median"] == run["ate_rmse_m"] and room["frames"] == 8
    assert (tmp_path / "suite" / "table.md").read_text().strip() in ended.stdout
    assert Image.open(tmp_path / "suite" / "suite.png").size[0] == 840
    done = tmp_path / "suite" / "runs" / "room-stipple-5-Hz-0" / "results.json"
    before = done.stat().st_mtime_ns
    subprocess.run([*command, "--resume"], capture_output=True, check=True)
    assert done.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--seeds", "0"], r"--seeds: expected at least 1, got 0"),
        (["--rates-hz", "0"], r"--rates-hz: expected a positive number, got 0"),
        (["--sensors", "sonar"], r"invalid choice 'sonar'"),
        (["--data", "nowhere"], r"nowhere: expected a folder of a recording, got nothing"),
        (["--resume"], r"--resume: expected --out DIR or --name NAME"),
    ],
)
def test_bad_options_are_one_line(args, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = complaint(*args)
    assert line.startswith("suite: ") and re.search(expected, line), line
    assert not list(tmp_path.iterdir())
