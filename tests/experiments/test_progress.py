"""Progress on stderr: a line at once for each phase, never a long silence, one redrawn line on a terminal."""

import io
import re
import subprocess
import sys
import time

import pytest

from jaxpose.experiments import progress
from jaxpose.experiments.progress import Update, line, shown


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_line_for_each_phase_at_once():
    stream = io.StringIO()
    with shown(stream) as on_update:
        on_update(Update("reading"))
        assert stream.getvalue() == "  reading\n"
        for done in range(1, 101):
            on_update(Update("tracking", done, 100, "frames", {"lost": "0"}))
        on_update(Update("drawing"))
    lines = stream.getvalue().splitlines()
    assert lines == [
        "  reading",
        "  tracking  1/100 frames  lost 0",
        "  tracking  100/100 frames  lost 0",
        "  drawing",
    ]


def test_what_takes_long_is_said_again(monkeypatch):
    monkeypatch.setattr(progress, "_SILENCE_S", 0.3)
    stream = io.StringIO()
    with shown(stream) as on_update:
        on_update(Update("compiling"))
        time.sleep(1.6)
    lines = stream.getvalue().splitlines()
    assert len(lines) >= 3 and lines[0] == "  compiling" and re.fullmatch(r"  compiling  \d s", lines[-1])


def test_what_is_quick_is_not_said(monkeypatch):
    monkeypatch.setattr(progress, "_SILENCE_S", 0.5)
    stream = io.StringIO()
    with shown(stream) as on_update:
        on_update(Update("reading", quiet=True))
        assert stream.getvalue() == ""
        time.sleep(1.2)
    assert stream.getvalue().startswith("  reading")


def test_a_terminal_redraws_one_line_a_phase():
    stream = Terminal()
    with shown(stream) as on_update:
        for done in (1, 2):
            on_update(Update("tracking", done, 2, "frames"))
        on_update(Update("drawing"))
    text = stream.getvalue()
    assert text.count("\n") == 2 and text.count("\r") == 3
    assert text.endswith("drawing\n") and "2/2 frames\n" in text


def test_time_left_is_that_of_the_steps_done_here():
    """A resumed run began in the middle."""
    assert line(Update("training", 600, 1000), 10.0, 500) == "  training  600/1000 steps  10 s, 40 s left"


def test_time_left_is_not_told_by_a_chunk_that_began_before():
    """The first 100 steps are told when they are done; waiting for the next ones makes the rest no longer."""
    first = Update("training", 100, 1000)
    assert line(first, 12.0, 100, 12.0) == "  training  100/1000 steps  12 s"
    second = Update("training", 200, 1000)
    assert line(second, 10.0, 100) == "  training  200/1000 steps  10 s, 80 s left"
    assert line(second, 13.0, 100, 3.0) == "  training  200/1000 steps  13 s, 77 s left"
    assert line(second, 95.0, 100, 85.0) == "  training  200/1000 steps  95 s"


@pytest.mark.slow
def test_a_run_is_never_silent(tmp_path):
    """The run folder first, and then no five seconds without a line."""
    command = [
        sys.executable,
        "-u",
        "-m",
        "jaxpose",
        "slam",
        "--smoke",
        "--refine",
        "all",
        "--out",
        tmp_path / "run",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    times, lines = [time.perf_counter()], []
    for text in process.stderr:
        times.append(time.perf_counter())
        lines.append(text.rstrip())
    assert process.wait() == 0
    own = [text for text in lines if not text.startswith("  loading")]
    assert own[0] == f"  run folder {tmp_path / 'run'}"
    gaps = [later - before for before, later in zip(times, times[1:], strict=False)]
    assert max(gaps) < 5, list(zip(gaps, lines, strict=True))
    for phase in ("compiling", "tracking", "refining", "texturing", "point cloud", "rendering", "drawing"):
        assert any(phase in text for text in own), phase
