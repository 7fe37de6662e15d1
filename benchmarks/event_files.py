"""How fast files of events are streamed, and in how much memory, beside the package expelliarmus.

    python benchmarks/event_files.py --events 1e8

Files of Prophesee's encodings are made by expelliarmus, ten million events and then the same again; every
reader passes over each in a process of its own. Its rate is by process time, without imports; its memory is
the most that the process held. (expelliarmus 1.1.12 reads EVT 3.0 with other timestamps than it writes; it is
the fastest all the same.)
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ENCODINGS = ("evt2", "evt3", "dat")
ONCE = 10**7


def make(file: Path, encoding: str, count: int) -> None:
    """A file of `count` events or a little more: one of ten million, repeated behind its header."""
    from expelliarmus import Wizard

    rng = np.random.default_rng(0)
    once = min(count, ONCE)
    events = np.empty(once, [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1")])
    events["t"] = np.cumsum(rng.integers(0, 2, once))
    for name, size in (("x", 1280), ("y", 720), ("p", 2)):
        events[name] = rng.integers(0, size, once)
    Wizard(encoding=encoding).save(fpath=file, arr=events)
    content = file.read_bytes()
    start = 0
    while content[start : start + 1] == b"%":
        start = content.index(b"\n", start) + 1
    start += 2 if encoding == "dat" else 0
    with file.open("ab") as stream:
        for _ in range(-(-count // once) - 1):
            stream.write(content[start:])


def ours(file: Path) -> int:
    from jaxpose.datasets.events import registry

    stream = registry.find(file, size=(1280, 720)).stream
    return sum(len(block.t) for block in stream.blocks())


def expelliarmus(file: Path) -> int:
    from expelliarmus import Wizard

    wizard = Wizard(encoding=file.stem.removeprefix("few_"))
    wizard.set_file(file)
    return sum(len(chunk) for chunk in wizard.read_chunk())


def peak_mb() -> float:
    """The most that this process held; `getrusage` has what its parent held before as well."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1024


READERS = {"jaxpose": ours, "expelliarmus": expelliarmus}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--events", type=float, default=1e8)
    parser.add_argument("--encodings", nargs="+", default=ENCODINGS)
    parser.add_argument("--worker", nargs=2)
    args = parser.parse_args()
    if args.worker:
        name, file = args.worker
        READERS[name](Path(file).with_name(f"few_{Path(file).name}"))  # imports
        begun = time.process_time()
        count = READERS[name](Path(file))
        spent = time.process_time() - begun
        print(json.dumps({"count": count, "s": spent, "peak_mb": peak_mb()}))
        return
    with tempfile.TemporaryDirectory() as folder:
        for encoding in args.encodings:
            file = Path(folder) / f"{encoding}.{'dat' if encoding == 'dat' else 'raw'}"
            make(file, encoding, int(args.events))
            make(file.with_name(f"few_{file.name}"), encoding, 1000)
            for name in READERS:
                command = [sys.executable, __file__, "--worker", name, str(file)]
                said = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
                rate = said["count"] / said["s"] / 1e6
                print(
                    f"{encoding:5} {name:13} {said['count']} events, {rate:.0f} M/s, {said['peak_mb']:.0f} MB"
                    f", load {os.getloadavg()[0]:.1f}"
                )
            file.unlink()


if __name__ == "__main__":
    main()
