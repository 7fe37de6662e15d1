"""Fuzz every reader: `python tests/fuzz/run.py --seconds 3600`. It states cases, faults by kind, peak memory.

A case is a small valid folder with one file damaged. It holds if the reader takes it and gives finite
numbers, or refuses it in one line (`DataError`, `OSError` of the system), within 10 s and 1 GB. Cases are run
in a process of their own, which is started anew where one ends it. The same seed gives the same cases.
"""

import argparse
import collections
import faulthandler
import json
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from pathlib import Path
from random import Random
from typing import Any

sys.path.insert(1, str(Path(__file__).parents[1]))  # what tests share
SLOWEST_S, MOST_BYTES = 10.0, 1 << 30
TOGETHER = 10_000  # cases of a process, whose memory grows
_TELL_S = 5.0
DEAD_S, ASLEEP_S = 30.0, 120.0  # of the processor, and of the clock, after which a case is ended


def numbers_of(value: Any):
    """The arrays of floating-point numbers in what a reader returned."""
    import numpy as np

    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple | list):
        for entry in value:
            yield from numbers_of(entry)
    elif value is not None and np.asarray(value).dtype.kind in "fc":
        yield np.asarray(value)


def fault_of(target: Any, folder: Path) -> str | None:
    """What is wrong with how a reader takes a folder; None where nothing is."""
    import numpy as np

    from jaxpose.errors import DataError

    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = target.read(folder)
        bad = [array for array in numbers_of(found) if not np.isfinite(array).all()]
        fault = "not finite" if bad else None
    except (DataError, OSError) as error:
        # FFmpeg says that memory is lacking for sizes that no file has: it asks the system before it reads.
        cause = error.__context__
        big = isinstance(cause, MemoryError) and not type(cause).__module__.startswith("av.")
        fault = "memory" if big else "not one line" if "\n" in str(error) or len(str(error)) > 1500 else None
        if isinstance(error, OSError) and error.errno is None:
            fault = f"{type(error).__name__} without a file: {str(error)[:80]}"
    except MemoryError:
        fault = "MemoryError"
    except BaseException as error:
        own = [f for f in traceback.extract_tb(error.__traceback__) if "/jaxpose/" in f.filename]
        place = f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else "?"
        fault = f"{type(error).__name__} at {place}: {' '.join(str(error).split())[:90]}"
    if time.process_time() - began > SLOWEST_S:
        fault = f"slow: {time.process_time() - began:.0f} s"
    return fault


def damage(name: str, number: int, seed: int, folder: Path) -> Path:
    """Damage one file of a folder; returns it."""
    import mutations
    import replacements

    random = Random(zlib.crc32(f"{name} {number} {seed}".encode()))
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    texts = [path for path in files if path.suffix not in (".png", ".jpg")]
    file = random.choice(texts if texts and random.random() < 0.9 else files)
    if random.random() < 0.15:
        replacements.put(random, file, files)
    else:
        file.write_bytes(mutations.mutated(random, file.suffix, file.read_bytes()))
    return file


def work(names: list[str], seed: int, first: int, seconds: float) -> None:
    """Run cases until the time is over; a line of JSON for each."""
    import targets

    faulthandler.enable()
    ends = time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as where:
        originals = {}
        for name in names:
            originals[name] = Path(where) / name
            originals[name].mkdir()
            targets.TARGETS[name].write(originals[name])
            fault = fault_of(targets.TARGETS[name], originals[name])
            assert fault is None, f"{name}, undamaged: {fault}"
        _limit_memory()
        faulthandler.register(signal.SIGPROF, chain=True)  # then it ends the process
        copy, number = Path(where) / "case", first
        while time.monotonic() < ends and number < first + TOGETHER:
            name = names[number % len(names)]
            print(json.dumps({"case": number}), flush=True)
            shutil.copytree(originals[name], copy)
            file = damage(name, number, seed, copy)
            faulthandler.dump_traceback_later(ASLEEP_S, exit=True)
            signal.setitimer(signal.ITIMER_PROF, DEAD_S)
            fault = fault_of(targets.TARGETS[name], copy)
            signal.setitimer(signal.ITIMER_PROF, 0)
            faulthandler.cancel_dump_traceback_later()
            if fault:
                print(
                    json.dumps({"case": number, "target": name, "file": file.name, "fault": fault}),
                    flush=True,
                )
            shutil.rmtree(copy)
            number += 1
    print(json.dumps({"peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024}), flush=True)


def _limit_memory() -> None:
    """Refuse more than the process now has and 1 GB (and what threads of XLA reserve without using it)."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES + (1 << 29),) * 2)


def fuzz(seconds: float, names: list[str] | None = None, seed: int = 0, first: int = 0) -> dict[str, Any]:
    """Fuzz readers.

    Args:
        seconds: for how long.
        names: of readers, as `targets.TARGETS` has them; None: all.
        seed: of the damage.
        first: number of the first case.

    Returns:
        Cases, faults with how often they were met and the first case of each, and peak memory.
    """
    import targets

    names = names or list(targets.TARGETS)
    faults: collections.Counter[str] = collections.Counter()
    examples: dict[str, int] = {}
    number, peak, ends, told = first, 0, time.monotonic() + seconds, time.monotonic()
    while (left := ends - time.monotonic()) > 1:
        command = [sys.executable, __file__, "--worker", "--seconds", str(left), "--seed", str(seed)]
        command += ["--first", str(number), "--targets", *names]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None and process.stderr is not None
            ended = False
            for line in process.stdout:
                said = json.loads(line)
                peak, ended = max(peak, said.get("peak_bytes", 0)), ended or "peak_bytes" in said
                number = said.get("case", number)
                if time.monotonic() - told > _TELL_S:
                    told = time.monotonic()
                    print(
                        f"{number - first} cases, {sum(faults.values())} faults", file=sys.stderr, flush=True
                    )
                if "fault" in said:
                    fault = f"{said['target']} {said['file']}: {re.sub(r'/tmp/[^ ]*/', '', said['fault'])}"
                    faults[fault] += 1
                    if examples.setdefault(fault, number) == number:
                        print(f"{fault}  (case {number})", file=sys.stderr, flush=True)
            last = process.stderr.read()[-300:]
        number += 1
        if not ended:
            name = names[(number - 1) % len(names)]
            dead = f"{name}: the process ended: {' '.join(last.split())[-120:]}"
            faults[dead] += 1
            examples.setdefault(dead, number - 1)
    return {"cases": number - first, "faults": faults, "examples": examples, "peak_bytes": peak}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--targets", nargs="+")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return work(options.targets, options.seed, options.first, options.seconds)
    found = fuzz(options.seconds, options.targets, options.seed, options.first)
    for fault, count in found["faults"].most_common():
        print(f"{count:6d}  {fault}  (case {found['examples'][fault]})")
    faults, peak = sum(found["faults"].values()), found["peak_bytes"] / 2**30
    print(f"{found['cases']} cases, {faults} faults, at most {peak:.2f} GiB")
    return sys.exit(1 if found["faults"] else 0)


if __name__ == "__main__":
    main()
