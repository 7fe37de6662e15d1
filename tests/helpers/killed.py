"""What a training makes of SIGKILL."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np


def whole_and_killed(
    experiment: str, args: str, steps: int, out: Path, killed_on: Mapping[str, str] = MappingProxyType({})
) -> tuple[dict, dict]:
    """Results of a training left alone, and of one killed in the middle of its steps and resumed.

    Until it is killed it runs with the variables `killed_on` beside those of this process.
    """
    code = (
        f"from jaxpose.experiments import training_loop\n"
        f"from jaxpose.experiments.{experiment} import pipeline\n"
        "training_loop._SAVE_EVERY_S = 0; pipeline.main()"
    )
    command = [sys.executable, "-c", code, *args.split(), "--steps", str(steps)]
    start = lambda name, **more: subprocess.Popen(
        [*command, "--out", out / name, "--resume"], env=os.environ | more
    )
    assert start("whole").wait() == 0
    process, checkpoint = start("killed", **killed_on), out / "killed" / "checkpoint.npz"
    while not checkpoint.exists():
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    with np.load(checkpoint) as file:
        assert file[".state.step"] < steps
    assert start("killed").wait() == 0
    whole, killed = (json.loads((out / name / "results.json").read_text()) for name in ("whole", "killed"))
    return whole, killed
