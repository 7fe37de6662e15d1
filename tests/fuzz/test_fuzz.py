"""The fuzzer in the gate: a minute over all readers; by hand `python tests/fuzz/run.py --seconds 3600`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).with_name("run.py")
PIPES = """
import os, signal, sys, tempfile
from pathlib import Path
sys.path[:0] = [sys.argv[1], str(Path(sys.argv[1]).parent)]
import run, targets
with tempfile.TemporaryDirectory() as where:
    for name, target in targets.TARGETS.items():
        folder = Path(where) / name
        folder.mkdir()
        target.write(folder)
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            kept = file.rename(Path(where) / "kept")
            os.mkfifo(file)
            signal.alarm(20)  # ends what waits
            print(name, file.name, run.fault_of(target, folder), flush=True)
            signal.alarm(0)
            file.unlink()
            kept.rename(file)
"""


def fuzzed(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(RUN), *options], capture_output=True, text=True)


@pytest.mark.slow
def test_every_reader_bears_damaged_files():
    found = fuzzed("--seconds", "60")
    assert found.returncode == 0, found.stdout + found.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "fault"),
    [
        ("raise KeyError('x')", "KeyError at"),
        ("return float('nan')", "not finite"),
        ("return bytearray(3 << 30)", "MemoryError"),
        ("import os; os.abort()", "the process ended"),
    ],
)
def test_the_fuzzer_sees_what_is_wrong(tmp_path, body, fault):
    """A reader with a fault of each kind: it is counted, and the cases after it are run."""
    for name in ("run.py", "mutations.py", "replacements.py"):
        (tmp_path / name).write_text(RUN.with_name(name).read_text())
    (tmp_path / "targets.py").write_text(
        "from typing import NamedTuple, Any\nclass Target(NamedTuple):\n    write: Any\n    read: Any\n"
        "def read(folder):\n    file = folder / 'a.txt'\n"
        "    if not file.is_file() or file.read_text(errors='replace') == '1 2 3\\n': return 1.0\n"
        f"    {body}\n"
        "TARGETS = {'own': Target(lambda folder: (folder / 'a.txt').write_text('1 2 3\\n'), read)}\n"
    )
    found = subprocess.run(
        [sys.executable, tmp_path / "run.py", "--seconds", "8"], capture_output=True, text=True, cwd=tmp_path
    )
    assert found.returncode == 1 and fault in found.stdout, found.stdout + found.stderr[-2000:]


@pytest.mark.slow
def test_a_pipe_in_any_file_s_place_is_refused_or_passed_over():
    """Nobody writes to it: who opens it to read waits for ever."""
    found = subprocess.run([sys.executable, "-c", PIPES, RUN.parent], capture_output=True, text=True)
    lines = found.stdout.splitlines()
    assert found.returncode == 0, f"{lines[-1:]} waited, and the next: {found.stderr[-2000:]}"
    assert len(lines) > 200 and [line for line in lines if not line.endswith(" None")] == []


def test_the_same_seed_gives_the_same_damage(tmp_path):
    code = (
        "import sys, json; sys.path.insert(0, sys.argv[1]); import mutations; from random import Random; "
        "print(json.dumps([list(mutations.mutated(Random(k), '.txt', b'5 1 2\\n' * 9)) for k in range(50)]))"
    )
    said = [
        subprocess.run(
            [sys.executable, "-c", code, str(RUN.parent)], capture_output=True, text=True, check=True
        )
        for _ in range(2)
    ]
    assert said[0].stdout == said[1].stdout
    assert len({tuple(case) for case in json.loads(said[0].stdout)}) > 30
